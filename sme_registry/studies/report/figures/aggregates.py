"""The IQM of 1 − normalised regret over each group of classes."""

from __future__ import annotations

from collections.abc import Sequence

from sme_registry.plots import literal
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Picture
from sme_registry.studies.report.tables import ENOUGH_RUNS, REGRET_METRICS


def draw_aggregates(analysis: Analysis, formats: Sequence[str]) -> Picture | str:
    """WD and OOD side by side, one row a group; a sentence where no class can be compared."""
    rows = analysis.aggregates[analysis.aggregates.statistic == "iqm"]
    if rows.empty:
        return "No aggregates over classes: no class has runs of every algorithm."
    place = {group: float(i) for i, group in enumerate(dict.fromkeys(rows.group))}
    looks = panels.looks(analysis)
    height = 1.1 + (0.09 * len(looks) + 0.1) * max(2, len(place))
    with panels.panel_grid(2, formats, (0.0, height)) as (grid, files):
        for axes, metric in zip(grid.panels, REGRET_METRICS, strict=True):
            selected = rows[rows.metric == metric.key]
            enough = selected.fewest_runs >= ENOUGH_RUNS
            panels.marks_by_algorithm(
                axes, selected, "value", selected.group.map(place), enough, looks
            )
            axes.set_title(panels.HEADINGS[metric.key], fontsize=9)
            axes.set_xlabel("IQM of 1 − normalised regret")
            panels.shade_rows(axes, place.values())
        labels = [literal(group) for group in place]
        grid.panels[0].set_yticks([*place.values()], labels, fontsize=8)
        grid.panels[0].set_ylim(len(place) - 0.4, -0.6)
        panels.legend(grid.figure, looks)
    return Picture(
        "aggregates",
        "Aggregates over kinds of tasks",
        "Mean over classes of the IQM over runs, with its 95 % stratified bootstrap interval: "
        "1 is the optimum, 0 the constant ½. The classes of an axis include the first class.",
        files,
    )
