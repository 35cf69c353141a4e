"""Figures: decay outside the training cube, similarity over the plane, regret during training.

Every figure is one file, PNG, PDF or SVG by its ending, and is drawn off screen, without a
display; `drawing` is how. Colours are those of Okabe and Ito, which the colour-blind tell apart;
lines also differ in dash and marker, and maps in lightness, so that a print in grey can be read.
"""

from __future__ import annotations

import contextlib
import csv
import io
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sme_registry.compiled import engine
from sme_registry.errors import MissingDependencyError, OptionError
from sme_registry.evaluation import EvaluationReport, as_policy
from sme_registry.evaluation.report import LABELS
from sme_registry.io import write_atomically
from sme_registry.spec import SMESpec, catalogue
from sme_registry.task import load_spec, materialize
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["decay_curve", "similarity_map", "training_curve"]

Measure = Literal["similarity", "normalised_regret"]

# What keeps a format's date out of the file: the same figure is the same file.
_UNDATED: dict[str, Any] = {"png": {}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
FORMATS = tuple(_UNDATED)
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = "osD^vPX<>*"  # ten beside seven colours: no two of the first 70 share both
GREY = "#707070"
_DRAWN_POINTS = 400  # of a smoothed line: enough for its every bend at this size
REFERENCE_DASHES: dict[str, Any] = {
    "optimal": "-",
    "linear_least_squares": (0, (6, 2)),
    "best_constant": (0, (3, 1, 1, 1)),
    "constant_half": (0, (4, 4)),
    "uniform_random": (0, (1, 2)),
}
_MEASURES = {
    "similarity": "similarity r̃  (1 = optimal)",
    "normalised_regret": "normalised regret  (1 = constant ½)",
}
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
    "svg.fonttype": "none",
    "svg.hashsalt": "sme-registry",
}


def decay_curve(
    reports: EvaluationReport | Sequence[EvaluationReport],
    path: str | os.PathLike[str],
    *,
    measures: Sequence[Measure] = ("similarity", "normalised_regret"),
    references: bool = True,
) -> Path:
    """Draw reports over the expansion level ε, one panel a measure, one line a report.

    One report of a team, drawn alone, has a thinner line for each agent, too.

    Args:
      reports: one or more; named by their policies.
      path: the file to write, .png, .pdf or .svg.
      measures: "similarity" and "normalised_regret", or one of them.
      references: whether the reference policies are drawn, thin, once for each task: in grey,
        or where there are several tasks in the colour of the task's first report.

    Returns:
      The path written.

    Raises:
      OptionError: no report, an unknown measure or ending, or a file that cannot be written.
      MissingDependencyError: Matplotlib is not installed.
    """
    reports = [reports] if isinstance(reports, EvaluationReport) else list(reports)
    if not reports:
        raise OptionError("reports: must be one or more evaluation reports. Give one.")
    if not measures or any(measure not in _MEASURES for measure in measures):
        raise OptionError(f"measures={measures!r:.70}: must be of {', '.join(_MEASURES)}.")
    with _drawing(path, (4.6 * len(measures) + 1.6, 3.7)) as figure:
        panels = figure.subplots(1, len(measures), squeeze=False)[0]
        for axes, measure in zip(panels, measures, strict=True):
            _decay_panel(axes, reports, measure, references)
        tasks = {report.spec_digest: catalogue.title(report.spec) for report in reports}
        if len(tasks) == 1:
            figure.suptitle(*tasks.values(), fontsize=10)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center")
    return Path(path)


def _decay_panel(
    axes: Axes, reports: Sequence[EvaluationReport], measure: Measure, references: bool
) -> None:
    def line(regions: Any) -> tuple[list[float], list[float]]:
        return [r.epsilon_high for r in regions], [getattr(r, measure) for r in regions]

    for index, report in enumerate(reports):
        axes.plot(
            *line(report.regions),
            color=COLOURS[index % len(COLOURS)],
            marker=MARKERS[index % len(MARKERS)],
            markersize=4.5,
            linewidth=2,
            label=literal(report.policy),
        )
    agents = reports[0].agents if len(reports) == 1 else {}
    for index, (name, agent) in enumerate(agents.items()):
        several = len(agents) >= len(COLOURS)  # more than can be told apart
        label = name if not several else "" if index else f"each of {len(agents)} agents"
        axes.plot(
            *line(agent.regions),
            color=COLOURS[5 if several else index + 1],
            marker="" if several else MARKERS[index + 1],
            markersize=3.5,
            linewidth=1.2,
            alpha=0.8,
            zorder=1.8,
            label=label,
        )
    tasks: dict[str, int] = {}
    for index, report in enumerate(reports if references else ()):
        tasks.setdefault(report.spec_digest, index)
    for index in tasks.values():
        for name, regions in reports[index].references.items():
            axes.plot(
                *line(regions),
                color=GREY if len(tasks) == 1 else COLOURS[index % len(COLOURS)],
                linewidth=1.1,
                linestyle=REFERENCE_DASHES.get(name, "-"),
                zorder=1.5,
            )
    for name in reports[0].references if references else ():
        dash = REFERENCE_DASHES.get(name, "-")
        axes.plot([], [], color=GREY, linewidth=1.1, linestyle=dash, label=LABELS.get(name, name))
    levels = sorted({r.epsilon_high for report in reports for r in report.regions})
    dims = sorted({report.spec.state_dim for report in reports})
    warning = (
        "different S: these levels are not comparable"
        if len(dims) > 1
        else f"S = {dims[0]}; not comparable with another S"
    )
    axes.set_xlabel(f"outer expansion level ε of the region\n{warning}")
    axes.set_ylabel(_MEASURES[measure])
    if len(levels) <= 12:
        axes.set_xticks(levels, [f"{level:g}" if level > 0 else "WD" for level in levels])
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.5) if measure == "similarity" else 0.0 - 0.03 * high, high)


def similarity_map(
    policy: Any,
    spec_or_id: SMESpec | dict[str, Any] | str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    epsilon: float = 1.0,
    resolution: int = 240,
    time: float = 0.5,
    action_range: str | None = None,
    name: str | None = None,
) -> Path:
    """Draw r̃ of a policy over the plane of a task with two state channels, beyond its unit square.

    Args:
      policy: what `evaluate` takes.
      spec_or_id: a task with state_dim=2.
      path: the file to write, .png, .pdf or .svg.
      epsilon: how far out, in (0, 100]: the plane shown is the cube X_ε; 1 is [−½, 1½]².
      resolution: points along each side, in [2, 2000].
      time: the time input t/T that the policy is given, in [0, 1]; r_cum/k is 0.
      action_range: "unit" or "symmetric"; None as in `evaluate`.
      name: what the title calls the policy.

    Returns:
      The path written.

    Raises:
      OptionError: the task is no plane, or an argument is out of range.
      PolicyError: the policy cannot be loaded, or its actions cannot be used.
      UnknownNameError, SpecError: no such task, or a field out of range.
      MissingDependencyError: Matplotlib is not installed.
    """
    spec = load_spec(spec_or_id)
    if spec.state_dim != 2:
        raise OptionError(
            f"state_dim={spec.state_dim}: must be 2 for a map. Take a task such as SME/Plane1-v1."
        )
    _within("epsilon", epsilon, 0.0, 100.0, open_below=True)
    _within("resolution", resolution, 2, 2000)
    _within("time", time, 0.0, 1.0)
    asked = as_policy(policy, spec, action_range=action_range, name=name)
    low, high = -epsilon / 2.0, 1.0 + epsilon / 2.0
    with _drawing(path, (5.0, 4.2)) as figure:
        side = low + (np.arange(int(resolution)) + 0.5) * (high - low) / int(resolution)
        similarity = similarity_on_grid(asked, spec, side, time)
        axes = figure.add_subplot()
        axes.grid(visible=False)
        image = axes.imshow(
            similarity,
            origin="lower",
            extent=(low, high, low, high),
            vmin=0.0,
            vmax=1.0,
            cmap="viridis",
            interpolation="nearest",
        )
        draw_unit_square(axes, 3.0, 1.2)
        bar = figure.colorbar(image, ax=axes, label="similarity r̃  (1 = optimal)")
        bar.outline.set_visible(False)
        inside = (side >= 0.0) & (side <= 1.0)
        means = [similarity[np.ix_(inside, inside)].mean(), similarity.mean()]
        axes.set_title(
            f"{literal(asked.name)} on {catalogue.title(spec)}, L = {spec.complexity}\n"
            f"mean r̃ {means[0]:.3f} in the unit square, {means[1]:.3f} in all shown"
        )
        axes.locator_params(nbins=5)
        axes.set_xlabel("state channel 1")
        axes.set_ylabel("state channel 2")
    return Path(path)


def draw_unit_square(axes: Axes, outer: float, inner: float) -> None:
    """The outline of the unit square, white around black: visible on dark and on light colours."""
    for colour, width in (("white", outer), ("black", inner)):
        axes.plot([0, 1, 1, 0, 0], [0, 0, 1, 1, 0], color=colour, linewidth=width)


def similarity_on_grid(asked: Any, spec: SMESpec, side: Array, time: float) -> Array:
    """r̃ of a policy over the plane of a task with two state channels.

    Args:
      asked: what `as_policy` returns.
      spec: the task.
      side: `[N]` of each state channel.
      time: the input t/T.

    Returns:
      `[N, N]` in [0, 1], rows by the second state channel.
    """
    task = materialize(spec)
    oracle = engine(task).optimal_action
    rows = []
    for second in side:
        observations = np.zeros((len(side), 4), dtype=np.float32)
        observations[:, 0], observations[:, 1], observations[:, 2] = side, second, time
        s = observations[:, :2].astype(np.float64)
        a = np.clip(asked(observations), 0.0, 1.0)
        rows.append(task.similarity_of(a, oracle(s)))
    return np.array(rows)


def training_curve(
    episodes: str | os.PathLike[str] | Iterable[Any],
    path: str | os.PathLike[str],
    *,
    title: str = "",
    window: int | None = None,
) -> Path:
    """Draw the exact mean regret of each training episode over environment steps.

    The cloud is the episodes; the line their running median over a centred window.

    Args:
      episodes: the path of a run's episodes.csv, or rows with `step` and `regret`, as
        attributes or as keys.
      path: the file to write, .png, .pdf or .svg.
      title: what stands above.
      window: episodes that the line is smoothed over, from 1; None takes a twentieth of them.

    Returns:
      The path written.

    Raises:
      OptionError: no finished episode, other columns, or an argument out of range.
      MissingDependencyError: Matplotlib is not installed.
    """
    step, regret = _episodes(episodes)
    if window is None:
        window = max(1, len(step) // 20)
    _within("window", window, 1, 10**9)
    with _drawing(path, (6.2, 3.6)) as figure:
        axes = figure.add_subplot()
        axes.scatter(
            step, regret, s=8, color=GREY, alpha=0.4, linewidths=0, rasterized=True,
            label="one episode",
        )  # fmt: skip
        drawn, smooth = _running_median(step, regret, int(window))
        label = f"median of {int(window)} episodes"
        axes.plot(drawn, smooth, color=COLOURS[0], linewidth=2.2, label=label)
        axes.axhline(0.0, color=GREY, linewidth=1.1)
        axes.annotate(
            "optimal", (1.0, 0.0), xycoords=("axes fraction", "data"), xytext=(0, 3),
            textcoords="offset points", ha="right", color="#555555", fontsize=8,
        )  # fmt: skip
        axes.set_ylim(-0.04, 1.04)
        axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        axes.set_xlabel("environment steps")
        axes.set_ylabel("mean regret per step  (1 − r)")
        axes.set_title(literal(title))
        axes.legend(loc="upper right")
    return Path(path)


def _episodes(episodes: str | os.PathLike[str] | Iterable[Any]) -> tuple[Array, Array]:
    """`[N]` environment steps at which episodes ended, and their mean regrets."""
    if isinstance(episodes, str | os.PathLike):
        source = os.fspath(episodes)
        try:
            text = Path(source).read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise OptionError(f"{source}: cannot be read: {error}. Give an episodes.csv.") from None
        rows: list[Any] = list(csv.DictReader(io.StringIO(text)))
    else:
        source, rows = "episodes", list(episodes)

    def field(row: Any, name: str) -> float:
        return float(row[name] if isinstance(row, dict) else getattr(row, name))

    try:
        if rows and isinstance(rows[-1], dict) and None in rows[-1].values():
            rows.pop()  # the row that a killed run was writing
        points = [(field(row, "step"), field(row, "regret")) for row in rows]
    except (KeyError, AttributeError, TypeError, ValueError):
        raise OptionError(
            f"{source}: every row must have numbers for step and regret. "
            "Give the episodes.csv of a training run."
        ) from None
    if not points:
        raise OptionError(f"{source}: holds no finished episode yet. Train for longer.")
    step, regret = np.array(points).T
    return step, regret


def _running_median(step: Array, values: Array, window: int) -> tuple[Array, Array]:
    """Medians over centred windows, which shrink at both ends, at points along the steps."""
    before, after = (window - 1) // 2, window // 2
    centres = np.unique(np.linspace(0, len(step) - 1, _DRAWN_POINTS).round().astype(int))
    medians = [np.median(values[max(0, i - before) : i + after + 1]) for i in centres]
    return step[centres], np.array(medians)


@contextlib.contextmanager
def _drawing(path: str | os.PathLike[str], size: tuple[float, float]) -> Iterator[Figure]:
    """A figure that is written when the block ends without an error: whole, or not at all."""
    path = Path(path)
    ending = path.suffix.removeprefix(".").lower()
    if ending not in FORMATS:
        raise OptionError(f"{path}: must end in {', '.join('.' + known for known in FORMATS)}.")
    with drawing(size, (ending,)) as (figure, drawn):
        yield figure
    write_atomically(path, drawn[ending])


@contextlib.contextmanager
def drawing(
    size: tuple[float, float], formats: Iterable[str]
) -> Iterator[tuple[Figure, dict[str, bytes]]]:
    """A figure in this package's style, and what it is as files once the block has ended.

    Args:
      size: width and height in inches.
      formats: of `FORMATS`.

    Yields:
      The figure to draw in, and a dict which holds each format's bytes after the block.

    Raises:
      MissingDependencyError: Matplotlib is not installed.
    """
    try:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingDependencyError(
            "Figures need Matplotlib, which is not installed. "
            "Run `pip install 'sme-registry[plot]'`."
        ) from None
    drawn: dict[str, bytes] = {}
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=size)
        FigureCanvasAgg(figure)
        yield figure, drawn
        for ending in formats:
            content = io.BytesIO()
            figure.savefig(content, format=ending, dpi=160, metadata=_UNDATED[ending])
            drawn[ending] = content.getvalue()


def shades(count: int) -> list[tuple[float, ...]]:
    """Colours for values in an order, dark to light, all of them legible on white."""
    from matplotlib import colormaps

    return [tuple(colour) for colour in colormaps["viridis"](np.linspace(0.0, 0.85, count))]


def literal(text: str) -> str:
    """Text of a user's that Matplotlib does not read as a formula."""
    return text.replace("$", r"\$")


def _within(name: str, value: float, low: float, high: float, *, open_below: bool = False) -> None:
    if not low <= value <= high or (open_below and value == low):
        bracket = "(" if open_below else "["
        raise OptionError(f"{name}={value!r:.40}: must be in {bracket}{low:g}, {high:g}].")
