"""Which command installs a missing package."""

import ast
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

import sme_registry
from sme_registry.errors import MissingDependencyError
from sme_registry.io import missing_dependency, require_packages, system
from tests.wheel.test_extras import closure, normalised

ROOT = Path(sme_registry.__file__).parents[1]


def test_missing_packages_are_named_with_the_extra_and_the_alternative():
    known = {"numpy": "NumPy"}
    require_packages("this test", known, "plot")
    with pytest.raises(MissingDependencyError) as error:
        require_packages("this test", {**known, "nowhere": "Nowhere"}, "plot", otherwise="stop")
    message = str(error.value)
    assert message == (
        "this test: Nowhere is not installed. Run `pip install 'sme-registry[plot]'`, or stop."
    )


@pytest.mark.skipif(
    not system._extras(), reason="reads the extras of the installed package; it is not installed"
)
def test_a_failed_import_is_explained_by_the_extra_that_has_the_module():
    def extra(module, *preferred):
        error = missing_dependency(ModuleNotFoundError(name=module), *preferred)
        return None if error is None else str(error).rpartition("[")[2].partition("]")[0]

    assert extra("stable_baselines3.common") == "train"
    assert extra("onnxruntime") == "onnx"
    assert extra("onnxruntime", "leaderboard") == "leaderboard"  # which contains onnx
    assert extra("torch", "leaderboard") in ("offline", "train")
    assert extra("sme_registry.no_such_module") is None
    assert extra("numpy") is None


EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def hints():
    """Every place in the code that names an extra: where, the extra, the modules that it lacks."""
    found = []
    for path in (*ROOT.glob("sme_registry/**/*.py"), *ROOT.glob("leaderboard/**/*.py")):
        text = path.read_text()
        if "require_packages(" not in text and "install_command(" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
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


@pytest.mark.skipif(not system._extras(), reason="reads the extras of the installed package")
def test_every_hint_names_an_extra_that_has_the_missing_module():
    pytest.importorskip("matplotlib")  # of an extra; they are installed together
    distributions, found = metadata.packages_distributions(), hints()
    assert len(found) > 20
    assert {extra for _, extra, _ in found} <= EXTRAS.keys()
    needed = {extra: closure(extra) for _, extra, modules in found if modules}
    for where, extra, modules in found:
        for module in modules:
            assert needed[extra] & set(map(normalised, distributions[module])), (where, module)


def test_the_documentation_installs_existing_extras_from_a_clone():
    globs = ("*.md", "docs/**/*.md", "docs/tutorials/*.ipynb", "examples/*.py")
    pages = [page for pattern in globs for page in ROOT.glob(pattern)]
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
