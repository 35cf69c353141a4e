"""The tables of the finished study, and figures that are drawn and not written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sme_registry.statistics import DRAWS
from sme_registry.studies.report.analysis import Analysis
from tests.studies.finished import analysed


@pytest.fixture(scope="session")
def analysis(finished: Path) -> Analysis:
    """As a report makes it."""
    return analysed(finished, draws=DRAWS)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Every figure that a test draws. None of them is written, which takes most of the time."""
    from matplotlib.figure import Figure

    figures: list[Any] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **kw: figures.append(figure))
    return figures
