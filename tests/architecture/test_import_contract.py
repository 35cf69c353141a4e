"""The import contract of pyproject.toml holds, and would notice if it did not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the `sme_registry` of a folder, by the pyproject.toml beside it."""
    return subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    shutil.copytree(
        ROOT / "sme_registry",
        tmp_path / "sme_registry",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    return tmp_path


def test_the_import_contract_holds() -> None:
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    ("module", "planted"),
    [
        ("spec/document.py", "from sme_registry.task import Task"),
        ("errors.py", "def _late():\n    import sme_registry.registration"),
        ("task/step.py", "import torch"),
        ("envs/arguments.py", "def _late():\n    import matplotlib.pyplot"),
        ("compiled/engine.py", "import numba"),
        ("envs/single.py", "import pygame"),
        ("evaluation/references.py", "def _late():\n    import torch"),
        ("plots/style.py", "import stable_baselines3"),
        ("evaluation/policies/policy.py", "def _late():\n    import onnxruntime"),
        ("evaluation/evaluate.py", "def _late():\n    import pandas"),
        ("studies/engine/runner.py", "import pandas"),
        ("teams.py", "import sme_registry.registration"),
        ("io/locks.py", "import sme_registry.terminal"),
        ("unplaced.py", "import sme_registry.errors"),
    ],
)
def test_an_import_against_the_order_breaks_the_contract(
    copy: Path, module: str, planted: str
) -> None:
    path = copy / "sme_registry" / module
    path.write_text(f"{path.read_text() if path.exists() else ''}\n{planted}\n")
    result = lint_imports(copy)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "BROKEN" in result.stdout
