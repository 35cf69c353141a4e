"""How probably a run of one algorithm beats a run of another."""

from __future__ import annotations

from collections.abc import Sequence

from sme_registry.plots import GREY, literal
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import ALL
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Look, Picture
from sme_registry.studies.report.tables import ENOUGH_RUNS, REGRET_METRICS


def draw_improvements(analysis: Analysis, formats: Sequence[str]) -> Picture | str:
    """WD and OOD side by side, one row a pair; a sentence where there is no pair."""
    rows = analysis.improvements[analysis.improvements.group == ALL]
    if rows.empty:
        return (
            "No comparison of algorithms: no two of them have runs on the same classes and, if "
            "they learn from data, the same data."
        )
    pairs = rows["first"] + " over " + rows["second"]
    place = {pair: float(i) for i, pair in enumerate(dict.fromkeys(pairs))}
    with panels.panel_grid(2, formats, (1.0, 0.26 * max(3, len(place)))) as (grid, files):
        for axes, metric in zip(grid.panels, REGRET_METRICS, strict=True):
            selected = rows[rows.metric == metric.key]
            at, enough = pairs[selected.index].map(place), selected.fewest_runs >= ENOUGH_RUNS
            panels.marks(axes, selected, "probability", at, enough, Look("black", "o", "-"))
            axes.axvline(0.5, color=GREY, linewidth=1.0, zorder=1.5)
            axes.set_xlim(-0.02, 1.02)
            axes.set_title(panels.HEADINGS[metric.key], fontsize=9)
            axes.set_xlabel("P(a run of X beats a run of Y)")
            axes.grid(visible=False, axis="y")
            axes.tick_params(axis="y", length=0)
        grid.panels[0].set_yticks([*place.values()], [literal(pair) for pair in place])
        grid.panels[0].set_ylim(len(place) - 0.5, -0.5)
    caption = (
        "How probably a run of the first algorithm beats a run of the second on a class drawn at "
        "random, with its 95 % interval: ½ where neither is better."
    )
    if analysis.has_offline_runs:
        caption += " Algorithms that learnt from different data are not compared."
    return Picture("improvements", "Probability of improvement", caption, files)
