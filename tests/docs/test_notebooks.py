"""The tutorials: with the outputs of their code, and installed and executed as a reader does it."""

import copy
import importlib.util
import json
import os
import re
import shlex
import site
import subprocess
import sys
import tomllib
import venv

import pytest

from tests.docs.conftest import ROOT, TUTORIALS

pytest.importorskip("sphinx")
pytest.importorskip("PIL")

import nbformat
import notebooks
from IPython.core.inputtransformer2 import TransformerManager
from packaging.requirements import Requirement

EXECUTE = """
import sys, nbclient, nbformat
notebook = nbformat.read(sys.argv[1], 4)
nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
nbformat.write(notebook, sys.argv[1])
"""


def read(name):
    return nbformat.read(TUTORIALS[name], as_version=4)


@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_has_the_outputs_of_its_code_and_nothing_of_the_machine(name):
    notebook, text = read(name), TUTORIALS[name].read_text(encoding="utf-8")
    nbformat.validate(notebook)
    assert notebooks.is_current(notebook), f"run `python docs/notebooks.py {name}`"
    assert len(text.encode()) < 300_000
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert {output.output_type for output in outputs}.isdisjoint({"error"})
    for output in outputs:
        shown = json.dumps({k: v for k, v in output.get("data", {}).items() if k != "image/png"})
        assert not re.search(
            r"/(tmp|home|root|work|Users)/|\x1b|\r", shown + output.get("text", "")
        )


def test_outputs_are_not_those_of_the_code_if_a_cell_has_changed_or_an_output_is_missing():
    notebook = read("first_agent")
    without, other, prose = (copy.deepcopy(notebook) for _ in range(3))
    code = [cell for cell in without.cells if cell.get("outputs")]
    code[-1].outputs = []
    other.cells[-2].source += " "
    assert other.cells[-2].cell_type == "code"
    prose.cells[0].source += "."
    current = map(notebooks.is_current, (notebook, prose, without, other))
    assert list(current) == [True, True, False, False]


@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_installs_first_what_its_text_names(name):
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    title, install = read(name).cells[:2]
    (extras,) = re.findall(r'"sme-registry\[(.*?)\] @ \{address\}"', install.source)
    assert set(extras.split(",")) <= set(known["optional-dependencies"])
    assert all(f"`{extra}`" in title.source for extra in extras.split(","))
    assert install.source.replace(extras, "") == read("teams").cells[1].source.replace(
        "fast,plot,train", ""
    )


def requirement(source, monkeypatch, tmp_path):
    """What the first cell tells pip to install, where the package is missing."""

    class Shell:
        def run_line_magic(self, name, line):
            assert name == "pip"
            commands.append(line.format(**namespace))  # as IPython does

    commands, namespace = [], {"get_ipython": Shell}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", os.environ["PATH"])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    cell = read("first_agent").cells[1].source.replace('"sme-registry"\n', f"{source!r}\n", 1)
    exec(TransformerManager().transform_cell(cell), namespace)
    return Requirement(shlex.split(commands[0])[-1])


@pytest.mark.parametrize("source", ["a clone", "sme_registry-0.1.0-py3-none-any.whl"])
def test_the_first_cell_installs_a_clone_or_a_wheel_with_the_extras(source, monkeypatch, tmp_path):
    (tmp_path / source).mkdir()
    wanted = requirement(source, monkeypatch, tmp_path)
    assert (wanted.name, wanted.extras) == ("sme-registry", {"fast", "plot", "train"})
    assert wanted.url == (tmp_path / source).as_uri()


def test_the_first_cell_installs_from_a_git_address(monkeypatch, tmp_path):
    address = "git+https://example.org/sme-registry.git@v0.1.0"
    assert requirement(address, monkeypatch, tmp_path).url == address


def test_a_source_that_does_not_exist_is_refused_with_its_path(monkeypatch, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.whl"):
        requirement("none.whl", monkeypatch, tmp_path)


def test_a_notebook_installs_the_wheel_and_runs_in_a_fresh_environment(tmp_path):
    for package in ("nbclient", "torch", "matplotlib", "hatchling"):
        pytest.importorskip(package)
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    venv.create(tmp_path / "venv", with_pip=False)
    (python,) = (tmp_path / "venv" / "bin").glob("python")
    (packages,) = (tmp_path / "venv").glob("lib/*/site-packages")
    # The dependencies of this environment without the package: nested path files are not read.
    (packages / "dependencies.pth").write_text("\n".join(site.getsitepackages()))

    notebook = read("first_agent")
    for cell in notebook.cells:
        cell.source = cell.source.replace("STEPS = 20_000", "STEPS = 1_024")
        cell.source = cell.source.replace('"sme-registry"\n', f"{str(wheel)!r}\n", 1)
    file = tmp_path / "first_agent.ipynb"
    nbformat.write(notebook, file)
    outside = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MPLBACKEND")}
    done = subprocess.run(
        [python, "-c", EXECUTE, file],
        cwd=tmp_path,
        env={**outside, "PIP_NO_INDEX": "1", "SME_BACKEND": "numpy"},  # without compiling anew
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (packages / "sme_registry" / "__init__.py").exists()
    outputs = json.dumps([c.get("outputs") for c in json.loads(file.read_text())["cells"]])
    assert "optimal   0.000" in outputs
    assert outputs.count("image/png") == 2
