"""Training: `training_curve` and `cost_curve` of one run, `learning_curve` of several methods.

x is the total of environment steps over all environments, sorted: parallel lanes end their episodes
in any order, and many at one step. The line is the median of the last `window` episodes, or
evaluations, that ended by x: `statistics.smoothed`, in every figure and in a diagnosis.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation.streams import Visit
from sme_registry.plots.streams import shade_visits
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
from sme_registry.statistics import median, smoothed
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EPISODES = "episodes.csv"
Run = str | os.PathLike[str] | Mapping[str, Any] | Iterable[Any]

_DRAWN_POINTS = 400  # of a line; more would not be visible at this size


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
    all, at most 50. `visits` of a life in a stream are bands with their phases above.

    Args:
      episodes: the folder of a run of `sme train`, or its episodes.csv; columns `step` and
        `regret`, as a mapping of `[N]` arrays or a pandas frame; or rows that have both, as
        attributes or as keys.

    Examples:
      >>> from sme_registry.plots import training_curve
      >>> steps = np.arange(100, 2100, 100)
      >>> figure = training_curve({"step": steps, "regret": 100 / steps}, "regret.png")
      >>> figure.axes[0].get_xlabel()
      'environment steps'
    """
    step, regret = _points(episodes)
    with canvas(ax, (6.2, 4.0), path, title=title) as (axes,):
        draw_training(axes, step, regret, window)
        axes.axhline(0.0, color=GREY, linewidth=1.1, label="optimal")
        if visits:
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
    with canvas(ax, (6.2, 4.0), path, title=title) as (axes,):
        draw_training(axes, step, cost, window)
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

    Args:
      runs: from each method's name to its runs (seeds), each as in `training_curve`, where a
        single path or table needs no list; or one table of all, a pandas frame or a mapping of
        `[N]` arrays, with the columns `step` and `regret`, and `method` and `seed` where there
        are several.

    Examples:
      >>> from sme_registry.plots import learning_curve
      >>> steps = np.arange(100, 2100, 100)
      >>> runs = [{"step": steps, "regret": (100 + 10 * seed) / steps} for seed in range(3)]
      >>> figure = learning_curve({"mine": runs, "PPO": "runs/ppo"}, "regret.png")
    """
    methods = _methods(runs)
    if not methods or not all(methods.values()):
        raise OptionError("runs: must hold one or more runs of each method.")
    lines = {
        name: [smoothed(*_points(run), window)[:2] for run in method]
        for name, method in methods.items()
    }
    with canvas(ax, (6.2, 4.0), path, title=title) as (axes,):
        for index, (name, curves) in enumerate(lines.items()):
            _draw_method(axes, name, curves, look(index))
        axes.axhline(0.0, color=GREY, linewidth=1.1, label="optimal")
        if any(len(curves) > 1 for curves in lines.values()):
            name_bands(axes, "quartiles of runs (line: median)")
        _label_axes(axes)
    return figure_of(axes)


def draw_training(
    axes: Axes, step: Array, regret: Array, window: int | None = None, each: str = "episode"
) -> None:
    """A dot for each of `[N]` episodes or evaluations of a training, and their running median."""
    axes.scatter(
        step, regret, s=8, color=GREY, alpha=0.4, linewidths=0, rasterized=True, label=f"one {each}"
    )
    x, y, width = smoothed(step, regret, window)
    drawn = np.unique(np.linspace(0, len(x) - 1, _DRAWN_POINTS).round().astype(int))
    label = f"median of the last {width} {each}s"
    axes.plot(x[drawn], y[drawn], color=COLOURS[0], linewidth=2.2, label=label)
    _label_axes(axes)


def _label_axes(axes: Axes) -> None:
    axes.set_ylim(-0.04, 1.04)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
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
    x = np.linspace(begin, end, _DRAWN_POINTS)
    values = np.array([np.interp(x, *curve) for curve in curves])
    line = {**style, "linewidth": 2, "markersize": 4.5, "markevery": 0.13}
    draw_runs(axes, x, values, median, line, counted(name, values))


def _methods(runs: Any) -> dict[str, list[Any]]:
    """The runs of each method."""
    if not hasattr(runs, "keys"):
        raise OptionError(
            f"runs={runs!r:.60}: must map each method's name to its runs, such as "
            '{"TD3": ["runs/a", "runs/b"]}, or be a table. One run is a `training_curve`.'
        )
    if "regret" in runs:
        return _table(runs)
    methods = {}
    for name, given in runs.items():
        alone = isinstance(given, str | os.PathLike) or hasattr(given, "keys")
        if not alone and not isinstance(given, Iterable):
            raise OptionError(f"runs[{name!r}]={given!r:.60}: must be one or more runs.")
        methods[str(name)] = [given] if alone else list(given)
    return methods


def _table(table: Mapping[str, Any]) -> dict[str, list[Any]]:
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


def _points(run: Run, column: str = "regret") -> tuple[Array, Array]:
    """`[N]` environment steps at which episodes ended, and their mean regrets or costs."""
    source = "episodes"
    if isinstance(run, str | os.PathLike):
        path = Path(run) / EPISODES if Path(run).is_dir() else Path(run)
        source, run = str(path), _rows(path)
    try:
        if hasattr(run, "keys"):
            table: Any = run
            points = [np.asarray(table[name], dtype=np.float64) for name in ("step", column)]
        else:
            rows = list(run)
            points = [np.array([_field(r, name) for r in rows]) for name in ("step", column)]
        if points[0].ndim != 1 or points[0].shape != points[1].shape:
            raise ValueError
    except (KeyError, AttributeError, TypeError, ValueError):
        raise OptionError(
            f"{source}: every row must have numbers for step and {column}. "
            "Give the episodes.csv of a training run"
            f"{' on a task with safety' if column == 'cost' else ''}."
        ) from None
    if not len(points[0]):
        raise OptionError(f"{source}: contains no finished episode. Train for longer.")
    return points[0], points[1]


def _field(row: Any, name: str) -> float:
    if hasattr(row, "keys"):
        return float(row[name])
    return float(getattr(row if hasattr(row, name) else row.safety, name))


def _rows(path: Path) -> list[dict[str, Any]]:
    """The rows of an episodes.csv, without one that was cut short when the run was killed."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise OptionError(f"{path}: cannot be read: {error}. Give an episodes.csv.") from None
    rows: list[dict[str, Any]] = list(csv.DictReader(io.StringIO(text)))
    return rows[:-1] if rows and None in rows[-1].values() else rows
