"""Each back-end in turn, for environments that a test makes."""

import pytest


@pytest.fixture(params=["numba", "numpy"])
def backend(request, monkeypatch):
    if request.param == "numba":
        pytest.importorskip("numba")
    monkeypatch.setenv("SME_BACKEND", request.param)
