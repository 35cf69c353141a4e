"""What all figures share: style, colours, legends below the panels, files, and reports by path.

The colours are those of Okabe and Ito, which colour-blind readers can distinguish. Lines differ in
dash and marker too, for grey prints. Without pyplot nothing global changes: no display is needed.
"""

from __future__ import annotations

import contextlib
import io
import os
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, StreamReport
from sme_registry.io import require_packages, write_atomically
from sme_registry.statistics import Statistic
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

_Report = TypeVar("_Report", EvaluationReport, StreamReport)

# Metadata without a date, by format, so that equal figures are equal files.
_UNDATED: dict[str, Any] = {"png": {}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
FORMATS = tuple(_UNDATED)
WRITTEN = ("png", "pdf")  # what commands write
LINE_POINTS = 400  # of a line; more would not be visible at this size
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = "osD^vPX<>*"  # ten, with seven colours: the first 70 pairs all differ
GREY = "#707070"
REFERENCE_DASHES: dict[str, Any] = {
    "optimal": "-",
    "linear": (0, (6, 2)),
    "best_constant": (0, (3, 1, 1, 1)),
    "constant": (0, (4, 4)),
    "random": (0, (1, 2)),
    "safe_projection": (0, (8, 2, 1, 2)),
    "shrunk_optimal": (0, (2, 1)),
}
_DPI = 160
_LABEL_WIDTH = 60  # letters in a line of a legend
_REFERENCE = "reference "  # begins the gid of the line of a reference policy
_STYLE: Any = {
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "pdf.fonttype": 42,  # TrueType: journals refuse Type 3
    "ps.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "sme-registry",
}


@contextlib.contextmanager
def styled() -> Iterator[None]:
    """Matplotlib's settings for figures of this package, during the block."""
    require_packages("figures", {"matplotlib": "Matplotlib"}, "plot")
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        yield


def new_figure(size: tuple[float, float]) -> Figure:
    """An empty figure of this width and height in inches, in the style of the `styled` block.

    A notebook shows it, without pyplot, where it is the last value of a cell.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    vars(figure)["_repr_png_"] = lambda: encoded(figure, ["png"])["png"]
    return figure


def encoded(figure: Figure, formats: Iterable[str]) -> dict[str, bytes]:
    """The bytes of a figure in each format; equal figures give equal bytes."""
    files = {}
    with styled():
        for ending in formats:
            content = io.BytesIO()
            figure.savefig(content, format=ending, dpi=_DPI, metadata=_UNDATED[ending])
            files[ending] = content.getvalue()
    return files


def save_figure(
    figure: Figure, path: str | os.PathLike[str], formats: Sequence[str] | None = None
) -> list[Path]:
    """Write a figure, each file completely or not at all; equal figures give equal files.

    Fonts are embedded in PDF as TrueType, and SVG keeps its text. With `formats`, of "png", "pdf"
    and "svg", each is written next to the others with its own ending. Returns the paths.

    Examples:
      >>> from matplotlib.figure import Figure
      >>> from sme_registry.plots import save_figure
      >>> [path.name for path in save_figure(Figure(), "empty", ["png", "pdf"])]
      ['empty.png', 'empty.pdf']
    """
    path = Path(path)
    targets = [path] if formats is None else [Path(f"{path}.{ending}") for ending in formats]
    endings = [_format_of(target) for target in targets]
    files = encoded(figure, endings)
    return [write_atomically(t, files[ending]) for t, ending in zip(targets, endings, strict=True)]


def _format_of(path: str | os.PathLike[str]) -> str:
    ending = Path(path).suffix.removeprefix(".").lower()
    if ending not in FORMATS:
        raise OptionError(f"{path}: must end in {', '.join('.' + known for known in FORMATS)}.")
    return ending


@contextlib.contextmanager
def canvas(
    ax: Axes | Sequence[Axes] | None,
    size: tuple[float, float],
    path: str | os.PathLike[str] | None,
    panels: int = 1,
    title: str | None = None,
) -> Iterator[list[Axes]]:
    """The caller's panels, or those of a new figure, which then gets a title and a legend.

    The figure is written if there is a path.
    """
    if path is not None:
        _format_of(path)
    with styled():
        if ax is None:
            axes = list(new_figure(size).subplots(1, panels, squeeze=False)[0])
        else:
            axes = list(np.ravel(np.array(ax, dtype=object)))
        if len(axes) != panels:
            raise OptionError(f"ax: {len(axes)} axes for {panels} panels. Give as many as panels.")
        yield axes
        if ax is None and title:
            entitle(figure_of(axes[0]), title)
        merge_coincident(axes)
        if ax is None:
            legend_below(figure_of(axes[0]), axes[0].get_legend_handles_labels()[0])
    if path is not None:
        save_figure(figure_of(axes[0]), path)


def figure_of(axes: Axes) -> Figure:
    """The figure that axes are in, also where they are in a part of it."""
    figure: Figure = axes.figure.figure  # `get_figure(root=True)` is of Matplotlib 3.10
    return figure


def entitle(figure: Figure, title: str) -> None:
    """A title above all panels, wrapped to the width of the figure."""
    letters = int(12 * figure.get_figwidth())
    lines = [textwrap.fill(line, letters) for line in title.splitlines()]
    figure.suptitle(literal("\n".join(lines)), fontsize=10)


def legend_below(figure: Figure, handles: Sequence[Artist], most_across: int = 6) -> Legend | None:
    """A legend below all panels, which covers none: as many columns as fit, and a taller figure."""
    if not handles:
        return None
    labels = [textwrap.fill(str(handle.get_label()), _LABEL_WIDTH) for handle in handles]
    for across in range(min(most_across, len(handles)), 0, -1):
        legend = figure.legend(
            handles, labels, loc="outside lower center", ncols=across, columnspacing=1.4
        )
        box = legend.get_window_extent()
        if box.width <= figure.bbox.width or across == 1:
            break
        legend.remove()
    row = legend.prop.get_size_in_points() * 1.9 / 72.0
    height = max(0.0, box.height / figure.dpi - row)
    figure.set_figheight(figure.get_figheight() + height)
    return legend


def legend_above(axes: Axes, **options: Any) -> None:
    """A legend above a panel, which covers no data."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8, borderaxespad=0.2, **options
    )


def draw_band(axes: Axes, x: Any, low: Any, high: Any, colour: Any) -> None:
    """The spread of a method's runs around its line."""
    axes.fill_between(x, low, high, color=colour, alpha=0.16, linewidth=0)


def draw_runs(
    axes: Axes,
    x: Any,
    runs: Array,
    statistic: Statistic,
    style: Mapping[str, Any],
    label: str,
    banded: bool = True,
) -> None:
    """A method's line: a statistic of `[n, X]` runs; the quartiles of several are a band."""
    if banded and len(runs) > 1:
        low, high = np.quantile(runs, [0.25, 0.75], axis=0)
        draw_band(axes, x, low, high, style["color"])
    axes.plot(x, statistic(runs), **style, label=label)


def counted(name: str, runs: Sequence[Any] | Array) -> str:
    """The label of a method, with the number of its runs if there are several."""
    return literal(name) + (f" (n = {len(runs)})" if len(runs) > 1 else "")


def name_bands(axes: Axes, label: str) -> None:
    """An entry of the legend that says what bands and lines are."""
    axes.fill_between([], [], [], color=GREY, alpha=0.3, linewidth=0, label=label)


def draw_reference(axes: Axes, name: str, x: Any, y: Any, label: str, colour: Any = GREY) -> None:
    """The line of a reference policy: over x, or across the panel if x is None."""
    style: Any = {
        "color": colour, "linewidth": 1.1, "linestyle": REFERENCE_DASHES.get(name, "-"),
        "zorder": 1.5, "label": label, "gid": f"{_REFERENCE}{colour}",
    }  # fmt: skip
    axes.axhline(y, **style) if x is None else axes.plot(x, y, **style)


def merge_coincident(panels: Sequence[Axes]) -> None:
    """Draw reference policies that coincide, in every panel, as one line with both names.

    Lines coincide if they differ by less than a point of print. Call it when limits are final.
    """
    by_panel = [
        [line for line in axes.lines if str(line.get_gid() or "").startswith(_REFERENCE)]
        for axes in panels
    ]
    groups: list[list[int]] = []
    for index in range(min(map(len, by_panel), default=0)):
        for group in groups:
            if all(_coincide(lines[group[0]], lines[index]) for lines in by_panel):
                group.append(index)
                break
        else:
            groups.append([index])
    for lines in by_panel:
        for first, *others in groups:
            labels = [str(lines[i].get_label()) for i in (first, *others)]
            named = [label for label in labels if not label.startswith("_")]
            lines[first].set_label(" = ".join(named) if named else labels[0])
            for other in others:
                lines[other].set_visible(False)
                lines[other].set_label("_hidden")


def _coincide(one: Line2D, other: Line2D) -> bool:
    if one.get_gid() != other.get_gid():  # another task
        return False
    ends = [np.asarray(line.get_ydata(), dtype=float) for line in (one, other)]
    if ends[0].shape != ends[1].shape:
        return False
    axes: Any = one.axes
    points = [axes.transData.transform(np.column_stack([np.zeros_like(y), y])) for y in ends]
    apart = np.abs(points[0] - points[1])[:, 1].max()
    return bool(apart * 72.0 / figure_of(axes).dpi < 1.0)


def shades(count: int) -> list[tuple[float, ...]]:
    """Colours for ordered values, from dark to light, all legible on white."""
    from matplotlib import colormaps

    return [tuple(colour) for colour in colormaps["viridis"](np.linspace(0.0, 0.85, count))]


def look(index: int) -> Mapping[str, Any]:
    """The colour and marker of the line of this number, as arguments of `plot`."""
    return {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)]}


def wrapped(text: str, width: float) -> str:
    """Text in lines of at most this many inches, at nine points."""
    return textwrap.fill(text, max(8, int(11 * width)))


def literal(text: str) -> str:
    """Text that Matplotlib prints as it is, not as a formula."""
    return text.replace("$", r"\$")


def read_reports(given: Any, kind: type[_Report], file: str, argument: str) -> list[_Report]:
    """One report or several, those given by their paths or by folders with this file read."""
    if isinstance(given, kind | str | os.PathLike) or not isinstance(given, Iterable):
        given = [given]
    reports = []
    for report in given:
        if isinstance(report, str | os.PathLike):
            path = Path(report)
            report = kind.read(path / file if path.is_dir() else path)
        if not isinstance(report, kind):
            raise OptionError(
                f"{argument}={report!r:.60}: must be one or more {kind.__name__}s, paths of "
                f"{file}, or folders of runs."
            )
        reports.append(report)
    return reports
