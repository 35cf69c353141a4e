"""The change that each class makes, with its interval."""

from __future__ import annotations

from collections.abc import Sequence

from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Picture
from sme_registry.studies.report.tables import ENOUGH_RUNS, Metric


def draw_contrasts(
    analysis: Analysis, formats: Sequence[str], metrics: Sequence[Metric], name: str
) -> Picture | str:
    """One panel a metric, one row a class; a sentence where there is no contrast."""
    rows = analysis.contrasts[analysis.contrasts.metric.isin([m.key for m in metrics])]
    if rows.empty:
        return (
            "No contrasts: they need finished runs of one number on the first class and on another."
        )
    looks = {a: look for a, look in panels.looks(analysis).items() if a in set(rows.algorithm)}
    axes_of = {c: analysis.classes[c].axis for c in analysis.classes if c in set(rows.class_name)}
    place = _places(axes_of)
    height = 1.15 + (0.07 * len(looks) + 0.09) * max(5.0, max(place.values()) + 1)
    with panels.panel_grid(len(metrics), formats, (0.0, height)) as (grid, files):
        for axes, metric in zip(grid.panels, metrics, strict=True):
            selected = rows[rows.metric == metric.key]
            at = selected.class_name.map(place)
            panels.marks_by_algorithm(axes, selected, "change", at, selected.enough_pairs, looks)
            axes.axvline(0.0, color="black", linewidth=0.9, zorder=1.5)
            side = "right" if metric.worse > 0 else "left"
            axes.set_xlabel(f"change of\n{metric.label}\n(worse to the {side})")
            axes.locator_params(axis="x", nbins=15 // len(metrics))
            panels.shade_rows(axes, place.values())
        grid.panels[0].set_yticks([*place.values()], [*place], fontsize=8)
        grid.panels[0].set_ylim(max(place.values()) + 0.6, -0.6)
        panels.legend(grid.figure, looks)
    names = [metric.label.partition(",")[0] for metric in metrics]
    return Picture(
        name,
        f"What each class changes: {', '.join(names[:-1])} and {names[-1]}",
        f"IQM over runs of the change from the first class, {analysis.base}, to each other class, "
        "each run compared with the run of the same number, with its 95 % bootstrap interval. "
        f"Hollow: fewer than {ENOUGH_RUNS} pairs, so that the interval is an indication only.",
        files,
    )


def _places(axes: dict[str, str]) -> dict[str, float]:
    """The height of each class's row, with a gap between axes."""
    places: dict[str, float] = {}
    y, last = -1.0, None
    for name, axis in axes.items():
        y += 1.0 if last in (None, axis) else 1.4
        places[name], last = y, axis
    return places
