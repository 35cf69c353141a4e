"""Figures with several algorithms in each panel: their paired differences and learning curves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sme_registry.plots.style import literal
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import ALL
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.comparisons import class_places, name_rows
from sme_registry.studies.report.figures.curves import curves_caption, line_with_band, step_text
from sme_registry.studies.report.figures.panels import Picture
from sme_registry.studies.report.tables import CURVES, ENOUGH_RUNS, METRICS

_DRAWN = METRICS[:2]
_MEASURE = "regret"


def draw_differences(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """The paired difference of each algorithm from the first one, one row a class."""
    rows = analysis.differences
    first = analysis.algorithms[0]
    rows = rows[(rows["first"] == first) & rows.metric.isin([metric.key for metric in _DRAWN])]
    rows = rows.assign(algorithm=rows.second)
    looks = {a: look for a, look in panels.looks(analysis).items() if a in set(rows.second)}
    if not looks:
        return
    place = class_places(analysis, set(rows.class_name))
    if ALL in set(rows.class_name):
        place[ALL] = max(place.values()) + 1.4
    height = 1.3 + (0.07 * len(looks) + 0.12) * max(4.0, max(place.values()) + 1)
    with panels.panel_grid(len(_DRAWN), formats, (0.0, height), share_x=True) as grid:
        for axes, metric in zip(grid.panels, _DRAWN, strict=True):
            selected = rows[rows.metric == metric.key]
            at, enough = selected.class_name.map(place), selected.enough_pairs
            panels.marks_by_algorithm(axes, selected, "difference", at, enough, looks)
            axes.axvline(0.0, color="black", linewidth=0.9, zorder=1.5)
            other = literal(next(iter(looks))) if len(looks) == 1 else "the other"
            axes.set_title(metric.label, fontsize=9)
            axes.set_xlabel(f"{literal(first)} − {other}\n(left: {literal(first)} is better)")
            axes.locator_params(axis="x", nbins=6)
        name_rows(grid, place)
        if len(looks) > 1:
            panels.legend(grid.figure, looks)
    yield Picture(
        "differences",
        f"Paired differences from {first}",
        f"IQM over pairs of runs of the difference {first} minus "
        + ("the other algorithm" if len(looks) > 1 else next(iter(looks)))
        + ", with its 95 % bootstrap interval. The runs of a pair have the same instance and seed. "
        f"Hollow: fewer than {ENOUGH_RUNS} pairs, so that the interval is an indication only.",
        grid.files,
    )


def draw_class_curves(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """Learning curves with a panel for each class and all algorithms in it."""
    rows = analysis.learning_curves
    rows = rows[(rows.measure == _MEASURE) & rows.algorithm.isin(analysis.learners)]
    classes = list(dict.fromkeys(rows.class_name))
    looks = {a: look for a, look in panels.looks(analysis).items() if a in set(rows.algorithm)}
    if len(looks) < 2:
        return
    with panels.panel_grid(len(classes), formats, (0.8, 1.9)) as grid:
        for axes, class_name in zip(grid.panels, classes, strict=True):
            for index, (name, look) in enumerate(looks.items()):
                curve = rows[(rows.class_name == class_name) & (rows.algorithm == name)]
                every = max(1, len(curve) // 6)
                begin = index * every // len(looks)
                columns = ["step", "q25", "median", "q75"]
                line_with_band(axes, curve[columns], look, (begin, every))
            info = analysis.classes[class_name]
            axes.set_title(literal(f"{class_name} ({info.label})" if info.label else class_name))
            axes.title.set_fontsize(9)
            axes.set_xlim(left=0)
            axes.locator_params(axis="x", nbins=4)
            axes.xaxis.set_major_formatter(step_text)
            axes.set_xlabel("steps")
        grid.label_rows(CURVES[_MEASURE])
        panels.legend(grid.figure, looks)
    yield Picture(
        "learning-curves-by-class",
        "Learning curves of all algorithms by class",
        f"{curves_caption(rows)} Mean exact regret per step, 0 for the optimum.",
        grid.files,
    )
