"""A study that has been run, once for all tests that look at one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.studies.finished import finish


@pytest.fixture(scope="session")
def finished(once: Any) -> Path:
    """A folder with results; of Beta on k-25 two runs are missing, of which one failed."""
    pytest.importorskip("stable_baselines3")
    folder: Path = once("finished-study", finish)
    return folder
