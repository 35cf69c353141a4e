"""Documents in a console or notebook: short, with long fields abbreviated."""

from __future__ import annotations

import pytest

import sme_registry
from sme_registry.spec import ProtocolFile, SMESpec, StudyFile, SuiteFile, catalogue


@pytest.mark.parametrize(
    ("kind", "name"), [(SuiteFile, "core"), (StudyFile, "smoke"), (ProtocolFile, "paper")]
)
def test_no_document_fills_a_screen(kind, name):
    assert len(repr(catalogue.find(kind, name))) < 400


def test_a_long_field_is_shown_by_its_type_and_length():
    team = sme_registry.load("Team4")
    assert "agents=<tuple of 4>" in repr(team)
    spec = SMESpec(complexity=5)
    assert eval(repr(spec)) == spec


def test_a_notebook_shows_a_tasks_fields_name_and_digest():
    spec = SMESpec(complexity=5, k=3).named("<Mine>")
    html = spec._repr_html_()
    for text in ("complexity", ">5<", spec.digest, "&lt;Mine&gt;"):
        assert text in html
    assert "safety" not in html  # not set
    assert "4 agents" in sme_registry.load("Team4")._repr_html_()
