"""The figures of a diagnosis: by channel, by state, by shell, by time, and the training."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sme_registry.diagnosis.report import Diagnosis
from sme_registry.diagnosis.subject import Log
from sme_registry.diagnosis.words import title
from sme_registry.evaluation.report import LABELS
from sme_registry.io import write_atomically
from sme_registry.plots import COLOURS, GREY, MARKERS, REFERENCE_DASHES, drawing, literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_REFERENCES = ("linear_least_squares", "best_constant", "constant_half", "uniform_random")
_CHANNELS_DRAWN = 32
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
        "what_the_error_is": ((8.2, 2.9), lambda figure: _form(figure, diagnosis)),
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
    channels = diagnosis.numbers.channels[:_CHANNELS_DRAWN]
    left, right = figure.subplots(1, 2)
    x = np.array([c.channel for c in channels])
    left.bar(x - 0.2, [c.normalised for c in channels], 0.4, color=COLOURS[0], label="this policy")
    left.bar(
        x + 0.2, [c.linear for c in channels], 0.4, color="white", edgecolor=GREY, hatch="////",
        label=LABELS["linear_least_squares"],
    )  # fmt: skip
    _reference(left, 1.0, "constant_half")
    left.set_ylabel("normalised error ν  (0 = optimal)")
    slopes = [c.slope for c in channels]
    saturated = [c.at_zero + c.at_one for c in channels]
    _line(right, x, slopes, 0, "slope of a on a*  (1 = right)")
    _line(right, x, [c.offset for c in channels], 1, "offset, mean of a − a*  (0 = right)")
    _line(right, x, saturated, 2, "share of states at 0 or 1")
    for value in (0.0, 1.0):
        right.axhline(value, color=GREY, linewidth=0.9)
    for axes in (left, right):
        axes.set_xlabel("action channel" + (f" (the first {len(x)})" * (len(x) < _all(diagnosis))))
        axes.set_xticks(x[:: max(1, len(x) // 8)])
        axes.set_ylim(top=axes.get_ylim()[1] * 1.3)
        axes.legend(loc="upper left", fontsize=8)


def _all(diagnosis: Diagnosis) -> int:
    return len(diagnosis.numbers.channels)


def _states(figure: Figure, diagnosis: Diagnosis) -> None:
    numbers = diagnosis.numbers
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.2, 1.2))
    centre, *channels = numbers.partitions
    shown = sorted(channels, key=lambda p: -p.explained)[:2]
    drawn = [(centre, "distance from the centre"), *((p, f"state channel {p.by}") for p in shown)]
    explained = [p.explained for p, _ in drawn]
    names = ["distance", *(f"s{p.by}" for p in shown)]
    bars = left.bar(range(len(names)), explained, 0.6, color=COLOURS[: len(names)])
    for bar, hatch in zip(bars, ("", "////", "...."), strict=False):
        bar.set_hatch(hatch)
        bar.set_edgecolor("white")
    left.set_xticks(range(len(names)), names)
    left.set_ylim(0.0, max(0.12, 1.1 * max(explained)))
    left.axhline(diagnosis.thresholds["explained_by_state"], color=GREY, linewidth=1.1)
    left.set_ylabel("share of the error's\nvariance explained")
    left.set_xlabel("line: counts from here")
    for index, (part, name) in enumerate(drawn):
        _line(middle, 1 + np.arange(len(part.error)), part.error, index, name)
    middle.axhline(
        numbers.uniform["linear_least_squares"].error,
        color=GREY, linewidth=1.1, linestyle=REFERENCE_DASHES["linear_least_squares"],
        label=LABELS["linear_least_squares"],
    )  # fmt: skip
    middle.set_xticks(1 + np.arange(len(centre.error)))
    middle.set_xlabel("fifth of the states, by each quantity")
    middle.set_ylabel("error, mean |a − a*|")
    levels = [shell.epsilon for shell in numbers.shells]
    _line(right, levels, [s.policies[""].normalised for s in numbers.shells], 0, "this policy")
    for who in _REFERENCES:
        values = [shell.policies[who].normalised for shell in numbers.shells]
        right.plot(
            levels, values, color=GREY, linewidth=1.1, linestyle=REFERENCE_DASHES[who],
            label=LABELS[who],
        )  # fmt: skip
    right.set_xticks(levels, ["WD", *(f"{level:g}" for level in levels[1:])])
    right.set_xlabel("expansion level ε of the shell")
    right.set_ylabel("normalised error ν")
    for axes in (middle, right):
        _from_zero(axes)
        axes.set_ylim(top=axes.get_ylim()[1] * 1.45)
        axes.legend(loc="upper left", fontsize=7)


def _time(figure: Figure, diagnosis: Diagnosis) -> None:
    episodes, clock = diagnosis.numbers.on_policy, diagnosis.numbers.clock
    left, right = figure.subplots(1, 2)
    middles = (np.array(episodes.edges[:-1]) + np.array(episodes.edges[1:])) / 2
    _line(left, middles, episodes.regret, 0, "regret, 1 − r")
    _line(left, middles, episodes.error, 1, "error, mean |a − a*|")
    if min(episodes.alive) < 1.0:
        _line(left, middles, episodes.alive, 2, "share still running")
    for who in _REFERENCES[:3]:
        _reference(left, episodes.scores[who].regret, who)
    left.set_xlabel("step of the episode")
    left.set_ylabel(f"mean over {episodes.episodes} episodes\n(grey: regret of references)")
    _line(right, clock.inputs, clock.normalised, 0, "ν in the same states")
    _line(right, clock.inputs, clock.moved, 1, "change of a")
    right.axhline(
        diagnosis.numbers.uniform["linear_least_squares"].normalised,
        color=GREY, linewidth=1.1, linestyle=REFERENCE_DASHES["linear_least_squares"],
        label=LABELS["linear_least_squares"],
    )  # fmt: skip
    right.set_xlabel("input t/T, the states held fixed")
    right.set_ylabel("normalised error ν; mean |change of a|")
    for axes in (left, right):
        _from_zero(axes)
        axes.set_ylim(top=axes.get_ylim()[1] * 1.4)
        axes.legend(loc="upper left", fontsize=8, ncols=2, columnspacing=1.2, handlelength=1.8)


def _form(figure: Figure, diagnosis: Diagnosis) -> None:
    form, episodes = diagnosis.numbers.form, diagnosis.numbers.on_policy
    left, right = figure.subplots(1, 2)
    rows = {
        "constant offset": form.offset,
        "slope not 1": form.scale,
        "the rest": form.residual,
        "· noise": form.noise,
        "· clock t/T": form.clock,
        "· r_cum/k": form.accumulated,
    }
    _bars(left, rows, "share of the squared error")
    signal, random = episodes.signal, episodes.signal_random
    parts = {"paid, r > 0": COLOURS[2], "hidden by r_min": COLOURS[4], "flat, r̂ = 0": "#cccccc"}
    for y, found in enumerate((signal, random)):
        start = 0.0
        for (name, colour), share, hatch in zip(
            parts.items(), (found.paid, found.hidden, found.flat), ("", "////", ""), strict=True
        ):
            right.barh(
                y, share, 0.55, left=start, color=colour, hatch=hatch, edgecolor="black",
                linewidth=0.5, label=name if y == 0 else "",
            )  # fmt: skip
            start += share
    right.set_yticks((0, 1), ("this policy", "random\nactions"))
    right.set_xlim(0.0, 1.0)
    right.set_ylim(2.4, -0.6)
    right.set_xlabel("share of steps on policy")
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
    found = diagnosis.numbers.training
    assert found is not None  # there is a log
    axes.scatter(log.step, log.regret, **_CLOUD, label=f"one of the {log.source}")
    window = found.window
    smooth = [np.median(log.regret[i : i + window]) for i in range(found.rows - window + 1)]
    axes.plot(
        log.step[window - 1 :], smooth, color=COLOURS[0], linewidth=2.2, label=f"median of {window}"
    )
    episodes = diagnosis.numbers.on_policy
    for who in _REFERENCES[:3]:
        _reference(axes, episodes.scores[who].regret, who)
    axes.axhline(
        episodes.scores[""].regret, color=COLOURS[1], linewidth=1.6, label="this policy, at the end"
    )
    if found.escaped_at is not None:
        axes.axvline(found.escaped_at, color="black", linewidth=0.9, linestyle=":")
        late = found.escaped_at > found.steps / 2
        axes.annotate(
            "better than a constant", (found.escaped_at, 0.02), xytext=(-4 if late else 4, 0),
            textcoords="offset points", fontsize=8, ha="right" if late else "left",
        )  # fmt: skip
    axes.set_ylim(-0.04, 1.04)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("mean regret per step  (1 − r)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")
