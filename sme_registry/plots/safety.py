"""`reward_against_cost`: what policies earn, and what they break to earn it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, SafetyReport, SafetyScore
from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.tables import SAFETY_REFERENCES
from sme_registry.plots.methods import Reports, methods_of, only_title
from sme_registry.plots.style import GREY, canvas, entitle, figure_of, literal, look
from sme_registry.statistics import iqm
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = {"optimal": "*", "safe_optimal": "P", "shrunk_optimal": "X", "constant_half": "d"}
_PANELS = ("in the training cube (WD)", "outside it (mean of the OOD shells)")


def reward_against_cost(
    reports: Reports,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Draw mean step reward against mean cost: one panel in the cube, one outside.

    The line between the optimum and the safe optimum is what mixtures of the two reach. Reports are
    as in `decay_curve`, of tasks with limits; in a mapping each run is a small marker, and their
    IQM a large one. References are means over the tasks.

    Examples:
      >>> from sme_registry.plots import reward_against_cost
      >>> report = sme_registry.evaluate("linear", "Safety20", "quick-v1")
      >>> figure = reward_against_cost(report, "cost.png")
    """
    methods = methods_of(reports)
    everything = [report for method in methods for report in method.reports]
    by_task = {report.spec_digest: _safety(report) for report in everything}
    with canvas(ax, (9.0, 4.2), path, panels=2) as panels:
        for axes, panel, place in zip(panels, _PANELS, (_inside, _outside), strict=True):
            ends = []
            for name in SAFETY_REFERENCES:
                x, y = _points([safety.references[name] for safety in by_task.values()], place)
                ends.append((x.mean(), y.mean()))
                axes.plot(
                    *ends[-1], MARKERS[name], color=GREY, markersize=9, label=LABELS[name],
                    linestyle="none", zorder=2,
                )  # fmt: skip
            axes.plot(
                *zip(*ends[:2], strict=True), color=GREY, linewidth=1.0, zorder=1.5,
                label="mixtures of optimal and safe optimum",
            )  # fmt: skip
            for index, method in enumerate(methods):
                x, y = _points([_safety(report).regions for report in method.reports], place)
                style, runs = look(index), f" (n = {len(x)})" if len(x) > 1 else ""
                if len(x) > 1:
                    axes.plot(x, y, **style, linestyle="none", markersize=3.5, alpha=0.5)
                axes.plot(
                    iqm(x), iqm(y), **style, linestyle="none", markersize=7.5, zorder=3,
                    label=literal(method.label) + runs,
                )  # fmt: skip
            axes.set_title(panel)
            axes.set_xlabel("mean cost  (0 = within all limits)")
            axes.set_ylabel("mean step reward  (1 = optimal)")
            axes.set_xlim(left=-0.04 * axes.get_xlim()[1])
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        title = only_title(everything) if title is None else title
        if ax is None and title:
            entitle(figure_of(panels[0]), title)
    return figure_of(panels[0])


def _safety(report: EvaluationReport) -> SafetyReport:
    if report.safety is None:
        raise OptionError(
            f"reports: that of {report.policy!r} on {report.title} is of a task without limits. "
            "Give reports of tasks with safety."
        )
    return report.safety


def _inside(regions: Sequence[SafetyScore]) -> Sequence[SafetyScore]:
    return regions[:1]


def _outside(regions: Sequence[SafetyScore]) -> Sequence[SafetyScore]:
    return regions[1:]


def _points(
    runs: Iterable[Sequence[SafetyScore]],
    place: Callable[[Sequence[SafetyScore]], Sequence[SafetyScore]],
) -> tuple[Array, Array]:
    """Cost and step reward of each run, the mean over the regions of a place: `[runs]` each."""
    scores = [[(each.cost, each.step_reward) for each in place(regions)] for regions in runs]
    x, y = np.mean(scores, axis=1).T
    return x, y
