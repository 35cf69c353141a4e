"""Similarity of every algorithm on every class in every region."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sme_registry.evaluation.report import NOT_COMPARABLE
from sme_registry.plots import literal
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Picture

_LUMINANCE = (0.299, 0.587, 0.114)  # of red, green and blue


def draw_regions(analysis: Analysis, formats: Sequence[str]) -> Picture | str:
    """One heat map an algorithm; a sentence where no run has finished."""
    rows = analysis.regions
    if rows.empty:
        return "No table of regions: no run has finished."
    regions = list(dict.fromkeys(rows.region))
    classes = [name for name in analysis.classes if name in set(rows.class_name)]
    heights = 0.75, 0.62 + 0.2 * len(classes)
    with panels.panel_grid(len(analysis.algorithms), formats, heights) as (grid, files):
        for axes, name in zip(grid.panels, analysis.algorithms, strict=True):
            selected = rows[rows.algorithm == name]
            values = selected.pivot(index="class_name", columns="region", values="similarity")
            image = _heat_map(axes, values.reindex(index=classes, columns=regions).to_numpy())
            axes.set_title(literal(name))
            axes.set_xticks(range(len(regions)), [region.replace("OOD ", "") for region in regions])
            axes.set_yticks(range(len(classes)), classes, fontsize=8)
        bar = grid.figure.colorbar(
            image, ax=grid.panels, location="bottom", shrink=0.5, aspect=40, pad=0.02,
            label="similarity r̃ (IQM over runs) in WD and in the shells OOD 1, 2, …", extend="min",
        )  # fmt: skip
        bar.outline.set_visible(False)
    return Picture(
        "regions",
        "Similarity within and out of distribution",
        "IQM over runs of r̃, 1 for the optimum, in the unit cube (WD) and in each shell around "
        f"it. A dash: no run has finished. {NOT_COMPARABLE}",
        files,
        is_map=True,
    )


def _heat_map(axes: Any, values: Any) -> Any:
    """`[class, region]` similarities as an image with their numbers."""
    image = axes.imshow(values, vmin=0.4, vmax=1.0, cmap="viridis", aspect="auto")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    for (y, x), value in np.ndenumerate(values):
        known = not np.isnan(value)
        dark = known and np.dot(image.to_rgba(value)[:3], _LUMINANCE) < 0.5
        text = f"{value:.2f}"[1 - (value >= 0.995) :] if known else "–"
        colour = "white" if dark else "black"
        axes.text(x, y, text, ha="center", va="center", fontsize=7.5, color=colour)
    return image
