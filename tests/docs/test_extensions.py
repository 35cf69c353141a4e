"""The site's own extensions: what they make of a page, a docstring, a command, a schema."""

import importlib
import inspect
import re

import pytest

from tests.docs.conftest import ROOT

pytest.importorskip("sphinx")

import command_reference
import docstrings
import python_reference
import schema_files
from sphinx.util.inspect import signature as inspect_signature
from sphinx.util.inspect import stringify_signature

import sme_registry
from sme_registry import seasons
from sme_registry.cli.show import _SCHEMAS


def test_a_docstring_becomes_rst_with_its_formulas_and_doctests_untouched():
    text = "Mean |a| of `x*` and\n`y`s.\n\n    a* = b |c|\n\nThen π* is.\n\n>>> f(*x)\n3"
    assert docstrings.as_rst(text.split("\n")) == [
        r"Mean \|a\| of ``x*`` and", r"``y``\ s.", "", "::", "", "    a* = b |c|", "",
        r"Then π\* is.", "", ">>> f(*x)", "3",
    ]  # fmt: skip


def test_every_command_and_option_is_in_the_reference():
    sme = command_reference.page("sme", "sme_registry.cli")
    assert "(sme-study-compare)=\n### sme study compare" in sme
    assert r"`-k, --kind <env\|stream\|suite\|protocol\|study>`" in sme
    assert "sme study compare runs/smoke PPO TD3" in sme
    board = command_reference.page("sme-leaderboard", "leaderboard.cli")
    assert "(sme-leaderboard-submit)=\n## sme-leaderboard submit" in board
    assert "Replace the bundle of `--out`." in board
    assert "docs/" not in sme + board
    text = re.sub(r"```.*?```|`[^`]*`", "", sme + board, flags=re.S)
    assert not re.findall(r".*--\w.*", text)  # an option is code wherever it is named


def signature(path):
    module, _, name = path.rpartition(".")
    value = getattr(importlib.import_module(module), name)
    kind = "class" if inspect.isclass(value) else "function"
    text = stringify_signature(inspect_signature(value), unqualified_typehints=True)
    arguments = text.rpartition(" -> ")[0] or text
    return docstrings._on_signature(None, kind, path, value, {}, arguments, "")[0]


def test_a_signature_has_plain_types_and_defaults_as_values():
    spec = signature("sme_registry.SMESpec")
    assert "state_dim: int = 8, action_dim: int = 4" in spec
    assert "policy_init: Literal['semi_orthogonal', 'unit_variance'] = 'semi_orthogonal'" in spec
    assert "FieldInfo" not in signature("sme_registry.EvaluationProtocol")
    assert "hyperparameters: dict[str, ~pydantic.types.JsonValue] = {}" in signature(
        "sme_registry.spec.StudyAlgorithm"
    )
    assert "plan: dict[str, ~pydantic.types.JsonValue] = {}" in signature(
        "sme_registry.diagnosis.Subject"
    )
    assert docstrings._with_values("(patience: float = PATIENCE)", seasons.make) == (
        "(patience: float = 900.0)"
    )
    assert ":exclude-members: model_config" in "\n".join(
        python_reference._directive("sme_registry.SMESpec", sme_registry.SMESpec)
    )


def test_every_document_with_a_json_schema_has_a_file():
    page = (ROOT / "docs" / "reference" / "generated" / "files.md").read_text()
    listed = re.findall(r"^(?:sme_registry|leaderboard)\.\S+$", page, re.M)
    assert {schema_files.document(path) for path in listed} >= set(_SCHEMAS.values())


def test_every_public_module_is_on_the_page_of_python_names():
    page = (ROOT / "docs" / "reference" / "python.md").read_text()
    listed = {name for entry in python_reference.modules(page) for name in entry}
    public = [f"sme_registry.{name}" for name in sme_registry._SUBMODULES]
    assert listed >= {"sme_registry", *public}


@pytest.mark.parametrize("module", ["sme_registry", "sme_registry.errors", "sme_registry.spec"])
def test_every_public_name_is_documented_once_and_linked_elsewhere(module):
    listed = [["sme_registry"], ["sme_registry.errors"], ["sme_registry.spec"]]
    pages = python_reference.pages(listed)
    owner = importlib.import_module(module)
    for name in python_reference.names(owner):
        value = getattr(owner, name)
        if inspect.ismodule(value):
            continue
        at_home = re.search(rf":: {re.escape(module)}\.{name}$", pages[module], re.M)
        assert bool(at_home) != (f":py:obj:`{name} <" in pages[module]), name
    everything = "\n".join(pages.values())
    assert len(re.findall(r":: \S+\.SMESpec$", everything, re.M)) == 1
