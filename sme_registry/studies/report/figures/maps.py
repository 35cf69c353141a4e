"""Figures whose colours are similarities: by class and region, and over the plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sme_registry.errors import SMEError
from sme_registry.evaluation import as_policy
from sme_registry.plots.maps import (
    colour_scale,
    draw_similarity,
    scale_text,
    scale_ticks,
    similarity_on_grid,
)
from sme_registry.plots.style import drawing, literal, wrapped
from sme_registry.studies.report.analysis import Analysis, by_place
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import WIDTH, Picture, panel_grid

_EPSILON, _RESOLUTION, _TIME = 1.0, 120, 0.5
_BOX = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
_LUMINANCE = (0.299, 0.587, 0.114)  # of red, green and blue


def draw_regions(analysis: Analysis, formats: Sequence[str]) -> Picture:
    """Similarity of every algorithm on every class in every region: one heat map an algorithm."""
    rows = analysis.tables["regions"]
    regions = list(dict.fromkeys(rows.region))
    classes = [name for name in analysis.classes if name in set(rows.class_name)]
    heights = 0.75, 0.62 + 0.2 * len(classes)
    scale = colour_scale(rows.similarity)
    with panel_grid(len(analysis.algorithms), formats, heights) as grid:
        for axes, name in zip(grid.panels, analysis.algorithms, strict=True):
            selected = rows[rows.algorithm == name]
            values = selected.pivot(index="class_name", columns="region", values="similarity")
            values = values.reindex(index=classes, columns=regions)
            image = _heat_map(axes, values.to_numpy(), scale)
            axes.set_title(literal(name))
            axes.set_xticks(range(len(regions)), [region.replace("OOD ", "") for region in regions])
            axes.set_yticks(range(len(classes)), classes, fontsize=8)
        bar = grid.figure.colorbar(
            image, ax=grid.panels, location="bottom", shrink=0.5, aspect=40, pad=0.02,
            label="similarity r̃ (IQM over runs) in WD and in the shells OOD 1, 2, …; "
            + scale_text(scale), ticks=scale_ticks(scale),
        )  # fmt: skip
        bar.outline.set_visible(False)
    return Picture(
        "regions",
        "Similarity within and out of distribution",
        "IQM over runs of r̃, 1 for the optimum, in the unit cube (WD) and in each shell around "
        f"it. A dash: no run has finished.{panels.epsilon_remark(analysis)}",
        grid.files,
        is_map=True,
    )


def _heat_map(axes: Any, values: Any, scale: tuple[float, float]) -> Any:
    """`[class, region]` similarities as an image with their numbers."""
    image = axes.imshow(values, vmin=scale[0], vmax=scale[1], cmap="viridis", aspect="auto")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    digits = 2 if scale[1] - scale[0] > 0.11 else 3
    for (y, x), value in np.ndenumerate(values):
        known = not np.isnan(value)
        dark = known and np.dot(image.to_rgba(value)[:3], _LUMINANCE) < 0.5
        text = f"{value:.{digits}f}".removeprefix("0") if known else "–"
        colour = "white" if dark else "black"
        axes.text(x, y, text, ha="center", va="center", fontsize=7.5, color=colour)
    return image


def draw_maps(
    analysis: Analysis, formats: Sequence[str], models: Mapping[str, Path]
) -> Picture | str:
    """One map a class and algorithm whose models were kept, or the reason why there is none."""
    inside = analysis.tables["results"][analysis.tables["results"].region == "WD"]
    single = [name for name, info in analysis.classes.items() if info.setting["team"] == "none"]
    plane = inside[(inside.state_dim == 2) & inside.class_name.isin(single)]
    if plane.empty:
        return "No maps of the plane: no finished run has a task with two state channels."
    maps, problem = _maps(analysis, plane[plane.key.isin(models)], models)
    if not maps:
        return (
            "No maps of the plane: they need trained models. Run the study with --keep-models in a "
            f"new folder.{problem}"
        )
    classes = list(dict.fromkeys(class_name for class_name, _ in maps))
    names = list(dict.fromkeys(algorithm for _, algorithm in maps))
    scale = colour_scale([grid for grid, _ in maps.values()])
    size = (min(WIDTH, 1.4 + 2.0 * len(classes)), 0.5 + 1.95 * len(names))
    with drawing(size, formats) as (figure, files):
        panels = figure.subplots(len(names), len(classes), squeeze=False, sharex=True, sharey=True)
        image: Any = None
        for (y, x), axes in np.ndenumerate(panels):
            axes.set_xticks([0, 1])
            axes.set_yticks([0, 1])
            if y == 0:
                axes.set_title(classes[x])
            if x == 0:
                axes.set_ylabel(wrapped(literal(names[y]), 1.7))
            if (classes[x], names[y]) not in maps:
                axes.set_axis_off()
                continue
            similarity, inside = maps[classes[x], names[y]]
            image = draw_similarity(axes, similarity, _EPSILON, scale)
            axes.text(
                0.03, 0.03, f"WD {inside:.2f}", transform=axes.transAxes, fontsize=7.5, bbox=_BOX,
                color="black",
            )  # fmt: skip
        bar = figure.colorbar(
            image, ax=panels, label=f"similarity r̃; {scale_text(scale)}", shrink=0.8,
            ticks=scale_ticks(scale),
        )  # fmt: skip
        bar.outline.set_visible(False)
    return Picture(
        "maps",
        "Similarity over the plane, beyond the unit square",
        "r̃ of a trained policy at each state of the plane, halfway through the episode; the square "
        "is the unit square, where it was trained. For each algorithm the run with the median r̃ "
        f"within distribution, among those whose model was kept.{problem}",
        files,
        is_map=True,
    )


def _maps(
    analysis: Analysis, runs: pd.DataFrame, models: Mapping[str, Path]
) -> tuple[dict[tuple[str, str], tuple[Any, float]], str]:
    """(class, algorithm) → its median run's map and WD similarity; and the last problem."""
    maps, problem = {}, ""
    for place, group in by_place(runs).items():
        median = group.sort_values(["similarity", "run"]).iloc[(len(group) - 1) // 2]
        spec = analysis.cells[median.key].cell.spec
        try:
            policy = as_policy(models[median.key], spec)
            _, grid = similarity_on_grid(policy, spec, _EPSILON, _RESOLUTION, _TIME)
            maps[place] = grid, median.similarity
        except SMEError as error:
            problem = f" {error}"
    return maps, problem
