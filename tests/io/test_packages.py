"""Which command installs a missing package."""

from __future__ import annotations

import ast
import json
import re
import shlex
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

import sme_registry
from sme_registry.errors import MissingDependencyError
from sme_registry.io import install_command, missing_dependency, packages, require_packages
from tests.wheel.test_extras import NAME, closure

ROOT = Path(sme_registry.__file__).parents[1]


def requirement(command: str) -> str:
    return shlex.split(command)[-1]


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> object:
    """Records where the package was installed from, as pip does."""
    monkeypatch.setattr(packages, "_SOURCE", tmp_path / "site-packages")

    def install(origin: dict[str, object] | None) -> None:
        class Distribution:
            def read_text(self, name: str) -> str | None:
                assert name == "direct_url.json"
                return None if origin is None else json.dumps(origin)

        monkeypatch.setattr(packages.metadata, "distribution", lambda name: Distribution())

    return install


def test_in_a_clone_the_command_names_the_clone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert requirement(install_command("plot")) == f"{ROOT}[plot]"
    monkeypatch.chdir(ROOT)
    assert requirement(install_command("plot")) == ".[plot]"
    assert "-e" in shlex.split(install_command("plot"))


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        (None, "sme-registry[plot]"),
        (
            {"url": "file:///a%20b/sme.whl", "archive_info": {}},
            "sme-registry[plot] @ file:///a%20b/sme.whl",
        ),
        (
            {"url": "https://host/sme.git", "vcs_info": {"vcs": "git", "commit_id": "0" * 40}},
            "sme-registry[plot] @ git+https://host/sme.git",
        ),
        ({"url": "file:///removed", "dir_info": {}}, "sme-registry[plot]"),
    ],
)
def test_a_copy_is_installed_again_from_its_origin(installed, origin, expected) -> None:
    installed(origin)
    assert requirement(install_command("plot")) == expected


def test_a_copy_from_a_clone_is_installed_again_from_the_clone(installed, tmp_path: Path) -> None:
    clone = tmp_path / "my clone"
    clone.mkdir()
    installed({"url": clone.as_uri(), "dir_info": {}})
    assert requirement(install_command("plot")) == f"{clone}[plot]"
    assert "-e" not in shlex.split(install_command("plot"))


def test_missing_packages_are_named_with_the_extra_and_the_alternative() -> None:
    known = {"numpy": "NumPy"}
    require_packages("this test", known, "plot")
    with pytest.raises(MissingDependencyError) as error:
        require_packages("this test", {**known, "nowhere": "Nowhere"}, "plot", otherwise="stop")
    message = str(error.value)
    assert message.startswith("this test: Nowhere is not installed. Run `")
    assert message.endswith("[plot]'`, or stop.")


@pytest.mark.skipif(
    not packages._extras(), reason="reads the extras of the installed package; it is not installed"
)
def test_a_failed_import_is_explained_by_the_extra_that_has_the_module() -> None:
    def extra(module: str, *preferred: str) -> str | None:
        error = missing_dependency(ModuleNotFoundError(name=module), *preferred)
        return None if error is None else str(error).rpartition("[")[2].partition("]")[0]

    assert extra("stable_baselines3.common") == "train"
    assert extra("onnxruntime") == "onnx"
    assert extra("onnxruntime", "leaderboard") == "leaderboard"  # which contains onnx
    assert extra("torch", "leaderboard") in ("offline", "train")
    assert extra("sme_registry.no_such_module") is None
    assert extra("numpy") is None


EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def plain(name: str) -> str:
    return name.lower().replace("_", "-")


def hints() -> list[tuple[str, str, list[str]]]:
    """Every place in the code that names an extra: where, the extra, the modules that it lacks."""
    found = []
    for path in (*ROOT.glob("sme_registry/**/*.py"), *ROOT.glob("leaderboard/**/*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
                continue
            where = f"{path.relative_to(ROOT)}:{node.lineno}"
            if node.func.id == "require_packages" and isinstance(node.args[2], ast.Constant):
                named = node.args[1]
                keys = named.keys if isinstance(named, ast.Dict) else []
                modules = [key.value for key in keys if isinstance(key, ast.Constant)]
                found.append((where, str(node.args[2].value), [str(each) for each in modules]))
            elif node.func.id == "install_command" and isinstance(node.args[0], ast.Constant):
                found.append((where, str(node.args[0].value), []))
    return found


@pytest.mark.skipif(not packages._extras(), reason="reads the extras of the installed package")
def test_every_hint_names_an_extra_that_has_the_missing_module() -> None:
    requirements, distributions = metadata.requires(NAME) or [], metadata.packages_distributions()
    found = hints()
    assert len(found) > 20
    for where, extra, modules in found:
        assert extra in EXTRAS, where
        for module in modules:
            needed = {plain(name) for name in closure(requirements, extra)}
            assert needed & {plain(name) for name in distributions[module]}, (where, module)


def test_the_documentation_installs_existing_extras_from_a_clone() -> None:
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*.py")]
    found = 0
    for page in pages:
        text = page.read_text()
        by_name = r"sme-registry\[([\w,]+)\]"
        assert not re.search(rf"{by_name}(?! @ )", text), f"{page}: the package is on no index"
        named = re.findall(rf"install [^\n`]*?\.\[([\w,]+)\]|{by_name}", text)
        for extras in map("".join, named):
            found += 1
            assert set(extras.split(",")) <= EXTRAS.keys(), page
    assert found > 5
