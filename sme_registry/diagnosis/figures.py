"""The figures of a diagnosis: by action channel, by state, by shell, by time; and training."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sme_registry.diagnosis.document import Diagnosis
from sme_registry.diagnosis.extended_figures import draw_distraction, draw_layers, draw_limits
from sme_registry.diagnosis.measurements import POLICY, Measurements
from sme_registry.diagnosis.render import title
from sme_registry.diagnosis.subject import Log
from sme_registry.evaluation.references import LABELS
from sme_registry.plots.curves import draw_training
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    WRITTEN,
    draw_reference,
    entitle,
    legend_above,
    legend_below,
    look,
    merge_coincident,
    new_figure,
    save_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINEAR = "linear_least_squares"
_REFERENCES = (_LINEAR, "best_constant", "constant_half", "uniform_random")
_MAX_CHANNELS = 32


def draw(diagnosis: Diagnosis, folder: Path, log: Log | None = None) -> tuple[Path, ...]:
    """Write the figures into a folder, as PNG and PDF; the training's only where there is a log."""
    figures: dict[str, Callable[[Figure, Measurements], None]] = {
        "where_channels": _channels,
        "where_states": partial(_states, threshold=diagnosis.thresholds["explained_variance"]),
        "where_time": _time,
        "what_the_error_is": _squared_error,
    }
    if log is not None:
        figures["training"] = partial(_training, log=log)
    figures |= _extended(diagnosis.measurements)
    written = []
    for name, fill in figures.items():
        with styled():
            figure = new_figure((8.2, 4.0))
            entitle(figure, title(diagnosis))
            fill(figure, diagnosis.measurements)
        written += save_figure(figure, folder / name, WRITTEN)
    return tuple(written)


def _extended(measured: Measurements) -> dict[str, Callable[[Figure, Measurements], None]]:
    """Those of limits, distractors and hidden layers, where there are any."""
    figures: dict[str, Callable[[Figure, Measurements], None]] = {}
    limits, distraction, observation = measured.limits, measured.distraction, measured.observation
    if limits is not None:
        figures["limits"] = lambda figure, _: draw_limits(figure, limits)
    if distraction is not None and observation is not None:
        figures["distraction"] = lambda figure, _: draw_distraction(
            figure, distraction, observation
        )
    if observation is not None and len(observation.probes) > 1:
        figures["layers"] = lambda figure, _: draw_layers(figure, observation)
    return figures


def _line(axes: Axes, x: Any, y: Any, index: int, label: str) -> None:
    axes.plot(x, y, **look(index), markersize=4.5, linewidth=2, label=label)


def _reference(axes: Axes, value: float, name: str) -> None:
    draw_reference(axes, name, None, value, LABELS[name])


def _legends(*panels: Axes, ncols: int = 1) -> None:
    """A legend above each panel, after its limits."""
    for axes in panels:
        low, high = axes.get_ylim()
        axes.set_ylim(min(0.0, low), high)
        merge_coincident([axes])
        legend_above(axes, ncols=ncols)


def _channels(figure: Figure, measured: Measurements) -> None:
    channels = measured.channels[:_MAX_CHANNELS]
    left, right = figure.subplots(1, 2)
    x = np.array([c.channel for c in channels])
    left.bar(
        x - 0.2, [c.normalised_regret for c in channels], 0.4, color=COLOURS[0], label="this policy"
    )
    left.bar(
        x + 0.2, [c.linear_normalised_regret for c in channels], 0.4, color="white", edgecolor=GREY,
        hatch="////", label=LABELS[_LINEAR],
    )  # fmt: skip
    _reference(left, 1.0, "constant_half")
    left.set_ylabel("normalised regret  (0 = optimal)")
    slopes = [c.slope for c in channels]
    saturated = [c.at_zero + c.at_one for c in channels]
    _line(right, x, slopes, 0, "slope of a on a*  (1 = optimal)")
    _line(right, x, [c.offset for c in channels], 1, "offset, mean of a − a*  (0 = optimal)")
    _line(right, x, saturated, 2, "share of states at 0 or 1")
    for value in (0.0, 1.0):
        right.axhline(value, color=GREY, linewidth=0.9)
    cut = len(measured.channels) > _MAX_CHANNELS
    for axes in (left, right):
        axes.set_xlabel("action channel" + (f" (the first {_MAX_CHANNELS})" if cut else ""))
        axes.set_xticks(x[:: max(1, len(x) // 8)])
    _legends(left, right)


def _states(figure: Figure, measured: Measurements, threshold: float) -> None:
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.2, 1.2))
    centre, *channels = measured.partitions
    best = sorted(channels, key=lambda p: -p.explained_variance)[:2]
    names = ["distance from the centre", *(f"state channel {p.state_channel}" for p in best)]
    short_names = ["distance", *(f"s{p.state_channel}" for p in best)]
    for index, part in enumerate((centre, *best)):
        left.bar(
            index, part.explained_variance, 0.6, color=COLOURS[index], edgecolor="white",
            hatch=("", "////", "....")[index],
        )  # fmt: skip
        _line(middle, 1 + np.arange(len(part.mae)), part.mae, index, names[index])
    left.set_xticks(range(len(names)), short_names)
    left.set_ylim(0.0, max(0.12, left.get_ylim()[1]))
    left.axhline(threshold, color=GREY, linewidth=1.1, label=f"stands out above {threshold:.0%}")
    left.set_ylabel("share of the error's\nvariance explained")
    left.set_xlabel("quantity that explains it")
    _reference(middle, measured.uniform[_LINEAR].mae, _LINEAR)
    middle.set_xticks(1 + np.arange(len(centre.mae)))
    middle.set_xlabel("fifth of the states, by quantity")
    middle.set_ylabel("error, mean |a − a*|")
    levels = [shell.epsilon for shell in measured.shells]
    for name in (POLICY, *_REFERENCES):
        values = [shell.scores[name].normalised_regret for shell in measured.shells]
        if name == POLICY:
            _line(right, levels, values, 0, "this policy")
        else:
            draw_reference(right, name, levels, values, LABELS[name])
    right.set_xticks(levels, ["WD", *(f"{level:g}" for level in levels[1:])])
    right.set_xlabel("expansion level ε of the shell")
    right.set_ylabel("normalised regret")
    _legends(left, middle, right)


def _time(figure: Figure, measured: Measurements) -> None:
    episodes, time = measured.on_policy, measured.time_dependence
    left, right = figure.subplots(1, 2)
    middles = (np.array(episodes.edges[:-1]) + np.array(episodes.edges[1:])) / 2
    _line(left, middles, episodes.regret, 0, "regret, 1 − r")
    _line(left, middles, episodes.mae, 1, "error, mean |a − a*|")
    if min(episodes.alive) < 1.0:
        _line(left, middles, episodes.alive, 2, "share of episodes running")
    for name in _REFERENCES[:3]:
        _reference(left, episodes.scores[name].regret, name)
    left.set_xlabel("step of the episode")
    left.set_ylabel(f"mean over {episodes.episodes} episodes\n(grey: regret of references)")
    _line(right, time.inputs, time.normalised_regret, 0, "in the same states")
    _line(right, time.inputs, time.action_change, 1, "change of a")
    _reference(right, measured.uniform[_LINEAR].normalised_regret, _LINEAR)
    right.set_xlabel("input t/T, in fixed states")
    right.set_ylabel("normalised regret;\nmean |change of a|")
    _legends(left, right)


def _squared_error(figure: Figure, measured: Measurements) -> None:
    error, episodes = measured.squared_error, measured.on_policy
    left, right = figure.subplots(1, 2)
    shares = {
        "offset": error.offset,
        "scale": error.scale,
        "residual": error.residual,
        "· noise": error.noise,
        "· input t/T": error.time,
        "· input r_cum/k": error.accumulated_reward,
    }
    bars = left.barh(list(shares), list(shares.values()), 0.6, color=COLOURS[0])
    left.bar_label(bars, [f"{share:.0%}" for share in shares.values()], padding=3, fontsize=8)
    left.invert_yaxis()
    left.set_xlim(0.0, 1.15)
    left.set_xticks(np.linspace(0, 1, 6))
    left.set_xlabel("share of the squared error")
    looks = {"rewarded": ("r > 0", COLOURS[2], ""), "gated": ("0 by r_min", COLOURS[4], "////"),
             "flat": ("r̂ = 0", "#cccccc", "")}  # fmt: skip
    for y, signal in enumerate((episodes.signal, episodes.random_signal)):
        start = 0.0
        for part, (name, colour, hatch) in looks.items():
            share = getattr(signal, part)
            right.barh(
                y, share, 0.55, left=start, color=colour, hatch=hatch, edgecolor="black",
                linewidth=0.5, label=name if y == 0 else "",
            )  # fmt: skip
            start += share
    right.set_yticks((0, 1), ("this policy", "random\nactions"))
    right.set_xlim(0.0, 1.0)
    right.set_ylim(1.6, -0.6)
    right.set_xlabel("share of steps")
    legend_above(right, ncols=3, columnspacing=1.0, handlelength=1.4)
    for axes in (left, right):
        axes.grid(visible=False, axis="y")


def _training(figure: Figure, measured: Measurements, log: Log) -> None:
    axes = figure.add_subplot()
    draw_training(axes, log.step, log.regret, each=log.source.removesuffix("s"))
    training, episodes = measured.training, measured.on_policy
    assert training is not None  # there is a log
    for name in _REFERENCES[:3]:
        _reference(axes, episodes.scores[name].regret, name)
    regret = episodes.scores[POLICY].regret
    axes.axhline(regret, color=COLOURS[1], linewidth=1.6, label="this policy")
    if training.improvement_step is not None:
        axes.axvline(training.improvement_step, color="black", linewidth=0.9, linestyle=":")
        late = training.improvement_step > training.steps / 2
        axes.annotate(
            "better than a constant", (training.improvement_step, 0.02),
            xytext=(-4 if late else 4, 0), textcoords="offset points", fontsize=8,
            ha="right" if late else "left",
        )  # fmt: skip
    merge_coincident([axes])
    legend_below(figure, axes.get_legend_handles_labels()[0])
