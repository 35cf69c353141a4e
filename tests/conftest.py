"""Shared by every test: Hypothesis draws the same examples on every run and machine."""

import os
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read when ONNX Runtime is imported
# One compile cache for all workers of a test run.
os.environ.setdefault(
    "SME_JAX_CACHE", str(Path(tempfile.gettempdir()) / f"sme-jax-cache-{os.getuid()}")
)

settings.register_profile(
    "deterministic", derandomize=True, deadline=None, database=None, max_examples=50
)
settings.load_profile("deterministic")


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Every figure drawn in a test, as it was when it was saved."""
    from matplotlib.figure import Figure

    drawn = []
    save = Figure.savefig

    def saving(figure: Figure, *args: Any, **kw: Any) -> Any:
        drawn.append(figure)
        return save(figure, *args, **kw)

    monkeypatch.setattr(Figure, "savefig", saving)
    return drawn
