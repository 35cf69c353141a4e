"""Normalised regret along each axis, between the references."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sme_registry.evaluation.report import NOT_COMPARABLE
from sme_registry.plots import GREY, literal
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import AXES, SEVERAL, Group
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Look, Picture
from sme_registry.studies.report.tables import ENOUGH_RUNS, Metric


def draw_regret(analysis: Analysis, formats: Sequence[str], metric: Metric) -> Picture | str:
    """One panel an axis; a sentence where no run has finished."""
    groups = [group for group in analysis.groups if group.axis] or list(analysis.groups)
    if not groups:
        return "No normalised regret: no run has finished."
    names = analysis.learners or analysis.algorithms
    looks = {name: look for name, look in panels.looks(analysis).items() if name in names}
    with panels.panel_grid(len(groups), formats, (0.7, 2.3)) as (grid, files):
        for axes, group in zip(grid.panels, groups, strict=True):
            _draw_axis(axes, analysis, group, metric, looks)
        grid.panels[0].set_ylim(bottom=0.0)  # last: it ends autoscaling, for all panels
        grid.label_rows("normalised regret")
        references = {
            "linear (LSQ)": (GREY, panels.LINEAR_DASH),
            "constant ½": (GREY, panels.CONSTANT_DASH),
        }
        panels.legend(grid.figure, looks, references)
    return Picture(
        metric.key.replace("_", "-"),
        f"Normalised regret {panels.HEADINGS[metric.key]}, along each axis",
        "IQM over runs with its 95 % bootstrap interval: 0 is the optimum, 1 the constant "
        "action ½, the dashed line the linear least-squares policy fitted to the optimum. "
        f"Hollow: fewer than {ENOUGH_RUNS} runs."
        + (f" {NOT_COMPARABLE}" if metric.key == "ood_regret" else ""),
        files,
    )


def _draw_axis(
    axes: Any, analysis: Analysis, group: Group, metric: Metric, looks: Mapping[str, Look]
) -> None:
    """The classes of one axis, in the order of its values."""
    x = {name: i for i, name in enumerate(group.classes)}
    levels = analysis.levels[
        (analysis.levels.metric == metric.key) & analysis.levels.class_name.isin(x)
    ]
    levels = levels.sort_values("class_name", key=lambda names: names.map(x), kind="stable")
    at = levels.class_name.map(x)
    ordered = group.axis not in ("", SEVERAL)
    linear = levels.drop_duplicates("class_name", keep="last")
    axes.plot(
        at[linear.index], linear.linear, color=GREY, linewidth=1.2, markersize=14, zorder=1.6,
        linestyle=panels.LINEAR_DASH if ordered else "none", marker="" if ordered else "_",
    )  # fmt: skip
    axes.axhline(1.0, color=GREY, linewidth=1.2, linestyle=panels.CONSTANT_DASH, zorder=1.6)
    panels.marks_by_algorithm(
        axes, levels, "iqm", at, levels.runs >= ENOUGH_RUNS, looks, spread=0.5, upright=True,
        joined=ordered,
    )  # fmt: skip
    axes.set_xticks(
        range(len(group.classes)),
        [literal(_tick(analysis, name, group)) for name in group.classes],
        **({} if ordered else {"rotation": 30, "ha": "right", "fontsize": 8}),
    )
    axes.set_title(literal(group.name), fontsize=9)
    axes.set_xlim(-0.5, len(group.classes) - 0.5)
    axes.grid(visible=False, axis="x")


def _tick(analysis: Analysis, class_name: str, group: Group) -> str:
    """The value of the axis in a class: `25`; the class's name where there is no axis."""
    if group.axis not in AXES:
        return class_name
    value = analysis.classes[class_name].setting[group.axis]
    return value if isinstance(value, str) else f"{value:g}"
