"""What the figures share: a grid of panels, the look of each algorithm, marks, and the legend."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

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

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
