"""A finished run, shared by the tests of training."""

from __future__ import annotations

import pytest

from sme_registry.training import TrainingResult
from tests.training.runs import short


@pytest.fixture(scope="package")
def run(tmp_path_factory: pytest.TempPathFactory) -> TrainingResult:
    return short(tmp_path_factory.mktemp("run"), checkpoint_every=100)
