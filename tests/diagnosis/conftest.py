"""Figures of diagnoses are laid out and looked at; the command's own test also saves them."""

import pytest


@pytest.fixture
def laid_out(monkeypatch):
    """Every figure that a test would save, once."""
    from matplotlib.figure import Figure

    figures = []

    def keep(figure, *args, **kw):
        if figure not in figures:
            figures.append(figure)

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures
