"""A study that has been run, once for all tests that look at one."""

import pytest

from tests.studies.finished import finish


@pytest.fixture(scope="session")
def finished(once):
    """A folder with results; of Beta on k-25 two runs are missing, of which one failed."""
    pytest.importorskip("stable_baselines3")
    return once("finished-study", finish)
