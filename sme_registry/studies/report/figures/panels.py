"""What the figures share: panels, the look of each algorithm, marks with intervals, and scales.

Values v₁ < … < vₙ are drawn on a logarithmic scale if all are above 0, n ≥ 3, and their logarithms
are spaced more evenly than they are themselves: cv(log vᵢ₊₁ − log vᵢ) < cv(vᵢ₊₁ − vᵢ), with cv the
standard deviation over the mean. So 1, 2, 5, 10 and 2, 4, 8 are, and 0.25, 0.5, 0.75 are not.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
import pandas as pd

from sme_registry.evaluation.report import NOT_COMPARABLE
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    MARKERS,
    REFERENCE_DASHES,
    draw_band,
    legend_below,
    literal,
    new_figure,
    wrapped,
)
from sme_registry.statistics import Array
from sme_registry.studies.report.analysis import ENOUGH_RUNS, Analysis
from sme_registry.studies.report.design import is_numeric

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Item = TypeVar("Item")
Look = Mapping[str, Any]
"""How an algorithm, a class or a reference is drawn, as arguments of `plot`."""

FEW = f"Hollow: fewer than {ENOUGH_RUNS}"
INDICATION = "so that the interval is an indication only."
WIDTH = 7.2  # inches: of a page, so that 9 points stay 9 points
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (8, 2)))
_LINE = 0.17  # inches: the height of a line of text


@dataclass(frozen=True)
class Picture:
    """A figure of a report; `files` are its bytes, by format."""

    name: str
    title: str
    caption: str
    figure: Figure
    is_map: bool = False
    files: Mapping[str, bytes] = field(default_factory=dict)


Drawn = Iterator[Picture]


def new_look(colour: Any, marker: str = "", dash: Any = "-") -> Look:
    return {"color": colour, "marker": marker, "linestyle": dash}


LINEAR = new_look(GREY, dash=REFERENCE_DASHES["linear"])
CONSTANT = new_look(GREY, dash=REFERENCE_DASHES["constant"])


def looks_of(analysis: Analysis, names: Iterable[str] | None = None) -> dict[str, Look]:
    """The look of each algorithm, or of these: colours for those that learn, grey for others."""
    looks = numbered_looks(dict.fromkeys((*analysis.coloured, *analysis.learners)))
    others = dict.fromkeys((*analysis.algorithms, *analysis.stream_algorithms))
    for i, name in enumerate(name for name in others if name not in looks):
        looks[name] = new_look(GREY, "x+12"[i % 4], DASHES[1 + i % 4])
    present = set(analysis.algorithms if names is None else names)
    return {name: look for name, look in looks.items() if name in present}


def numbered_looks(names: Iterable[str]) -> dict[str, Look]:
    """A look for each name, in order; each list is taken from its beginning again after its end."""
    looks = zip(itertools.cycle(COLOURS), itertools.cycle(MARKERS), itertools.cycle(DASHES))
    return {name: new_look(*look) for name, look in zip(names, looks, strict=False)}


def grid(
    items: Iterable[tuple[str, Item]],
    draw: Callable[[Axes, Item], Any],
    heights: tuple[float, float],
    *,
    x: str = "",
    y: str = "",
    looks: Mapping[str, Look] | None = None,
    width: float = WIDTH,
    across: int = 3,
    share_x: bool = False,
    share_y: bool | Literal["col"] = True,
    title_pad: float | None = None,
    bar: str = "",
    ticks: Any = None,
) -> Figure:
    """A figure with a titled panel for each item, and a legend of the looks below them.

    `heights` are those of the rest and of a row of panels. `x` and `y` are labels outside alone.
    With `bar`, a label, the colours of the first panel's map are below, with `ticks`.
    """
    titles, values = zip(*items, strict=True)
    across = min(across, len(values))
    down = math.ceil(len(values) / across)
    figure = new_figure((width, heights[0] + down * heights[1]))
    panels = figure.subplots(down, across, squeeze=False, sharex=share_x, sharey=share_y).ravel()
    used = list(panels[: len(values)])
    for unused in panels[len(values) :]:
        unused.set_visible(False)
    lines = 1
    for index, (axes, title, value) in enumerate(zip(used, titles, values, strict=True)):
        draw(axes, value)
        lowest = index + across >= len(values)
        if share_x:
            axes.tick_params(labelbottom=lowest)
        if x:
            axes.set_xlabel(x if lowest else "")
        if y:
            axes.set_ylabel("" if index % across else y)
        if title:
            text = wrapped(literal(title), 0.9 * width / across)
            axes.set_title(text, fontsize=9, pad=title_pad)
            lines = max(lines, 1 + text.count("\n"))
    figure.set_figheight(figure.get_figheight() + _LINE * (lines - 1) * down)
    if looks:
        legend(figure, looks)
    if bar:
        place: Any = {"location": "bottom", "shrink": 0.5, "aspect": 40, "pad": 0.02}
        colours = figure.colorbar(used[0].images[0], ax=used, label=bar, ticks=ticks, **place)
        colours.outline.set_visible(False)
    return figure


def by(rows: pd.DataFrame, column: str) -> list[tuple[str, pd.DataFrame]]:
    """Each value of a column and its rows, as items of panels."""
    return [(str(name), group) for name, group in rows.groupby(column, sort=False)]


def legend(figure: Figure, looks: Mapping[str, Look]) -> None:
    first = figure.axes[0]
    handles = [
        first.plot([], [], label=literal(name), markersize=4.5, linewidth=1.4, **look)[0]
        for name, look in looks.items()
    ]
    if any(map(_has_hollow_marks, figure.axes)):
        hollow: Any = {"marker": "o", "linestyle": "none", "color": GREY, "markersize": 4.5}
        handles += first.plot([], [], markerfacecolor="white", label=FEW.lower(), **hollow)
    legend_below(figure, handles)


def _has_hollow_marks(axes: Axes) -> bool:
    """Whether a panel has marks that rest on few runs."""
    return any(
        line.get_markerfacecolor() == "white" and np.size(line.get_xdata()) for line in axes.lines
    )


def side_by_side(looks: Mapping[str, Look], spread: float) -> Iterator[tuple[str, Look, float]]:
    """Each name and look, with a shift around their common place; `spread` is the whole width."""
    for index, (name, look) in enumerate(looks.items()):
        yield name, look, (index - (len(looks) - 1) / 2) * spread / len(looks)


def marks(
    axes: Axes,
    rows: pd.DataFrame,
    value: str,
    looks: Mapping[str, Look],
    spread: float,
    *,
    of: str = "algorithm",
    at: str = "at",
    upright: bool = False,
    joined: bool = False,
) -> None:
    """Marks of the column `value`, side by side at their place `at`, by the names in `of`.

    They are along x, or y if `upright`, with intervals from `low` to `high`, and hollow where a row
    rests on fewer than `ENOUGH_RUNS` runs, lives or pairs.
    """
    for name, look, shift in side_by_side(looks, spread):
        own = rows[rows[of] == name]
        place = own[at] + shift
        x, y = (place, own[value]) if upright else (own[value], place)
        if "enough_pairs" in own:
            enough = own.enough_pairs
        else:
            enough = own["fewest_runs" if "fewest_runs" in own else "runs"] >= ENOUGH_RUNS
        colour, known = look["color"], own.low.notna()
        if joined:
            axes.plot(x, y, **{**look, "marker": ""}, linewidth=1.1, alpha=0.7)
        if known.any():
            interval = axes.vlines if upright else axes.hlines
            interval(place[known], own.low[known], own.high[known], color=colour, linewidth=1.4)
        style = {**look, "linestyle": "none", "markersize": 4.5, "markeredgewidth": 1.1}
        for selected, face in ((enough, colour), (~enough, "white")):
            axes.plot(x[selected], y[selected], markerfacecolor=face, **style, zorder=3)


def draw_lines(
    axes: Axes, rows: pd.DataFrame, by: str, looks: Mapping[str, Look], x: str = "step"
) -> None:
    """The median and quartiles of each algorithm or class along x; markers do not coincide."""
    for index, (name, look) in enumerate(looks.items()):
        curve = rows[rows[by] == name]
        if not curve.empty:
            every = max(1, len(curve) // 6)
            columns = curve[[x, "q25", "median", "q75"]]
            line_with_band(axes, columns, look, (index * every // len(looks), every))


def line_with_band(axes: Axes, curve: pd.DataFrame, look: Look, markevery: tuple[int, int]) -> None:
    """The columns of a curve are x, the lower end of the band, the line, and the upper end."""
    x, low, middle, high = (curve[name] for name in curve)
    draw_band(axes, x, low, high, look["color"])
    axes.plot(x, middle, **look, linewidth=1.6, markersize=4, markevery=markevery)


def curves_caption(rows: pd.DataFrame) -> str:
    """What the lines and bands of these rows of `learning_curves` are."""
    window = rows.window.max()
    smoothed = f", each a running median over {window} evaluations" if window > 1 else ""
    return f"Median over runs, with the interquartile range as a band{smoothed}."


def dims(analysis: Analysis) -> list[int]:
    return sorted(set(analysis.tables["results"].state_dim))


def epsilon_remark(analysis: Analysis) -> str:
    """For captions with levels ε of several runs; "" where all have one state dimension."""
    return f" {NOT_COMPARABLE}" if len(dims(analysis)) > 1 else ""


def step_text(value: float, _: Any) -> str:
    """A number of steps as a tick: `20k`."""
    return f"{value / 1000:g}k" if value >= 10_000 else f"{value:g}"


def tick_steps(axes: Axes) -> None:
    axes.set_xlim(left=0)
    axes.locator_params(axis="x", nbins=4)
    axes.xaxis.set_major_formatter(step_text)


Spacing = Literal["linear", "log", "nominal"]


def spacing(values: Sequence[Any]) -> Spacing:
    """How values are spaced; nominal if they are no numbers in increasing order."""
    if len(values) < 2 or not is_numeric(values) or min(np.diff(values)) <= 0:
        return "nominal"
    if len(values) < 3 or values[0] <= 0:
        return "linear"
    return "log" if _variation(np.log(values)) < _variation(np.asarray(values)) else "linear"


def _variation(values: Any) -> float:
    """The coefficient of variation of the distances between values; dimensionless."""
    distances = np.diff(values)
    return float(distances.std() / distances.mean())


def positions(values: Sequence[Any], classes: int) -> Array:
    """Where classes are along x; `classes` in all, which may have no values."""
    kind = spacing(values)
    if kind == "nominal":
        return np.arange(classes, dtype=np.float64)
    return np.log(values) if kind == "log" else np.array(values, dtype=np.float64)


def tick_classes(axes: Axes, at: Array, labels: Sequence[str], *, nominal: bool) -> float:
    """A tick at each class; the smallest distance between two."""
    distance = float(np.diff(at).min()) if len(at) > 1 else 1.0
    longest = max(map(len, labels))
    crowded = len(labels) > 7 or longest > 12 or nominal
    turned: Any = {"rotation": 30, "ha": "right", "fontsize": 8}
    axes.set_xticks(at, labels, **(turned if crowded and longest > 4 else {}))
    axes.set_xlim(at[0] - distance / 2, at[-1] + distance / 2)
    axes.grid(visible=False, axis="x")
    return distance
