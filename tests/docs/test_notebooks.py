"""The tutorials as notebooks: valid, and installed and executed as a reader does it."""

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

from tests.docs.conftest import PAGES, ROOT

pytest.importorskip("sphinx")

import nbformat
import tutorial_cells
from IPython.core.inputtransformer2 import TransformerManager
from packaging.requirements import Requirement

EXECUTE = """
import sys, nbclient, nbformat
notebook = nbformat.read(sys.argv[1], 4)
nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
nbformat.write(notebook, sys.argv[1])
"""


def install_cell(name):
    return tutorial_cells.as_notebook(PAGES[name]).cells[1].source


@pytest.mark.parametrize("name", PAGES)
def test_a_tutorial_is_a_valid_notebook_with_every_block_of_its_page(name):
    notebook = tutorial_cells.as_notebook(PAGES[name])
    nbformat.validate(notebook)
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    blocks = re.findall(r"^```(?:python|sh)\n(.*?)^```", PAGES[name], re.M | re.S)
    assert [source.removeprefix("%%sh -e\n") for source in code[1:]] == [b.rstrip() for b in blocks]
    for source in code:
        compile(TransformerManager().transform_cell(source), name, "exec")


@pytest.mark.parametrize("name", PAGES)
def test_the_extras_of_a_tutorial_exist_and_its_text_names_them(name):
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (extras,) = re.findall(r"^<!-- extras: (.*?) -->$", PAGES[name], re.M)
    assert set(extras.split(",")) <= set(known["optional-dependencies"])
    assert all(f"`{extra}`" in PAGES[name] for extra in extras.split(","))
    assert "](../../README.md#install)" in PAGES[name]


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
    cell = install_cell("first_agent").replace('"sme-registry"\n', f"{source!r}\n", 1)
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


def test_the_first_cell_also_installs_what_no_extra_has():
    assert install_cell("teams").count("%pip install --quiet torchrl\n") == 1
    assert "torchrl" not in install_cell("first_agent")


def test_a_source_that_does_not_exist_is_refused_with_what_to_do(monkeypatch, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.whl is missing: set SOURCE"):
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

    notebook = tutorial_cells.as_notebook(PAGES["first_agent"].replace("= 20_000", "= 1_024"))
    install = notebook.cells[1]
    install.source = install.source.replace('"sme-registry"\n', f"{str(wheel)!r}\n", 1)
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
