"""Documents in a console or notebook: short, with long fields abbreviated."""

from __future__ import annotations

import sme_registry
from sme_registry.spec import ProtocolFile, SMESpec, StudyFile, SuiteFile, catalogue, fields


def test_no_document_fills_a_screen():
    for kind, name in ((SuiteFile, "core"), (StudyFile, "smoke"), (ProtocolFile, "paper")):
        assert len(repr(catalogue.find(kind, name))) < 400
    assert "agents=<tuple of 4>" in repr(sme_registry.load("Team4"))
    spec = SMESpec(complexity=5)
    assert eval(repr(spec)) == spec
    assert "k=5, r_min=0.123456789" in SMESpec(r_min=0.123456789, k=5)._repr_html_()


def test_a_notebook_shows_a_tasks_fields_name_and_digest():
    spec = SMESpec(complexity=5, k=3).named("<Mine>")
    html = spec._repr_html_()
    for text in ("complexity", "<b>5</b><br>default 1", spec.digest, "&lt;Mine&gt;"):
        assert text in html
    assert "<Mine>" not in html
    assert "Not the default: k=3, complexity=5" in html
    assert ">L</b>" in html  # its symbol
    assert "layers of the optimal policy" in html  # its meaning
    assert html.count("<br>default ") == 2
    assert "safety" not in html  # not set
    assert "4 agents" in sme_registry.load("Team4")._repr_html_()
    assert "The default task" in sme_registry.load("Default")._repr_html_()


def test_a_notebook_shows_a_streams_phases():
    html = sme_registry.load("Switch5")._repr_html_()
    assert html.count(">seed=") == 4
    assert "100,000" in html
    assert "<b></b>" not in html


def test_the_card_of_any_document_is_short():
    agents = [{"action_dim": 1} for _ in range(300)]
    huge = SMESpec(action_dim=300, team={"agents": agents})
    phases = [{"spec": "Default", "steps": 500}, {"spec": "Complexity10", "steps": 500}] * 150
    for document in (huge, sme_registry.StreamSpec(phases=phases)):
        assert len(document._repr_html_().encode()) < 20_000


def test_symbols_are_those_of_the_descriptions():
    setting = SMESpec.from_dict(
        {"safety": {"tightness": 0.5}, "rotation": 1.0, "policy_init": "unit_variance"}
    )
    symbols = {row.name: row.symbol for row in fields.rows(setting)}
    assert symbols["state_dim"] == "S"
    assert symbols["r_min"] == "r_min"
    assert symbols["rotation"] == "θ"
    assert symbols["safety.tightness"] == "τ"
    assert symbols["policy_init"] == symbols["seed"] == ""
