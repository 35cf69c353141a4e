"""A finished run with figures, shared by the tests of training; runs of single tests draw none."""

import pytest

from tests.training.runs import short, without_figures


@pytest.fixture(scope="package")
def run(tmp_path_factory):
    return short(tmp_path_factory.mktemp("run"), checkpoint_every=100)


@pytest.fixture(autouse=True)
def _no_figures():
    with without_figures():
        yield
