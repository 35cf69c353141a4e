"""The figures of a profile: N₀ over the levels of each axis, and the robustness along each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sme_registry.plots.style import COLOURS, GREY, MARKERS, draw_band, literal, new_figure, styled
from sme_registry.profiles.levels import AXES, Axis
from sme_registry.studies.report.figures.panels import (
    LINEAR,
    WIDTH,
    Look,
    legend,
    new_look,
    panel_grid,
    side_by_side,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sme_registry.profiles.document import Profile

_OTHERS = ("PPO", "TD3", "SAC")  # the order of their colours
_HIGHEST = 1.45  # N₀ that the figure shows
_LEAST = -0.6  # robustness


def _looks(profile: Profile, others: Sequence[Profile]) -> dict[str, dict[str, Any]]:
    """The profile in front; a method of several discounts has one colour. The constant has none."""
    methods = dict.fromkeys(other.name.partition(" (")[0] for other in others if other.learns)
    order = [*_OTHERS, *(name for name in methods if name not in _OTHERS)]
    looks = {profile.name: dict(new_look(COLOURS[0], MARKERS[0]))}
    for other in others:
        method, _, variant = other.name.partition(" (")
        if other.learns:
            i = 1 + order.index(method)
            looks[other.name] = dict(new_look(COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]))
            if variant:
                looks[other.name] |= {"linestyle": (0, (2, 1.5)), "markerfacecolor": "none"}
        elif other.name == "linear":
            looks[other.name] = dict(LINEAR)
    return looks


@styled()
def draw_axes(profile: Profile, others: Sequence[Profile]) -> Figure:
    """N₀ over the levels of each axis, a panel each; the others are behind."""
    looks, by_name = _looks(profile, others), {each.name: each for each in (*others, profile)}

    def draw(axes: Axes, axis: Axis) -> None:
        for name, look in reversed(looks.items()):
            _draw_line(axes, by_name[name], axis, look, front=name == profile.name)
        axes.axhline(1.0, color=GREY, linewidth=0.8, linestyle=(0, (1, 2)), zorder=1)
        axes.set_xticks(range(len(axis.levels)), [*axis.levels.values()])
        axes.set_xlim(-0.25, len(axis.levels) - 0.75)
        axes.set_ylim(0.0, _HIGHEST)
        axes.grid(visible=False, axis="x")

    items = [(axis.label, axis) for axis in AXES]
    return panel_grid(items, draw, (0.7, 1.75), y="N₀", looks=looks)


def _draw_line(axes: Axes, profile: Profile, axis: Axis, look: Look, *, front: bool) -> None:
    levels = [(i, profile.level(name)) for i, name in enumerate(axis.levels)]
    at = [(i, level) for i, level in levels if level.draws]
    if not at:
        return
    x, y = [i for i, _ in at], [level.value for _, level in at]
    banded = [(i, level) for i, level in at if not math.isnan(level.low)]
    if banded and (front or look["marker"]):
        bands = ([i for i, _ in banded], [e.low for _, e in banded], [e.high for _, e in banded])
        draw_band(axes, *bands, look["color"])
    width, alpha, order = (2.2, 1.0, 3) if front else (1.1, 0.75, 2)
    axes.plot(x, y, **look, linewidth=width, alpha=alpha, markersize=4, zorder=order)


@styled()
def draw_robustness(profile: Profile, others: Sequence[Profile]) -> Figure:
    """What is kept of the performance along each axis, a row each."""
    looks, by_name = _looks(profile, others), {each.name: each for each in (profile, *others)}
    figure = new_figure((WIDTH, 1.2 + 0.36 * len(AXES)))
    axes = figure.add_subplot()
    for name, look, shift in side_by_side(looks, 0.6):
        for row, axis in enumerate(AXES):
            kept = by_name[name].robustness(axis)
            if not kept.draws:
                continue
            front = name == profile.name
            marker = {**look, "marker": look["marker"] or "|", "linestyle": "none"}
            if not math.isnan(kept.low):
                width = 1.8 if front else 0.9
                axes.hlines(row + shift, kept.low, kept.high, color=look["color"], linewidth=width)
            size = 6.0 if front else 4.0
            axes.plot([kept.value], [row + shift], **marker, markersize=size, zorder=3)
    axes.set_yticks(range(len(AXES)), [literal(axis.label) for axis in AXES])
    axes.set_ylim(len(AXES) - 0.4, -0.6)
    axes.axvline(1.0, color="black", linewidth=0.9, zorder=1)
    axes.set_xlim(_LEAST, 1.35)
    axes.set_xlabel("robustness: share of the performance 1 − N₀ that is kept at the harder levels")
    axes.grid(visible=False, axis="y")
    legend(figure, looks)
    return figure
