"""The import contract of pyproject.toml holds, and would notice if it did not."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def lint_imports(folder):
    """Run import-linter on the `sme_registry` of a folder, by the pyproject.toml beside it."""
    return subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )


AT_THE_TOP = {
    "spec/document.py": "sme_registry.task",
    "task/task.py": "torch",
    "task/engine.py": "numba",
    "envs/single.py": "pygame",
    "plots/style.py": "stable_baselines3",
    "studies/runner.py": "pandas",
    "teams.py": "sme_registry.registration",
    "io/files.py": "sme_registry.spec",
}
IN_A_FUNCTION = {
    "errors.py": "sme_registry.registration",
    "envs/arguments.py": "matplotlib",
    "evaluation/references.py": "torch",
    "evaluation/policies.py": "onnxruntime",
    "evaluation/evaluate.py": "pandas",
}


@pytest.fixture
def copy(tmp_path):
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for package in ("sme_registry", "leaderboard"):
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, tmp_path / package, ignore=ignore)
    return tmp_path


def test_the_import_contract_holds():
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


def test_every_import_against_the_order_is_named(copy):
    planted = {module: f"import {name}" for module, name in AT_THE_TOP.items()}
    planted |= {m: f"def _late():\n    import {name}" for m, name in IN_A_FUNCTION.items()}
    for module, text in planted.items():
        path = copy / "sme_registry" / module
        path.write_text(f"{path.read_text()}\n{text}\n")
    result = lint_imports(copy)
    assert result.returncode == 1, result.stdout + result.stderr
    for module, imported in (AT_THE_TOP | IN_A_FUNCTION).items():
        importer = module.removesuffix(".py").replace("/", ".")
        assert f"sme_registry.{importer} -> {imported} (" in result.stdout, module


def test_a_module_without_a_place_in_the_order_breaks_the_contract(copy):
    (copy / "sme_registry" / "unplaced.py").write_text("import sme_registry.errors\n")
    result = lint_imports(copy)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "unplaced" in result.stdout


HEAVY = {
    "torch", "jax", "ray", "matplotlib", "numba", "scipy.stats", "stable_baselines3", "pygame",
    "pandas", "h5py", "minari", "d3rlpy", "onnxruntime", "typer", "filelock", "jinja2",
}  # fmt: skip


def run(script):
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_importing_the_package_loads_nothing_heavy():
    loaded = set(run("import json, sys, sme_registry; print(json.dumps(list(sys.modules)))"))
    assert "sme_registry" in loaded
    assert not loaded & HEAVY


def test_making_and_stepping_with_numpy_loads_nothing_heavy():
    script = (
        "import os; os.environ['SME_BACKEND'] = 'numpy'\n"
        "import json, sys, gymnasium, sme_registry\n"
        "env = gymnasium.make('SME/Default-v1'); env.reset(seed=0)\n"
        "env.step(env.action_space.sample())\n"
        "print(json.dumps(list(sys.modules)))"
    )
    assert not set(run(script)) & HEAVY


WITHOUT_POSIX = """
import importlib, os, pkgutil, signal, sys

# As on Windows. What other packages need of these they have loaded before.
import sme_registry, filelock, multiprocessing.resource_tracker, subprocess, tempfile
for name in ("stable_baselines3", "minari", "numba"):
    try:
        importlib.import_module(name)
    except ImportError:
        pass
for name in [name for name in sys.modules if name.split(".")[0] == "sme_registry"]:
    del sys.modules[name]
for name in ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"):
    sys.modules[name] = None
for name in ("pthread_sigmask", "SIGKILL", "SIGHUP", "SIGALRM", "alarm", "setitimer"):
    delattr(signal, name)
for name in ("fork", "geteuid", "getuid", "fchmod", "killpg", "setsid", "O_DIRECTORY"):
    delattr(os, name)

import sme_registry
for module in pkgutil.walk_packages(sme_registry.__path__, "sme_registry."):
    importlib.import_module(module.name)
"""


def test_every_module_is_imported_without_posix():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_POSIX],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stderr
