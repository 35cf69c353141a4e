"""What the figures share: a grid of panels, the look of each algorithm, marks, and the scale.

Values v₁ < … < vₙ are drawn on a logarithmic scale if all are above 0, n ≥ 3, and their logarithms
are spaced more evenly than they are themselves: cv(log vᵢ₊₁ − log vᵢ) < cv(vᵢ₊₁ − vᵢ), with cv the
standard deviation over the mean. So 1, 2, 5, 10 and 2, 4, 8 are, and 0.25, 0.5, 0.75 are not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from sme_registry.evaluation.tables import NOT_COMPARABLE
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    MARKERS,
    REFERENCE_DASHES,
    drawing,
    legend_below,
    literal,
    wrapped,
)
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import is_numeric

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LABELS = 2.4  # inches of the names of rows
WIDTH = 7.2  # inches: of a page, so that 9 points stay 9 points
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (8, 2)))
HEADINGS = {"wd_regret": "within distribution (WD)", "ood_regret": "out of distribution (OOD)"}


@dataclass(frozen=True)
class Picture:
    """A drawn figure."""

    name: str
    title: str
    caption: str
    files: Mapping[str, bytes]
    is_map: bool = False


class Look(NamedTuple):
    """How an algorithm, a class or a reference is drawn."""

    colour: Any
    marker: str
    dash: Any

    @property
    def line(self) -> dict[str, Any]:
        """As arguments of `plot`, for a line with marks."""
        return {"color": self.colour, "marker": self.marker, "linestyle": self.dash}

    @property
    def points(self) -> dict[str, Any]:
        """As arguments of `plot`, for marks alone."""
        return self.line | {"linestyle": "none"}


LINEAR = Look(GREY, "", REFERENCE_DASHES["linear_least_squares"])
CONSTANT = Look(GREY, "", REFERENCE_DASHES["constant_half"])


class Grid(NamedTuple):
    """Panels in reading order."""

    figure: Figure
    files: dict[str, bytes]
    stacks: Any
    across: int

    @property
    def panels(self) -> list[Axes]:
        """The lowest axes of each panel: its only one, unless panels are stacks."""
        return list(self.stacks[:, -1])

    def label_rows(self, label: str, row: int = -1) -> None:
        """Label the y axis of the first panel in each row of the grid."""
        for stack in self.stacks[:: self.across]:
            stack[row].set_ylabel(label)

    def label_columns(self, label: str) -> None:
        """Label the x axis of the lowest panel in each column of the grid, and of no other."""
        for index, axes in enumerate(self.panels):
            lowest = index + self.across >= len(self.panels)
            axes.tick_params(labelbottom=lowest)
            axes.set_xlabel(label if lowest else "")


@contextmanager
def panel_grid(
    panels: int,
    formats: Sequence[str],
    heights: tuple[float, float],
    *,
    width: float = WIDTH,
    most_across: int = 3,
    stack: int = 1,
    share_x: bool = False,
) -> Iterator[Grid]:
    """A figure of panels with a common y axis; its files are complete after the block."""
    across = min(most_across, panels)
    down = math.ceil(panels / across)
    with drawing((width, heights[0] + down * heights[1]), formats) as (figure, files):
        grid = figure.subplots(stack * down, across, squeeze=False)
        stacks = np.concatenate([block.T for block in np.split(grid, down)])
        for unused in stacks[panels:].ravel():
            unused.set_visible(False)
        for index, panel in enumerate(stacks[:panels]):
            for row, axes in enumerate(panel):
                if index:
                    axes.sharey(stacks[0][row])
                if row < stack - 1:
                    axes.sharex(panel[-1])
                    axes.tick_params(labelbottom=False)
                axes.tick_params(labelleft=index % across == 0)
            if share_x and index:
                panel[-1].sharex(stacks[0][-1])
        yield Grid(figure, files, stacks[:panels], across)
        _wrap_titles(figure, stacks[:panels], width / across, down)


def _wrap_titles(figure: Figure, stacks: Any, width: float, down: int) -> None:
    """Wrap titles and x labels to the width of a panel in inches; the figure grows with them."""
    grown = 0
    for texts in (
        [stack[0].title for stack in stacks],
        [stack[-1].xaxis.label for stack in stacks],
    ):
        more = 0
        for each in texts:
            lines = str(each.get_text()).splitlines()
            each.set_text("\n".join(wrapped(line, 0.9 * width) for line in lines))
            more = max(more, each.get_text().count("\n") + 1 - max(1, len(lines)))
        grown += more
    figure.set_figheight(figure.get_figheight() + 0.17 * grown * down)


def epsilon_remark(analysis: Analysis) -> str:
    """For captions with levels ε of several runs; "" where all have one state dimension."""
    return f" {NOT_COMPARABLE}" if len(analysis.state_dims) > 1 else ""


def looks(analysis: Analysis) -> dict[str, Look]:
    """The look of each algorithm: colours for those that learn, grey for references."""
    result = numbered_looks(analysis.learners)
    references = [name for name in analysis.algorithms if name not in result]
    for i, name in enumerate(references):
        result[name] = Look(GREY, "x+12"[i % 4], DASHES[1 + i % 4])
    return result


def numbered_looks(
    names: Iterable[str], colours: Sequence[Any] = COLOURS, dashes: Sequence[Any] = DASHES
) -> dict[str, Look]:
    """A look for each name, in order; each list is taken from its beginning again after its end."""
    return {
        name: Look(colours[i % len(colours)], MARKERS[i % len(MARKERS)], dashes[i % len(dashes)])
        for i, name in enumerate(names)
    }


def side_by_side(looks: Mapping[str, Look], spread: float) -> Iterator[tuple[str, Look, float]]:
    """Each name and look, with a shift around their common place; `spread` is the whole width."""
    for index, (name, look) in enumerate(looks.items()):
        yield name, look, (index - (len(looks) - 1) / 2) * spread / len(looks)


def marks(
    axes: Axes,
    rows: pd.DataFrame,
    value: str,
    at: pd.Series,
    filled: pd.Series,
    look: Look,
    *,
    upright: bool = False,
    joined: bool = False,
) -> None:
    """The column `value` along x, or y if `upright`, with its intervals from `low` to `high`."""
    if joined:
        axes.plot(at, rows[value], color=look.colour, linewidth=1.1, linestyle=look.dash, alpha=0.7)
    style = look.points | {"markersize": 4.5, "markeredgewidth": 1.1, "zorder": 3}
    for x, y, low, high, is_filled in zip(
        at, rows[value], rows.low, rows.high, filled, strict=True
    ):
        point, ends = ((x, y), ((x, x), (low, high)))
        if not upright:
            point, ends = point[::-1], ends[::-1]
        if not math.isnan(low):
            axes.plot(*ends, color=look.colour, linewidth=1.4)
        axes.plot(*point, markerfacecolor=look.colour if is_filled else "white", **style)


def marks_by_algorithm(
    axes: Axes,
    rows: pd.DataFrame,
    value: str,
    at: pd.Series,
    filled: pd.Series,
    looks: Mapping[str, Look],
    *,
    spread: float = 0.7,
    **options: bool,
) -> None:
    """`marks` of each algorithm, next to one another around each place."""
    for name, look, shift in side_by_side(looks, spread):
        selected = rows.algorithm == name
        marks(axes, rows[selected], value, at[selected] + shift, filled[selected], look, **options)


def legend(figure: Figure, looks: Mapping[str, Look], across: int = 6) -> None:
    """The legend below a figure, with at most `across` entries in a row."""
    handles = [
        figure.axes[0].plot(
            [], [], label=literal(name), markersize=4.5, linewidth=1.4, **look.line
        )[0]
        for name, look in looks.items()
    ]  # fmt: skip
    legend_below(figure, handles, across)


class Column(NamedTuple):
    """A panel of a figure whose rows of marks have names.

    `rows` has, beside the marks, the columns `place` (the row's name) and `enough` (filled marks).
    """

    rows: pd.DataFrame
    label: str
    title: str = ""
    neutral: float | None = None
    ticks: int | None = None
    limits: tuple[float, float] | None = None


def mark_rows(
    columns: Sequence[Column],
    value: str,
    places: Mapping[str, float],
    looks: Mapping[str, Look],
    formats: Sequence[str],
    *,
    alike: int = 0,
    most_across: int = 3,
    shaded: bool = True,
) -> Mapping[str, bytes]:
    """A figure with a named row of marks at the height of each place; its first panels share x.

    `alike` is how many do. There is a legend if algorithms have names.
    """
    height = 1.3 + (0.09 * len(looks) + 0.12) * max(4.0, max(places.values()) + 1)
    with panel_grid(len(columns), formats, (0.0, height), most_across=most_across) as grid:
        for axes in grid.panels[1:alike]:
            axes.sharex(grid.panels[0])
        for axes, column in zip(grid.panels, columns, strict=True):
            at, filled = column.rows.place.map(places), column.rows.enough
            marks_by_algorithm(axes, column.rows, value, at, filled, looks)
            if column.neutral is not None:
                axes.axvline(column.neutral, color="black", linewidth=0.9, zorder=1.5)
            if column.limits is not None:
                axes.set_xlim(*column.limits)
            axes.set_title(column.title, fontsize=9)
            axes.set_xlabel(column.label)
            if column.ticks is not None:
                axes.locator_params(axis="x", nbins=column.ticks)
        _name_rows(grid, places, shaded=shaded)
        if [*looks] != [""]:
            legend(grid.figure, looks)
    return grid.files


def _name_rows(grid: Grid, places: Mapping[str, float], *, shaded: bool) -> None:
    """Rows of marks from top to bottom, on light bands instead of grid lines."""
    for axes in grid.panels:
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        for y in places.values() if shaded else ():
            axes.axhspan(y - 0.42, y + 0.42, color="#f4f4f4", zorder=0.5, linewidth=0)
    first = grid.panels[0]
    labels = [wrapped(literal(name), _LABELS) for name in places]
    first.set_yticks([*places.values()], labels, fontsize=8)
    more = max(label.count("\n") for label in labels)
    grid.figure.set_figheight(grid.figure.get_figheight() + 0.13 * more * len(labels))
    first.set_ylim(max(places.values()) + 0.6, -0.6)


Spacing = Literal["linear", "log", "nominal"]


def spacing(values: Sequence[Any]) -> Spacing:
    """How values are spaced; nominal if they are no numbers in increasing order."""
    if len(values) < 2 or not is_numeric(values) or min(np.diff(values)) <= 0:
        return "nominal"
    if len(values) < 3 or values[0] <= 0:
        return "linear"
    return "log" if _variation(np.log(values)) < _variation(np.asarray(values)) else "linear"


@dataclass(frozen=True)
class Scale:
    """The places of classes along x."""

    spacing: Spacing
    at: tuple[float, ...]

    @classmethod
    def of(cls, values: Sequence[Any], classes: int) -> Scale:
        """The scale of an axis' values; `classes` in all, which may have no values."""
        kind = spacing(values)
        places = range(classes) if kind == "nominal" else values
        return cls(kind, tuple(float(place) for place in places))

    def shifted(self, x: Any, shift: float) -> Any:
        """Places moved by a share of the smallest distance between two classes."""
        if self.spacing == "log":
            return x * np.exp(shift * np.diff(np.log(self.at)).min())
        distance = np.diff(self.at).min() if len(self.at) > 1 else 1.0
        return x + shift * distance

    def apply(self, axes: Any, labels: Sequence[str]) -> None:
        """Give an axes this scale, with a tick at each class."""
        if self.spacing == "log":
            axes.set_xscale("log")
            axes.minorticks_off()
        crowded = len(labels) > 7 or max(map(len, labels)) > 12 or self.spacing == "nominal"
        long = crowded and max(map(len, labels)) > 4
        turned = {"rotation": 30, "ha": "right", "fontsize": 8} if long else {}
        axes.set_xticks(self.at, labels, **turned)
        axes.set_xlim(self.shifted(self.at[0], -0.5), self.shifted(self.at[-1], 0.5))


def _variation(values: Any) -> float:
    """The coefficient of variation of the distances between values; dimensionless."""
    distances = np.diff(values)
    return float(distances.std() / distances.mean())
