"""Figures of an agent in a stream: what it retains, what its life cost, and its plasticity."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import StreamReport
from sme_registry.evaluation.dynamic_regret import DynamicRegret
from sme_registry.evaluation.retention import LABELS, TRAINED
from sme_registry.evaluation.streams import Visit, check_same_stream
from sme_registry.plots.reports import read_reports
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    canvas,
    counted,
    draw_runs,
    figure_of,
    look,
    name_bands,
)
from sme_registry.statistics import Statistic, iqm, median
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

Report = StreamReport | str | os.PathLike[str]
Runs = Report | Sequence[Report]
Methods = Runs | Mapping[str, Runs]

MATRIX_SCALE = "normalised regret\n(0 = optimal, 1 = constant ½)"
FILE = "stream.json"  # of a report, in the folder of a run
_MOST_NUMBERS = 12  # of columns of a map whose cells show their values
_SIZE = (6.2, 4.0)  # inches, of a figure of lines
_POINTS = 400  # of a line; more would not be visible at this size
_DASHES: dict[str, Any] = {
    "constant_half": (0, (4, 4)),
    "frozen_optimum": (0, (1, 1.5)),
    "frozen_agent": (0, (6, 2, 1, 2)),
    "fresh_agents": "-",
}


def retention_map(
    runs: Runs,
    path: str | os.PathLike[str] | None = None,
    *,
    region: str = "WD",
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw a retention matrix: normalised regret after each visit (rows) on each phase (columns).

    Bright is good. The cell of the phase that was just visited is outlined. The first row is the
    initial policy, where the reports have one.

    Args:
      runs: the report of an agent, or one for each seed: then the cells are their IQM. A report
        may be given by its path, or by the folder that contains its stream.json.
      region: `WD`, `OOD 1`, …, or `OOD` for the mean over the shells.

    Examples:
      >>> from sme_registry.plots import retention_map
      >>> figure = retention_map("runs/life", "retention_map.png")
    """
    reports = _runs(runs)
    agents = [report.region(region).agent for report in reports]
    M = iqm([agent.normalised_regret for agent in agents])
    labels = [f"visit {visit.visit}" for visit in reports[0].visits]
    visited: list[tuple[int, int]] = [(visit.visit, visit.phase) for visit in reports[0].visits]
    known = (agent.initial_normalised_regret for agent in agents)
    initial = [regret for regret in known if regret]
    if len(initial) == len(agents):
        M = np.concatenate([iqm(initial)[None], M])
        labels = ["initial", *labels]
        visited = [(row + 1, column) for row, column in visited]
    V, P = M.shape
    size = (max(3.6, 1.9 + 0.52 * min(P, 20)), max(2.8, 1.5 + 0.32 * min(V, 30)))
    with canvas(ax, size, path, title=_title(reports, title, f", {region}")) as (axes,):
        image = draw_matrix(axes, M, visited, labels, max(1.0, float(M.max())))
        axes.set_xlabel("evaluated on the task of phase")
        axes.set_ylabel("policy at the end of")
        bar = figure_of(axes).colorbar(image, ax=axes, label=MATRIX_SCALE)
        bar.outline.set_visible(False)
    return figure_of(axes)


def performance_curve(
    runs: Runs,
    path: str | os.PathLike[str] | None = None,
    *,
    region: str = "WD",
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the performance on each phase's task over the visits: a line for each phase.

    Filled marks are the visits of the line's own phase: between them one sees what is forgotten,
    and before the first of them what is known in advance. Performance is 1 − normalised regret.
    Runs are as in `retention_map`: lines are the IQM of several seeds, bands their quartiles.

    Examples:
      >>> from sme_registry.plots import performance_curve
      >>> figure = performance_curve("runs/life", "performance_curve.png")
    """
    reports = _runs(runs)
    agents = [report.region(region).agent for report in reports]
    R = 1.0 - np.array([agent.normalised_regret for agent in agents])  # [n, V, P]
    known = (agent.initial_normalised_regret for agent in agents)
    initial = [regret for regret in known if regret]
    x = np.arange(R.shape[1], dtype=float)
    if len(initial) == len(agents):
        R = np.concatenate([1.0 - np.array(initial)[:, None], R], axis=1)
        x = np.concatenate([[-1.0], x])
    phases = np.array([visit.phase for visit in reports[0].visits])
    with canvas(ax, _SIZE, path, title=_title(reports, title)) as (axes,):
        lines = {f"phase {j}": (x, R[..., j]) for j in range(R.shape[2])}
        hollow = {"markersize": 4.5, "linewidth": 1.6, "markerfacecolor": "white"}
        _draw_lines(axes, lines, iqm, "IQM", **hollow)
        for j, (_, values) in enumerate(lines.values()):
            own = np.isin(x, np.flatnonzero(phases == j))
            axes.plot(x[own], iqm(values)[own], **look(j), markersize=6, linestyle="none")
        _reference(axes, 1.0, "optimal", "-")
        _reference(axes, 0.0, "constant ½", (0, (4, 4)))
        tick_visits(axes, reports[0].visits, initial=x[0] < 0)
        axes.set_ylabel(f"performance in {region}  (1 − normalised regret)")
    return figure_of(axes)


def dynamic_regret_curve(
    runs: Methods,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the dynamic regret of training over the lifetime, with a band for each visit.

    Reference agents of which the reports know the regret are grey, but not the optimum of each
    phase, which has none; with several methods only those that need no training. Runs are as in
    `retention_map`, or a mapping from each agent's name to its runs. Lines are the median of
    several seeds, and bands their quartiles.

    Examples:
      >>> from sme_registry.plots import dynamic_regret_curve
      >>> figure = dynamic_regret_curve("runs/life", "dynamic_regret.png")
    """
    methods = _methods(runs)
    first = next(iter(methods.values()))
    with canvas(ax, _SIZE, path, title=_title(first, title, named=len(methods) == 1)) as (axes,):
        lines = {
            counted(name, reports): _curves([_regret(report) for report in reports])
            for name, reports in methods.items()
        }
        _draw_lines(axes, lines, median, "median", linewidth=2, markersize=4.5, markevery=0.13)
        _draw_references(axes, first, trained=len(methods) == 1)
        axes.set_xlim(0.0, max(x[-1] for x, _ in lines.values()))
        axes.set_ylim(bottom=0.0)
        shade_visits(axes, first[0].visits)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        axes.set_xlabel("lifetime (environment steps)")
        axes.set_ylabel("dynamic regret  (Σ of 1 − r)")
    return figure_of(axes)


def plasticity_curve(
    runs: Methods,
    path: str | os.PathLike[str] | None = None,
    *,
    region: str = "WD",
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the plasticity ratio by visit: regret on the visited phase over a fresh agent's.

    Above 1 the agent learns less than a fresh one in as many steps. Runs are as in
    `dynamic_regret_curve`, with fresh agents; lines are the IQM of several seeds, and bands their
    quartiles.

    Examples:
      >>> from sme_registry.evaluation import evaluate_stream
      >>> from sme_registry.plots import plasticity_curve
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> report = evaluate_stream(["linear", "linear"], stream, "quick-v1", fresh=["linear"] * 2)
      >>> figure = plasticity_curve(report, "plasticity_curve.png")
    """
    methods = _methods(runs)
    first = next(iter(methods.values()))
    with canvas(ax, _SIZE, path, title=_title(first, title, named=len(methods) == 1)) as (axes,):
        visits = np.arange(len(first[0].visits), dtype=float)
        lines = {
            counted(name, reports): (visits, np.array([_ratios(one, region) for one in reports]))
            for name, reports in methods.items()
        }
        _draw_lines(axes, lines, iqm, "IQM", linewidth=2, markersize=5)
        _reference(axes, 1.0, "as a fresh agent", "-")
        tick_visits(axes, first[0].visits)
        axes.set_ylim(bottom=0.0)
        axes.set_ylabel(f"plasticity ratio in {region}\n(regret / fresh agent's, > 1: lost)")
    return figure_of(axes)


def draw_matrix(
    axes: Axes, M: Array, visited: Sequence[tuple[int, int]], labels: Sequence[str], top: float
) -> AxesImage:
    """Draw a retention matrix `[V, P]` in axes, with the `visited` cells outlined.

    `top` is the regret at the dark end of the colours, at least that of every cell.
    """
    image = axes.imshow(
        M, vmin=0.0, vmax=top, cmap="viridis_r", aspect="auto", interpolation="nearest"
    )
    axes.grid(visible=False)
    V, P = M.shape
    if P <= _MOST_NUMBERS:
        for row, column in np.ndindex(V, P):
            colour = "white" if M[row, column] > 0.5 * top else "black"
            axes.text(
                column, row, f"{M[row, column]:.2f}", ha="center", va="center", fontsize=8,
                color=colour,
            )  # fmt: skip
    for row, column in visited:
        _outline(axes, row, column)
    _tick(axes.yaxis, labels)
    _tick(axes.xaxis, [str(j) for j in range(P)])
    return image


def tick_visits(axes: Axes, visits: Sequence[Visit], *, initial: bool = False) -> None:
    """Label the x axis of visits, from 0, with their phases; the initial policy is at −1."""
    every = -(-len(visits) // 15)
    shown = visits[::every]
    places, labels = [visit.visit for visit in shown], [str(visit.phase) for visit in shown]
    if initial:
        places, labels = [-1, *places], ["\ninitial", *labels]
    axes.set_xticks(places, labels)
    axes.set_xlabel("end of the visit of phase")


def shade_visits(axes: Axes, visits: Sequence[Visit]) -> None:
    """A band for every other visit along a lifetime, up to the x limit, and its phase above."""
    begin, end = 0, axes.get_xlim()[1]
    few = len(visits) <= 20
    for visit in visits:
        if begin >= end:
            break
        until = end if visit is visits[-1] else min(visit.lifetime, end)
        if visit.visit % 2 == 0:
            axes.axvspan(begin, until, color=GREY, alpha=0.1, linewidth=0, zorder=0)
        if few:
            axes.text(
                (begin + until) / 2, 1.01, f"{visit.phase}", ha="center", va="bottom", fontsize=8,
                color=GREY, transform=axes.get_xaxis_transform(),
            )  # fmt: skip
        begin = visit.lifetime
    if few:
        axes.text(
            0.0, 1.01, "phase ", ha="right", va="bottom", fontsize=8, color=GREY,
            transform=axes.transAxes,
        )  # fmt: skip


def _draw_lines(
    axes: Axes,
    lines: Mapping[str, tuple[Array, Array]],
    statistic: Statistic,
    name: str,
    **style: Any,
) -> None:
    """Lines by their labels, each a statistic of the `[n, X]` values of its seeds at `[X]` places.

    Quartiles are bands, unless there are more lines than colours.
    """
    banded = len(lines) <= len(COLOURS) and any(len(values) > 1 for _, values in lines.values())
    for index, (label, (x, values)) in enumerate(lines.items()):
        draw_runs(axes, x, values, statistic, {**look(index), **style}, label, banded)
    if banded:
        name_bands(axes, f"quartiles of seeds (line: {name})")


def _methods(given: Methods) -> dict[str, list[StreamReport]]:
    """The runs of each agent; all of one stream and protocol."""
    if not isinstance(given, Mapping):
        runs = _runs(given)
        return {runs[0].policy: runs}
    methods = {str(name): _runs(runs) for name, runs in given.items()}
    check_same_stream([report for runs in methods.values() for report in runs])
    return methods


def _runs(given: Runs) -> list[StreamReport]:
    """One report or several, those given by their paths read."""
    reports = read_reports(given, StreamReport, FILE, "runs")
    check_same_stream(reports)
    return reports


def _draw_references(axes: Axes, reports: Sequence[StreamReport], *, trained: bool) -> None:
    """The regret of the reference agents; of those that are `trained` only if they are this one."""
    names = [name for name in _DASHES if trained or name not in TRAINED]
    for name in names:
        lives = [report.reference_regret.get(name) for report in reports]
        known = [life for life in lives if life is not None]
        if known and len(known) == len(lives):
            x, values = _curves(known)
            axes.plot(
                x, median(values), color=GREY, linewidth=1.3, linestyle=_DASHES[name],
                label=LABELS[name], zorder=1.8,
            )  # fmt: skip


def _curves(lives: Sequence[DynamicRegret]) -> tuple[Array, Array]:
    """`[X]` lifetimes that all lives have reached, and the `[n, X]` regret until then."""
    x = np.linspace(0.0, min(life.lifetime[-1] for life in lives), _POINTS)
    return x, np.array([life.until(x) for life in lives])


def _regret(report: StreamReport) -> DynamicRegret:
    if report.dynamic_regret is None:
        raise OptionError(
            "runs: a report has no dynamic regret. Add it from the log of the training: "
            "report.with_dynamic_regret(dynamic_regret(…))."
        )
    return report.dynamic_regret


def _ratios(report: StreamReport, region: str) -> Array:
    """`[V]` plasticity ratios; NaN where a fresh agent is optimal."""
    agent = report.region(region).agent
    if agent.fresh_normalised_regret is None:
        raise OptionError(
            "runs: a report has no fresh agents. Give evaluate_stream their policies, fresh=…."
        )
    return np.array(agent.plasticity_ratio, dtype=float)


def _title(
    reports: Sequence[StreamReport], title: str | None, end: str = "", *, named: bool = True
) -> str:
    if title is not None:
        return title
    who = f"{reports[0].policy} on " if named else ""
    seeds = f", {len(reports)} seeds" if named and len(reports) > 1 else ""
    return f"{who}{reports[0].title}{end}{seeds}"


def _outline(axes: Axes, row: int, column: int) -> None:
    """A frame of two strokes, visible on dark and on light colours."""
    x = column + np.array([-0.5, 0.5, 0.5, -0.5, -0.5]) * 0.94
    y = row + np.array([-0.5, -0.5, 0.5, 0.5, -0.5]) * 0.94
    for colour, width in (("white", 2.4), ("black", 1.0)):
        axes.plot(x, y, color=colour, linewidth=width)


def _reference(axes: Axes, value: float, label: str, dash: Any) -> None:
    axes.axhline(value, color=GREY, linewidth=1.1, linestyle=dash, label=label, zorder=1.5)


def _tick(axis: Any, labels: Sequence[str]) -> None:
    """As many of the labels as are legible."""
    every = -(-len(labels) // 20)
    axis.set_ticks(range(0, len(labels), every), labels[::every])
    axis.set_tick_params(length=0)
