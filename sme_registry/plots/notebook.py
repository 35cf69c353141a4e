"""The class of new figures, which a notebook shows without pyplot."""

from __future__ import annotations

from matplotlib.figure import Figure


class NotebookFigure(Figure):
    """A Matplotlib figure that is shown where it is the last value of a notebook's cell."""

    def _repr_png_(self) -> bytes:
        from sme_registry.plots.style import encoded

        return encoded(self, ["png"])["png"]
