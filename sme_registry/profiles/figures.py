"""The figures of a profile: N₀ over the levels of each axis, and the robustness along each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sme_registry.plots.style import GREY, draw_band, literal, new_figure, styled
from sme_registry.profiles.levels import AXES, COMPARED, Axis
from sme_registry.studies.report.figures import panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sme_registry.profiles.document import Profile

_HIGHEST = 1.45  # N₀ that the figure shows
_LEAST, _MOST = -0.6, 1.35  # robustness


def _looks(profile: Profile, others: Sequence[Profile]) -> dict[str, panels.Look]:
    """The profile in front; a method of several discounts has one colour. The constant has none."""
    methods = [other.name.partition(" (")[0] for other in others if other.learns]
    numbered = panels.numbered_looks(dict.fromkeys(("", *COMPARED, *methods)))
    solid, hollow = {"linestyle": "-"}, {"linestyle": (0, (2, 1.5)), "markerfacecolor": "none"}
    looks: dict[str, panels.Look] = {profile.name: {**numbered[""], **solid}}
    for other in others:
        method, _, variant = other.name.partition(" (")
        if other.learns:
            looks[other.name] = {**numbered[method], **(hollow if variant else solid)}
        elif other.name == "linear":
            looks[other.name] = panels.LINEAR
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
    return panels.grid(items, draw, (0.7, 1.75), y="N₀", looks=looks)


def _draw_line(axes: Axes, profile: Profile, axis: Axis, look: panels.Look, *, front: bool) -> None:
    levels = enumerate(map(profile.level, axis.levels))
    points = [(i, level.value, level.low, level.high) for i, level in levels if level.draws]
    if not points:
        return
    x, y, low, high = zip(*points, strict=True)
    if front or look["marker"]:
        draw_band(axes, x, low, high, look["color"])
    width, alpha, order = (2.2, 1.0, 3) if front else (1.1, 0.75, 2)
    style = {**look, "linewidth": width, "alpha": alpha, "markersize": 4, "zorder": order}
    heights = np.minimum(y, _HIGHEST)  # of more, the mark is at the edge
    axes.plot(x, heights, **style, clip_on=False)


@styled()
def draw_robustness(profile: Profile, others: Sequence[Profile]) -> Figure:
    looks, by_name = _looks(profile, others), {each.name: each for each in (profile, *others)}
    looks = {
        name: {**look, "marker": look["marker"] or "D", "linestyle": "none"}
        for name, look in looks.items()
    }
    figure = new_figure((panels.WIDTH, 1.2 + 0.36 * len(AXES)))
    axes = figure.add_subplot()
    for name, look, shift in panels.side_by_side(looks, 0.6):
        for row, axis in enumerate(AXES):
            kept = by_name[name].robustness(axis, profile.classes)
            if not kept.draws:
                continue
            front = name == profile.name
            if not math.isnan(kept.low):
                width = 1.8 if front else 0.9
                axes.hlines(row + shift, kept.low, kept.high, color=look["color"], linewidth=width)
            size = 6.0 if front else 4.0
            value = min(max(kept.value, _LEAST), _MOST)  # of others, the mark is at the edge
            axes.plot([value], [row + shift], **look, markersize=size, zorder=3, clip_on=False)
    axes.set_yticks(range(len(AXES)), [literal(axis.label) for axis in AXES])
    axes.set_ylim(len(AXES) - 0.4, -0.6)
    axes.axvline(1.0, color="black", linewidth=0.9, zorder=1)
    axes.set_xlim(_LEAST, _MOST)
    axes.set_xlabel("robustness: share of the performance 1 − N₀ that is kept at the harder levels")
    axes.grid(visible=False, axis="y")
    panels.legend(figure, looks)
    return figure
