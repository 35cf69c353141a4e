"""Lines over environment steps, of training, and over the lifetime or the visits of a stream.

In figures of training, x is the total of steps over all environments, which end their episodes in
any order. The line is the median of the last `window` that ended by x: `statistics.smoothed`.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import StreamReport
from sme_registry.evaluation.dynamic_regret import DynamicRegret
from sme_registry.evaluation.retention import LABELS, TRAINED
from sme_registry.evaluation.streams import Visit, check_same_stream
from sme_registry.plots.maps import LifeReports, initial_regrets, lives_title, read_lives
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    LINE_POINTS,
    canvas,
    counted,
    draw_runs,
    figure_of,
    look,
    name_bands,
)
from sme_registry.statistics import Statistic, iqm, median, smoothed
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EPISODES = "episodes.csv"
Run = str | os.PathLike[str] | Mapping[str, Any] | Iterable[Any]
Lives = LifeReports | Mapping[str, LifeReports]

_SIZE = (6.2, 4.0)  # inches
_DASHED = (0, (4, 4))
_THOUSANDS = "{x:,.0f}"  # of numbers at an axis
_AGENT_DASHES: dict[str, Any] = {
    "constant": _DASHED,
    "frozen_optimum": (0, (1, 1.5)),
    "frozen_agent": (0, (6, 2, 1, 2)),
    "fresh_agents": "-",
}


def training_curve(
    episodes: Run,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str = "",
    window: int | None = None,
    visits: Sequence[Visit] = (),
    ax: Axes | None = None,
) -> Figure:
    """Draw the exact regret of each training episode over environment steps.

    Each dot is an episode; the line is the median of the last `window` of them, None for a tenth of
    all, at most 50. `visits` of a life in a stream are bands with their phases above. `episodes` is
    the folder of a run of `sme train`, or its episodes.csv; columns `step` and `regret`, as a
    mapping of `[N]` arrays or a pandas frame; or rows that have both, as attributes or as keys.

    Examples:
      >>> from sme_registry.plots import training_curve
      >>> steps = np.arange(100, 2100, 100)
      >>> figure = training_curve({"step": steps, "regret": 100 / steps}, "regret.png")
      >>> figure.axes[0].get_xlabel()
      'environment steps'
    """
    step, regret = _points(episodes, "regret")
    with canvas(ax, _SIZE, path, title=title) as (axes,):
        _draw_training(axes, step, regret, window)
        axes.axhline(0.0, color=GREY, linewidth=1.1, label="optimal")
        shade_visits(axes, visits)
    return figure_of(axes)


def cost_curve(
    episodes: Run,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str = "",
    window: int | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the mean cost of each training episode over environment steps, for a task with safety.

    As `training_curve`, of the column `cost` instead of `regret`.

    Examples:
      >>> from sme_registry.plots import cost_curve
      >>> steps = np.arange(100, 2100, 100)
      >>> figure = cost_curve({"step": steps, "cost": 10 / steps}, "cost.pdf")
    """
    step, cost = _points(episodes, "cost")
    with canvas(ax, _SIZE, path, title=title) as (axes,):
        _draw_training(axes, step, cost, window)
        axes.set_ylim(0.0, max(1.1 * float(cost.max()), 0.01))
        axes.set_ylabel("mean cost per step")
    return figure_of(axes)


def learning_curve(
    runs: Mapping[str, Any],
    path: str | os.PathLike[str] | None = None,
    *,
    title: str = "",
    window: int | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the exact regret of one or more methods over environment steps, each from several runs.

    A line is the median over a method's runs of their running medians, and a band their quartiles.
    `runs` map each method's name to its runs (seeds), each as in `training_curve`, where a single
    path or table needs no list; or are one table, a pandas frame or a mapping of `[N]` arrays, with
    the columns `step` and `regret`, and `method` and `seed` where there are several.

    Examples:
      >>> from sme_registry.plots import learning_curve
      >>> steps = np.arange(100, 2100, 100)
      >>> runs = [{"step": steps, "regret": (100 + 10 * seed) / steps} for seed in range(3)]
      >>> figure = learning_curve({"mine": runs, "PPO": "runs/ppo"}, "regret.png")
    """
    methods = _runs_by_method(runs)
    if not methods or not all(methods.values()):
        raise OptionError("runs: must hold one or more runs of each method.")
    lines = {
        name: [smoothed(*_points(run, "regret"), window)[:2] for run in method]
        for name, method in methods.items()
    }
    with canvas(ax, _SIZE, path, title=title) as (axes,):
        for index, (name, curves) in enumerate(lines.items()):
            _draw_method(axes, name, curves, look(index))
        axes.axhline(0.0, color=GREY, linewidth=1.1, label="optimal")
        if any(len(curves) > 1 for curves in lines.values()):
            name_bands(axes, "quartiles of runs (line: median)")
        _label_training(axes)
    return figure_of(axes)


def _draw_training(axes: Axes, step: Array, regret: Array, window: int | None) -> None:
    """A dot for each of `[N]` episodes of a training, and their running median."""
    axes.scatter(
        step, regret, s=8, color=GREY, alpha=0.4, linewidths=0, rasterized=True, label="one episode"
    )
    x, y, width = smoothed(step, regret, window)
    drawn = np.unique(np.linspace(0, len(x) - 1, LINE_POINTS).round().astype(int))
    label = f"median of the last {width} episodes"
    axes.plot(x[drawn], y[drawn], color=COLOURS[0], linewidth=2.2, label=label)
    _label_training(axes)


def _label_training(axes: Axes) -> None:
    axes.set_ylim(-0.04, 1.04)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(_THOUSANDS)
    axes.set_xlabel("environment steps")
    axes.set_ylabel("mean regret per step  (1 − r)")


def _draw_method(
    axes: Axes, name: str, curves: Sequence[tuple[Array, Array]], style: Mapping[str, Any]
) -> None:
    """The median and the quartiles over runs, where all of them have a line."""
    begin, end = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    if begin > end:
        raise OptionError(
            f"runs[{name!r}]: share no steps: one ends at {end:,.0f}, before another's line begins "
            f"at {begin:,.0f}. Train them for equal budgets."
        )
    x = np.linspace(begin, end, LINE_POINTS)
    values = np.array([np.interp(x, *curve) for curve in curves])
    line = {**style, "linewidth": 2, "markersize": 4.5, "markevery": 0.13}
    draw_runs(axes, x, values, median, line, counted(name, values))


def _runs_by_method(runs: Any) -> dict[str, list[Any]]:
    if not hasattr(runs, "keys"):
        raise OptionError(
            f"runs={runs!r:.60}: must map each method's name to its runs, such as "
            '{"TD3": ["runs/a", "runs/b"]}, or be a table. One run is a `training_curve`.'
        )
    if "regret" in runs:
        return _split(runs)
    methods = {}
    for name, given in runs.items():
        alone = isinstance(given, str | os.PathLike) or hasattr(given, "keys")
        if not alone and not isinstance(given, Iterable):
            raise OptionError(f"runs[{name!r}]={given!r:.60}: must be one or more runs.")
        methods[str(name)] = [given] if alone else list(given)
    return methods


def _split(table: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The runs of each method in a table."""
    try:
        columns = {"step": np.asarray(table["step"])}
        for name in ("regret", "method", "seed"):
            values = table[name] if name == "regret" or name in table else [""]
            columns[name] = np.broadcast_to(np.asarray(values), columns["step"].shape)
    except (KeyError, ValueError) as error:
        raise OptionError(
            f"runs: a table must have the columns step and regret of equal length: {error}."
        ) from None
    methods: dict[str, list[Any]] = {}
    for method, seed in dict.fromkeys(zip(columns["method"], columns["seed"], strict=True)):
        selected = (columns["method"] == method) & (columns["seed"] == seed)
        run = {name: columns[name][selected] for name in ("step", "regret")}
        methods.setdefault(str(method) or "regret", []).append(run)
    return methods


def _points(run: Run, column: str) -> tuple[Array, Array]:
    """`[N]` environment steps at which episodes ended, and their mean regrets or costs."""
    source, table = "episodes", cast(Any, run)
    if isinstance(run, str | os.PathLike):
        path = Path(run) / EPISODES if Path(run).is_dir() else Path(run)
        source, table = str(path), _rows(path)
    try:
        if not hasattr(table, "keys"):
            rows = list(table)
            table = {name: [_field(row, name) for row in rows] for name in ("step", column)}
        step, values = (np.asarray(table[name], dtype=np.float64) for name in ("step", column))
        if step.ndim != 1 or step.shape != values.shape or not np.isfinite(values).all():
            raise ValueError
    except (KeyError, AttributeError, TypeError, ValueError):
        raise OptionError(
            f"{source}: every row must have numbers for step and {column}. "
            "Give the episodes.csv of a training run"
            f"{' on a task with safety' if column == 'cost' else ''}."
        ) from None
    if not len(step):
        raise OptionError(f"{source}: contains no finished episode. Train for longer.")
    return step, values


def _field(row: Any, name: str) -> float:
    if hasattr(row, "keys"):
        return float(row[name])
    return float(getattr(row if hasattr(row, name) else row.safety, name))


def _rows(path: Path) -> list[dict[str, Any]]:
    """The rows of an episodes.csv, without one that was cut short when the run was killed."""
    try:
        text = path.read_text(encoding="utf-8")
        rows: list[dict[str, Any]] = list(csv.DictReader(io.StringIO(text)))
    except (OSError, ValueError, csv.Error) as error:
        raise OptionError(f"{path}: cannot be read: {error}. Give an episodes.csv.") from None
    return rows[:-1] if rows and None in rows[-1].values() else rows


def performance_curve(
    runs: LifeReports,
    path: str | os.PathLike[str] | None = None,
    *,
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
    reports = read_lives(runs)
    agents = [report.region().agent for report in reports]
    R = 1.0 - np.array([agent.normalised_regret for agent in agents])  # [n, V, P]
    x = np.arange(R.shape[1], dtype=float)
    if initial := initial_regrets(agents):
        R = np.concatenate([1.0 - np.array(initial)[:, None], R], axis=1)
        x = np.concatenate([[-1.0], x])
    phases = np.array([visit.phase for visit in reports[0].visits])
    with canvas(ax, _SIZE, path, title=lives_title(reports, title)) as (axes,):
        lines = {f"phase {j}": (x, R[..., j]) for j in range(R.shape[2])}
        hollow = {"markersize": 4.5, "linewidth": 1.6, "markerfacecolor": "white"}
        _draw_lines(axes, lines, iqm, "IQM", **hollow)
        for j, (_, values) in enumerate(lines.values()):
            visited = np.isin(x, np.flatnonzero(phases == j))
            axes.plot(x[visited], iqm(values)[visited], **look(j), markersize=6, linestyle="none")
        _draw_level(axes, 1.0, "optimal", "-")
        _draw_level(axes, 0.0, "constant ½", _DASHED)
        tick_visits(axes, reports[0].visits, initial=x[0] < 0)
        axes.set_ylabel("performance in WD  (1 − normalised regret)")
    return figure_of(axes)


def dynamic_regret_curve(
    runs: Lives,
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
    methods = _lives_by_method(runs)
    first, alone = next(iter(methods.values())), len(methods) == 1
    with canvas(ax, _SIZE, path, title=lives_title(first, title, named=alone)) as (axes,):
        lines = {
            counted(name, reports): _curves([_regret(report) for report in reports])
            for name, reports in methods.items()
        }
        _draw_lines(axes, lines, median, "median", linewidth=2, markersize=4.5, markevery=0.13)
        _draw_reference_agents(axes, first, trained=alone)
        axes.set_xlim(0.0, max(x[-1] for x, _ in lines.values()))
        axes.set_ylim(bottom=0.0)
        shade_visits(axes, first[0].visits)
        axes.xaxis.set_major_formatter(_THOUSANDS)
        axes.yaxis.set_major_formatter(_THOUSANDS)
        axes.set_xlabel("lifetime (environment steps)")
        axes.set_ylabel("dynamic regret  (Σ of 1 − r)")
    return figure_of(axes)


def plasticity_curve(
    runs: Lives,
    path: str | os.PathLike[str] | None = None,
    *,
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
    methods = _lives_by_method(runs)
    first, alone = next(iter(methods.values())), len(methods) == 1
    with canvas(ax, _SIZE, path, title=lives_title(first, title, named=alone)) as (axes,):
        visits = np.arange(len(first[0].visits), dtype=float)
        lines = {
            counted(name, reports): (visits, np.array([*map(_ratios, reports)]))
            for name, reports in methods.items()
        }
        _draw_lines(axes, lines, iqm, "IQM", linewidth=2, markersize=5)
        _draw_level(axes, 1.0, "as a fresh agent", "-")
        tick_visits(axes, first[0].visits)
        axes.set_ylim(bottom=0.0)
        axes.set_ylabel("plasticity ratio in WD\n(regret / fresh agent's, > 1: worse)")
    return figure_of(axes)


def tick_visits(axes: Axes, visits: Sequence[Visit], *, initial: bool = False) -> None:
    """Label the x axis of visits, from 0, with their phases; the initial policy is at −1."""
    labelled = visits[:: -(-len(visits) // 15)]
    ticks = {visit.visit: str(visit.phase) for visit in labelled}
    if initial:
        ticks = {-1: "\ninitial", **ticks}
    axes.set_xticks([*ticks], [*ticks.values()])
    axes.set_xlabel("end of the visit of phase")


def shade_visits(axes: Axes, visits: Sequence[Visit]) -> None:
    """A band for every other visit along a lifetime, up to the x limit, and its phase above."""
    begin, end = 0, axes.get_xlim()[1]
    few = 0 < len(visits) <= 20
    label: Any = {"y": 1.01, "va": "bottom", "fontsize": 8, "color": GREY}
    label["transform"] = axes.get_xaxis_transform()
    for visit in visits:
        if begin >= end:
            break
        until = end if visit is visits[-1] else min(visit.lifetime, end)
        if visit.visit % 2 == 0:
            axes.axvspan(begin, until, color=GREY, alpha=0.1, linewidth=0, zorder=0)
        if few:
            axes.text(x=(begin + until) / 2, s=f"{visit.phase}", ha="center", **label)
        begin = visit.lifetime
    if few:
        axes.text(x=0.0, s="phase ", ha="right", **label)


def _draw_lines(
    axes: Axes,
    lines: Mapping[str, tuple[Array, Array]],
    statistic: Statistic,
    name: str,
    **style: Any,
) -> None:
    """Lines by their labels, each a statistic of its seeds' `[n, X]` values at `[X]` places."""
    banded = len(lines) <= len(COLOURS) and any(len(values) > 1 for _, values in lines.values())
    for index, (label, (x, values)) in enumerate(lines.items()):
        draw_runs(axes, x, values, statistic, {**look(index), **style}, label, banded)
    if banded:
        name_bands(axes, f"quartiles of seeds (line: {name})")


def _draw_level(axes: Axes, value: float, label: str, dash: Any) -> None:
    axes.axhline(value, color=GREY, linewidth=1.1, linestyle=dash, label=label, zorder=1.5)


def _draw_reference_agents(axes: Axes, reports: Sequence[StreamReport], *, trained: bool) -> None:
    """The regret of the reference agents; of those that are `trained` only if they are this one."""
    for name, dash in _AGENT_DASHES.items():
        lives = [report.reference_regret.get(name) for report in reports]
        known = [life for life in lives if life is not None]
        if len(known) == len(lives) and (trained or name not in TRAINED):
            x, values = _curves(known)
            axes.plot(
                x, median(values), color=GREY, linewidth=1.3, linestyle=dash, label=LABELS[name],
                zorder=1.8,
            )  # fmt: skip


def _lives_by_method(given: Lives) -> dict[str, list[StreamReport]]:
    """The runs of each agent; all of one stream and protocol."""
    if not isinstance(given, Mapping):
        reports = read_lives(given)
        return {reports[0].policy: reports}
    methods = {str(name): read_lives(runs) for name, runs in given.items()}
    check_same_stream([report for reports in methods.values() for report in reports])
    return methods


def _curves(lives: Sequence[DynamicRegret]) -> tuple[Array, Array]:
    """`[X]` lifetimes that all lives have reached, and the `[n, X]` regret until then."""
    x = np.linspace(0.0, min(life.lifetime[-1] for life in lives), LINE_POINTS)
    return x, np.array([life.until(x) for life in lives])


def _regret(report: StreamReport) -> DynamicRegret:
    if report.dynamic_regret is None:
        raise OptionError(
            "runs: a report has no dynamic regret. Add it from the log of the training: "
            "report.with_dynamic_regret(dynamic_regret(…))."
        )
    return report.dynamic_regret


def _ratios(report: StreamReport) -> Array:
    """`[V]` plasticity ratios; NaN where a fresh agent is optimal."""
    agent = report.region().agent
    if agent.fresh_normalised_regret is None:
        raise OptionError(
            "runs: a report has no fresh agents. Give evaluate_stream their policies, fresh=…."
        )
    return np.array(agent.plasticity_ratio, dtype=float)
