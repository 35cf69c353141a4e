"""The leaderboard uses the registry by what its top-level modules export, documented or not."""

import ast
import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

import leaderboard
from leaderboard.cli import app
from leaderboard.documents.signed import SigningKey
from leaderboard.web.client import PublicView, public_view
from sme_registry.errors import SpecError
from tests.leaderboard.web import boards

# Private to the two packages: their modules are imported by name.
SHARED = ("sme_registry.io.", "sme_registry.spec.")
PROTOCOL = (
    "sme_registry.seasons.wire",
    "sme_registry.seasons.transcript",
    "sme_registry.task.engine",
)
"""What servers and clients send each other, and sign; and what steps for both."""


def submodules(module):
    return {each.name for each in pkgutil.iter_modules(getattr(module, "__path__", ()))}


def exported(module):
    """The documented names, those that the module defines, and those imported as themselves."""
    source = inspect.getsource(module)
    again = re.findall(r"import (\w+) as \1\n", source)
    defined = re.findall(r"^(\w+) = ", source, re.M)
    return {*getattr(module, "__all__", dir(module)), *again, *defined, *submodules(module)}


def private_imports(source):
    """Imports from the registry that are not of a name that a top-level module exports."""
    private = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sme_registry"):
            module = importlib.import_module(node.module)
            top_level = node.module.count(".") < 2 or node.module in PROTOCOL
            top_level |= node.module.startswith(SHARED)
            private += [
                f"{node.module}.{alias.name}"
                for alias in node.names
                if not top_level or alias.name.startswith("_") or alias.name not in exported(module)
            ]
    return private


def test_the_leaderboard_imports_only_public_names_of_the_registry():
    files = sorted(Path(leaderboard.__file__).parent.rglob("*.py"))
    assert len(files) > 30
    imports = {str(path): private_imports(path.read_text()) for path in files}
    assert {path: names for path, names in imports.items() if names} == {}


def test_a_private_import_would_be_found():
    source = "from sme_registry.task.loading import x\nfrom sme_registry.io import _x, choice"
    assert private_imports(source) == ["sme_registry.task.loading.x", "sme_registry.io._x"]


def test_an_earlier_version_is_shown_with_the_reason_why_it_has_no_rank(tmp_path):
    key = SigningKey.generate()
    with boards.create(tmp_path / "board", classes=1) as store:
        first = boards.submit(store, key, "PPO", [0.2] * 6, statement="first")
        second = boards.submit(store, key, "PPO", [0.2] * 6, statement="second")
        views = [public_view(store, store.entry(id)) for id in (first, second)]
    assert [view.not_ranked for view in views] == ["superseded", ""]
    printed = CliRunner().invoke(app, ["show", str(tmp_path / "board"), first]).stdout
    assert "not ranked" in printed
    assert "each of 1,000,000 steps, 10,000,000 in total" in printed

    assert PublicView.from_dict(views[0].to_dict()) == views[0]
    plain = views[1].to_dict()
    for change in ({"copy_of": [{"id": "x"}]}, {"copy_of": 3}, {"faults": "many"}):
        with pytest.raises(SpecError, match=f"{next(iter(change))}.*: "):
            PublicView.from_dict({**plain, **change})
