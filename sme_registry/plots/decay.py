"""`decay_curve`: similarity and normalised regret over the regions, of one or more policies."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport
from sme_registry.evaluation.references import LABELS
from sme_registry.plots.methods import Method, Reports, levels, methods_of, only_title
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    canvas,
    draw_band,
    draw_reference,
    entitle,
    figure_of,
    literal,
    look,
    name_bands,
)
from sme_registry.statistics import iqm

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Measure = Literal["similarity", "normalised_regret"]
_MEASURES = {
    "similarity": "similarity r̃  (1 = optimal)",
    "normalised_regret": "normalised regret  (1 = constant ½)",
}


def decay_curve(
    reports: Reports,
    path: str | os.PathLike[str] | None = None,
    *,
    measures: Sequence[Measure] = ("similarity", "normalised_regret"),
    references: bool = True,
    title: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Draw reports over the expansion level ε: one panel per measure, one line per method.

    Args:
      reports: one or more reports, each a line named by its policy; or a mapping from a method's
        name to the reports of its runs (seeds or instances), each a line of their IQM, with their
        quartiles as a band. A single report of a team also has a thinner line for each agent.
        A report may be given by its path, evaluation.json, or by the folder that contains it.
      references: whether to draw the reference policies as thin lines. In a mapping they are means
        over its tasks; otherwise they are drawn once per task: in grey, or with several tasks in
        the colour of the first report on each task.

    Examples:
      >>> from sme_registry.plots import decay_curve
      >>> names = ("linear", "random")
      >>> reports = [sme_registry.evaluate(name, "Default", "quick-v1") for name in names]
      >>> figure = decay_curve(reports, "decay.png")
      >>> len(figure.axes)
      2
    """
    methods = methods_of(reports)
    everything = [report for method in methods for report in method.reports]
    if not measures or any(measure not in _MEASURES for measure in measures):
        raise OptionError(f"measures={measures!r:.70}: must be among {', '.join(_MEASURES)}.")
    size = (4.4 * len(measures) + 0.6, 3.9)
    with canvas(ax, size, path, len(measures)) as panels:
        for axes, measure in zip(panels, measures, strict=True):
            for index, method in enumerate(methods):
                _draw_method(axes, method, measure, look(index))
            if len(everything) == 1:
                _draw_agents(axes, everything[0], measure)
            if references:
                _draw_references(axes, methods, measure, averaged=isinstance(reports, Mapping))
            if len(everything) > len(methods):
                name_bands(axes, "quartiles of runs (line: IQM)")
            _label_axes(axes, everything, measure)
        title = only_title(everything) if title is None else title
        if ax is None and title:
            entitle(figure_of(panels[0]), title)
    return figure_of(panels[0])


def _values(regions: Any, measure: str) -> list[float]:
    return [getattr(region, measure) for region in regions]


def _draw_method(axes: Axes, method: Method, measure: str, style: Mapping[str, Any]) -> None:
    x = levels(method.reports[0])
    runs = np.array([_values(report.regions, measure) for report in method.reports])
    label = literal(method.label)
    if len(runs) > 1:
        low, high = np.quantile(runs, [0.25, 0.75], axis=0)
        draw_band(axes, x, low, high, style["color"])
        label += f" (n = {len(runs)})"
    axes.plot(x, iqm(runs), **style, markersize=4.5, linewidth=2, label=label)


def _draw_agents(axes: Axes, report: EvaluationReport, measure: str) -> None:
    """A thinner line for each agent of a team; one colour for all if they are too many."""
    several = len(report.agents) >= len(COLOURS)
    for index, (name, agent) in enumerate(report.agents.items()):
        style: Any = {"markersize": 3.5, "linewidth": 1.2, "alpha": 0.8, "zorder": 1.8}
        if several:
            each = f"each of {len(report.agents)} agents"
            style |= {"color": COLOURS[5], "label": "" if index else each}
        else:
            style |= {**look(index + 1), "label": literal(name)}
        axes.plot(levels(report), _values(agent.regions, measure), **style)


def _draw_references(
    axes: Axes, methods: Sequence[Method], measure: str, *, averaged: bool
) -> None:
    """The references of each task, or their means over all tasks, with one entry in the legend."""
    tasks: dict[str, tuple[int, EvaluationReport]] = {}
    for index, method in enumerate(methods):
        for report in method.reports:
            tasks.setdefault(report.spec_digest, (index, report))
    first = methods[0].reports[0]
    alike = [report for _, report in tasks.values() if levels(report) == levels(first)]
    if averaged:
        for name in first.references:
            if not all(name in report.references for report in alike):
                continue  # of safety, where only some tasks have limits
            runs = [_values(report.references[name], measure) for report in alike]
            mean = np.mean(runs, axis=0)
            draw_reference(axes, name, levels(first), mean, LABELS.get(name, name))
        return
    for index, report in tasks.values():
        colour = GREY if len(tasks) == 1 else COLOURS[index % len(COLOURS)]
        for name, regions in report.references.items():
            label = LABELS.get(name, name) if report is first else "_another task"
            values = _values(regions, measure)
            draw_reference(axes, name, levels(report), values, label, colour)


def _label_axes(axes: Axes, reports: Sequence[EvaluationReport], measure: str) -> None:
    marks = sorted({level for report in reports for level in levels(report)})
    dims = sorted({report.spec.state_dim for report in reports})
    warning = (
        "different S: these levels are not comparable"
        if len(dims) > 1
        else f"S = {dims[0]}; not comparable with another S"
    )
    axes.set_xlabel(f"outer expansion level ε of the region\n{warning}")
    axes.set_ylabel(_MEASURES[measure])
    if len(marks) <= 12:
        axes.set_xticks(marks, [f"{level:g}" if level > 0 else "WD" for level in marks])
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.5) if measure == "similarity" else 0.0 - 0.03 * high, high)
