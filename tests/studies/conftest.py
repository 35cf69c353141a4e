"""A study that has been run, once for all tests that look at one."""

from __future__ import annotations

from pathlib import Path

import pytest

from sme_registry.studies.engine.result import CellFailure
from tests.studies.finished import finish, study_file


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with results; of Beta on k-25 two runs are missing, of which one failed."""
    pytest.importorskip("stable_baselines3")
    folder = tmp_path_factory.mktemp("study")
    file = study_file()
    gaps = [
        cell for cell in file.plan.cells
        if (cell.class_name, cell.algorithm) == ("k-25", "Beta") and cell.run > 2
    ]  # fmt: skip
    ledger = finish(file, folder, lambda planned: planned in gaps)
    cell, error = gaps[0].cell, "ValueError: <b>bad</b>"
    ledger.write(CellFailure(key=cell.digest, cell=cell, error=error, traceback="", versions={}))
    return folder
