"""The figures of a diagnosis: by action channel, by state, by shell, by time; and training."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sme_registry.diagnosis.document import POLICY, Diagnosis
from sme_registry.diagnosis.render import title
from sme_registry.diagnosis.subject import Log
from sme_registry.evaluation.report import LABELS
from sme_registry.io import write_atomically
from sme_registry.plots import COLOURS, GREY, MARKERS, REFERENCE_DASHES, drawing, literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_REFERENCES = ("linear_least_squares", "best_constant", "constant_half", "uniform_random")
_MAX_CHANNELS = 32
_CLOUD: dict[str, Any] = {"s": 8, "color": GREY, "alpha": 0.4, "linewidths": 0}


def draw(diagnosis: Diagnosis, folder: Path, log: Log | None = None) -> tuple[Path, ...]:
    """Write the figures into a folder; the one of the training only where there is a log.

    Raises:
      MissingDependencyError: Matplotlib is not installed.
      OptionError: a file cannot be written.
    """
    figures: dict[str, tuple[tuple[float, float], Callable[[Figure], None]]] = {
        "where_channels": ((8.2, 3.4), lambda figure: _channels(figure, diagnosis)),
        "where_states": ((8.2, 3.4), lambda figure: _states(figure, diagnosis)),
        "where_time": ((8.2, 3.4), lambda figure: _time(figure, diagnosis)),
        "what_the_error_is": ((8.2, 2.9), lambda figure: _squared_error(figure, diagnosis)),
    }
    if log is not None:
        figures["training"] = ((8.2, 3.4), lambda figure: _training(figure, diagnosis, log))
    written = []
    for name, (size, fill) in figures.items():
        with drawing(size, ("png",)) as (figure, files):
            figure.suptitle(literal(title(diagnosis)), fontsize=10)
            fill(figure)
        written.append(write_atomically(folder / f"{name}.png", files["png"]))
    return tuple(written)


def _line(axes: Axes, x: Any, y: Any, index: int, label: str) -> None:
    axes.plot(
        x, y, color=COLOURS[index], marker=MARKERS[index], markersize=4.5, linewidth=2, label=label
    )


def _reference(axes: Axes, value: float, who: str) -> None:
    axes.axhline(
        value, color=GREY, linewidth=1.1, linestyle=REFERENCE_DASHES[who], label=LABELS[who]
    )


def _from_zero(axes: Axes) -> None:
    low, high = axes.get_ylim()
    axes.set_ylim(min(0.0, low) if low < 0 else 0.0, high * 1.02)


def _channels(figure: Figure, diagnosis: Diagnosis) -> None:
    channels = diagnosis.measurements.channels[:_MAX_CHANNELS]
    left, right = figure.subplots(1, 2)
    x = np.array([c.channel for c in channels])
    left.bar(
        x - 0.2, [c.normalised_regret for c in channels], 0.4, color=COLOURS[0], label="this policy"
    )
    left.bar(
        x + 0.2, [c.linear_normalised_regret for c in channels], 0.4, color="white", edgecolor=GREY,
        hatch="////", label=LABELS["linear_least_squares"],
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
    cut = len(diagnosis.measurements.channels) > _MAX_CHANNELS
    for axes in (left, right):
        axes.set_xlabel("action channel" + (f" (the first {_MAX_CHANNELS})" if cut else ""))
        axes.set_xticks(x[:: max(1, len(x) // 8)])
        axes.set_ylim(top=axes.get_ylim()[1] * 1.3)
        axes.legend(loc="upper left", fontsize=8)


def _states(figure: Figure, diagnosis: Diagnosis) -> None:
    measured = diagnosis.measurements
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.2, 1.2))
    centre, *channels = measured.partitions
    best = sorted(channels, key=lambda p: -p.explained_variance)[:2]
    names = {None: "distance from the centre"} | {
        p.state_channel: f"state channel {p.state_channel}" for p in best
    }
    drawn = [centre, *best]
    explained = [p.explained_variance for p in drawn]
    short_names = ["distance", *(f"s{p.state_channel}" for p in best)]
    bars = left.bar(range(len(drawn)), explained, 0.6, color=COLOURS[: len(drawn)])
    for bar, hatch in zip(bars, ("", "////", "...."), strict=False):
        bar.set_hatch(hatch)
        bar.set_edgecolor("white")
    left.set_xticks(range(len(drawn)), short_names)
    left.set_ylim(0.0, max(0.12, 1.1 * max(explained)))
    left.axhline(diagnosis.thresholds["explained_variance"], color=GREY, linewidth=1.1)
    left.set_ylabel("share of the error's\nvariance explained")
    left.set_xlabel("line: threshold")
    for index, part in enumerate(drawn):
        x = 1 + np.arange(len(part.mae))
        _line(middle, x, part.mae, index, names[part.state_channel])
    middle.axhline(
        measured.uniform["linear_least_squares"].mae,
        color=GREY, linewidth=1.1, linestyle=REFERENCE_DASHES["linear_least_squares"],
        label=LABELS["linear_least_squares"],
    )  # fmt: skip
    middle.set_xticks(1 + np.arange(len(centre.mae)))
    middle.set_xlabel("fifth of the states, by quantity")
    middle.set_ylabel("error, mean |a − a*|")
    levels = [shell.epsilon for shell in measured.shells]
    _line(
        right,
        levels,
        [s.scores[POLICY].normalised_regret for s in measured.shells],
        0,
        "this policy",
    )
    for who in _REFERENCES:
        values = [shell.scores[who].normalised_regret for shell in measured.shells]
        right.plot(
            levels, values, color=GREY, linewidth=1.1, linestyle=REFERENCE_DASHES[who],
            label=LABELS[who],
        )  # fmt: skip
    right.set_xticks(levels, ["WD", *(f"{level:g}" for level in levels[1:])])
    right.set_xlabel("expansion level ε of the shell")
    right.set_ylabel("normalised regret")
    for axes in (middle, right):
        _from_zero(axes)
        axes.set_ylim(top=axes.get_ylim()[1] * 1.45)
        axes.legend(loc="upper left", fontsize=7)


def _time(figure: Figure, diagnosis: Diagnosis) -> None:
    episodes, time = diagnosis.measurements.on_policy, diagnosis.measurements.time_dependence
    left, right = figure.subplots(1, 2)
    middles = (np.array(episodes.edges[:-1]) + np.array(episodes.edges[1:])) / 2
    _line(left, middles, episodes.regret, 0, "regret, 1 − r")
    _line(left, middles, episodes.mae, 1, "error, mean |a − a*|")
    if min(episodes.alive) < 1.0:
        _line(left, middles, episodes.alive, 2, "share of episodes running")
    for who in _REFERENCES[:3]:
        _reference(left, episodes.scores[who].regret, who)
    left.set_xlabel("step of the episode")
    left.set_ylabel(f"mean over {episodes.episodes} episodes\n(grey: regret of references)")
    _line(right, time.inputs, time.normalised_regret, 0, "in the same states")
    _line(right, time.inputs, time.action_change, 1, "change of a")
    right.axhline(
        diagnosis.measurements.uniform["linear_least_squares"].normalised_regret,
        color=GREY, linewidth=1.1, linestyle=REFERENCE_DASHES["linear_least_squares"],
        label=LABELS["linear_least_squares"],
    )  # fmt: skip
    right.set_xlabel("input t/T, in fixed states")
    right.set_ylabel("normalised regret; mean |change of a|")
    for axes in (left, right):
        _from_zero(axes)
        axes.set_ylim(top=axes.get_ylim()[1] * 1.4)
        axes.legend(loc="upper left", fontsize=8, ncols=2, columnspacing=1.2, handlelength=1.8)


def _squared_error(figure: Figure, diagnosis: Diagnosis) -> None:
    error, episodes = diagnosis.measurements.squared_error, diagnosis.measurements.on_policy
    left, right = figure.subplots(1, 2)
    rows = {
        "offset": error.offset,
        "scale": error.scale,
        "residual": error.residual,
        "· noise": error.noise,
        "· input t/T": error.time,
        "· input r_cum/k": error.accumulated_reward,
    }
    _bars(left, rows, "share of the squared error")
    parts = {"r > 0": COLOURS[2], "0 by r_min": COLOURS[4], "r̂ = 0": "#cccccc"}
    for y, signal in enumerate((episodes.signal, episodes.random_signal)):
        start = 0.0
        for (name, colour), share, hatch in zip(
            parts.items(),
            (signal.rewarded, signal.gated, signal.flat),
            ("", "////", ""),
            strict=True,
        ):
            right.barh(
                y, share, 0.55, left=start, color=colour, hatch=hatch, edgecolor="black",
                linewidth=0.5, label=name if y == 0 else "",
            )  # fmt: skip
            start += share
    right.set_yticks((0, 1), ("this policy", "random\nactions"))
    right.set_xlim(0.0, 1.0)
    right.set_ylim(2.4, -0.6)
    right.set_xlabel("share of steps")
    right.legend(loc="lower center", ncols=3, fontsize=7, columnspacing=1.0, handlelength=1.4)
    right.grid(visible=False, axis="y")


def _bars(axes: Axes, rows: dict[str, float], label: str) -> None:
    axes.barh(list(rows), list(rows.values()), 0.6, color=COLOURS[0])
    for index, value in enumerate(rows.values()):
        axes.annotate(
            f"{value:.0%}", (value, index), xytext=(3, 0), textcoords="offset points", va="center",
            fontsize=8,
        )  # fmt: skip
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.15)
    axes.set_xticks(np.linspace(0, 1, 6))
    axes.set_xlabel(label)
    axes.grid(visible=False, axis="y")


def _training(figure: Figure, diagnosis: Diagnosis, log: Log) -> None:
    axes = figure.add_subplot()
    training = diagnosis.measurements.training
    assert training is not None  # there is a log
    axes.scatter(log.step, log.regret, **_CLOUD, label=f"one of the {log.source}")
    window = training.window
    median = [np.median(log.regret[i : i + window]) for i in range(training.rows - window + 1)]
    axes.plot(
        log.step[window - 1 :], median, color=COLOURS[0], linewidth=2.2, label=f"median of {window}"
    )
    episodes = diagnosis.measurements.on_policy
    for who in _REFERENCES[:3]:
        _reference(axes, episodes.scores[who].regret, who)
    axes.axhline(
        episodes.scores[POLICY].regret, color=COLOURS[1], linewidth=1.6, label="this policy"
    )
    if training.improvement_step is not None:
        axes.axvline(training.improvement_step, color="black", linewidth=0.9, linestyle=":")
        late = training.improvement_step > training.steps / 2
        axes.annotate(
            "better than a constant", (training.improvement_step, 0.02),
            xytext=(-4 if late else 4, 0), textcoords="offset points", fontsize=8,
            ha="right" if late else "left",
        )  # fmt: skip
    axes.set_ylim(-0.04, 1.04)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("mean regret per step  (1 − r)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")
