"""The tables of the finished study, and figures that are drawn and not written."""

import pytest

from sme_registry.statistics import DRAWS
from tests.studies.finished import analysed
from tests.studies.lives import live, stream_study


@pytest.fixture(scope="session")
def analysis(finished):
    """As a report makes it."""
    return analysed(finished, draws=DRAWS)


@pytest.fixture(scope="session")
def lived(once):
    """A folder with every life and fresh agent of the streams."""
    return once("lives-study", lambda folder: live(stream_study(), folder))


@pytest.fixture
def drawn(monkeypatch):
    """Every figure that a test draws. None of them is written, which takes most of the time."""
    from matplotlib.figure import Figure

    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **kw: figures.append(figure))
    return figures
