"""Figures: decay outside the training cube, similarity over the plane, regret during training.

Each figure is one file, PNG, PDF or SVG by its suffix, drawn without a display (`drawing`). The
colours are those of Okabe and Ito, which colour-blind readers can distinguish. Lines also differ in
dash and marker, and maps in lightness, so that they remain legible in grey.
"""

from __future__ import annotations

import contextlib
import csv
import io
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sme_registry.compiled import engine
from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, as_policy
from sme_registry.evaluation.report import LABELS
from sme_registry.io import integer_in, require_packages, write_atomically
from sme_registry.spec import ActionRange, SMESpec, SpecLike, catalogue
from sme_registry.task import load_spec, materialize
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["decay_curve", "similarity_map", "training_curve"]

Measure = Literal["similarity", "normalised_regret"]

# Metadata without a date, by format, so that equal figures are equal files.
_UNDATED: dict[str, Any] = {"png": {}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
FORMATS = tuple(_UNDATED)
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = "osD^vPX<>*"  # ten, with seven colours: the first 70 pairs all differ
GREY = "#707070"
_DRAWN_POINTS = 400  # of a smoothed line; more would not be visible at this size
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
    """Draw reports over the expansion level ε: one panel per measure, one line per report.

    A single report of a team also has a thinner line for each agent.

    Args:
      reports: one or more reports; the legend names their policies.
      path: the file to write, .png, .pdf or .svg.
      measures: "similarity", "normalised_regret", or both.
      references: whether to draw the reference policies as thin lines, once per task: in grey, or
        with several tasks in the colour of the first report on each task.

    Returns:
      The path written.

    Raises:
      OptionError: no report, an unknown measure or suffix, or the file cannot be written.
      MissingDependencyError: Matplotlib is not installed.
    """
    reports = [reports] if isinstance(reports, EvaluationReport) else list(reports)
    if not reports:
        raise OptionError("reports: must be one or more evaluation reports. Give one.")
    if not measures or any(measure not in _MEASURES for measure in measures):
        raise OptionError(f"measures={measures!r:.70}: must be among {', '.join(_MEASURES)}.")
    with _figure_file(path, (4.6 * len(measures) + 1.6, 3.7)) as figure:
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
    def draw(regions: Any, **style: Any) -> None:
        x, y = [r.epsilon_high for r in regions], [getattr(r, measure) for r in regions]
        axes.plot(x, y, **style)

    for index, report in enumerate(reports):
        colour, marker = COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)]
        draw(
            report.regions, color=colour, marker=marker, markersize=4.5, linewidth=2,
            label=literal(report.policy),
        )  # fmt: skip
    agents = reports[0].agents if len(reports) == 1 else {}
    several = len(agents) >= len(COLOURS)  # too many to distinguish
    for index, (name, agent) in enumerate(agents.items()):
        style = {"markersize": 3.5, "linewidth": 1.2, "alpha": 0.8, "zorder": 1.8}
        if several:
            label = "" if index else f"each of {len(agents)} agents"
            draw(agent.regions, color=COLOURS[5], label=label, **style)
        else:
            colour, marker = COLOURS[index + 1], MARKERS[index + 1]
            draw(agent.regions, color=colour, marker=marker, label=name, **style)
    if references:
        _decay_references(axes, reports, draw)
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


def _decay_references(
    axes: Axes, reports: Sequence[EvaluationReport], draw: Callable[..., None]
) -> None:
    """The references of each task, and one grey entry for each in the legend."""
    tasks: dict[str, int] = {}
    for index, report in enumerate(reports):
        tasks.setdefault(report.spec_digest, index)
    for index in tasks.values():
        colour = GREY if len(tasks) == 1 else COLOURS[index % len(COLOURS)]
        for name, regions in reports[index].references.items():
            dash = REFERENCE_DASHES.get(name, "-")
            draw(regions, color=colour, linewidth=1.1, linestyle=dash, zorder=1.5)
    for name in reports[0].references:
        dash = REFERENCE_DASHES.get(name, "-")
        axes.plot([], [], color=GREY, linewidth=1.1, linestyle=dash, label=LABELS.get(name, name))


def similarity_map(
    policy: Any,
    spec_or_id: SpecLike,
    path: str | os.PathLike[str],
    *,
    epsilon: float = 1.0,
    resolution: int = 240,
    time: float = 0.5,
    action_range: ActionRange | None = None,
    name: str | None = None,
) -> Path:
    """Draw r̃ of a policy over the plane of a task with two state channels, beyond its unit square.

    Args:
      policy: any policy that `evaluate` accepts.
      spec_or_id: a task with state_dim=2.
      path: the file to write, .png, .pdf or .svg.
      epsilon: expansion level of the plane, in (0, 100]: the map covers the cube X_ε; 1 is
        [−½, 1½]².
      resolution: points along each side, in [2, 2000].
      time: the time input t/T of the policy, in [0, 1]; its r_cum/k is 0.
      action_range: "unit" or "symmetric"; None as in `evaluate`.
      name: the policy's name in the title.

    Returns:
      The path written.

    Raises:
      OptionError: the task has no two state channels, or an argument is out of range.
      PolicyError: the policy cannot be loaded, or its actions are invalid.
      UnknownNameError, SpecError: the task does not exist, or a field is out of range.
      MissingDependencyError: Matplotlib is not installed.
    """
    spec = load_spec(spec_or_id)
    if spec.state_dim != 2:
        raise OptionError(
            f"state_dim={spec.state_dim}: must be 2 for a map. Use a task such as SME/Plane1-v1."
        )
    if not 0.0 < epsilon <= 100.0:
        raise OptionError(f"epsilon={epsilon!r:.40}: must be in (0, 100].")
    resolution = integer_in("resolution", resolution, 2, 2000)
    if not 0.0 <= time <= 1.0:
        raise OptionError(f"time={time!r:.40}: must be in [0, 1].")
    loaded = as_policy(policy, spec, action_range=action_range, name=name)
    with _figure_file(path, (5.0, 4.2)) as figure:
        side, similarity = similarity_on_grid(loaded, spec, epsilon, resolution, time)
        axes = figure.add_subplot()
        image = draw_similarity(axes, similarity, epsilon)
        bar = figure.colorbar(image, ax=axes, label="similarity r̃  (1 = optimal)")
        bar.outline.set_visible(False)
        inside = (side >= 0.0) & (side <= 1.0)
        means = [similarity[np.ix_(inside, inside)].mean(), similarity.mean()]
        axes.set_title(
            f"{literal(loaded.name)} on {catalogue.title(spec)}, L = {spec.complexity}\n"
            f"mean r̃ {means[0]:.3f} in the unit square, {means[1]:.3f} in the whole map"
        )
        axes.locator_params(nbins=5)
        axes.set_xlabel("state channel 1")
        axes.set_ylabel("state channel 2")
    return Path(path)


def draw_similarity(axes: Axes, similarity: Array, epsilon: float) -> Any:
    """A map of similarities `[N, N]` over the cube X_ε, with the unit square; returns its image."""
    extent = (-epsilon / 2.0, 1.0 + epsilon / 2.0) * 2
    axes.grid(visible=False)
    image = axes.imshow(
        similarity, origin="lower", extent=extent, vmin=0.0, vmax=1.0, cmap="viridis",
        interpolation="nearest",
    )  # fmt: skip
    # Two strokes, so that the outline is visible on dark and on light colours.
    for colour, width in (("white", 3.0), ("black", 1.2)):
        axes.plot([0, 1, 1, 0, 0], [0, 0, 1, 1, 0], color=colour, linewidth=width)
    return image


def similarity_on_grid(
    policy: Any, spec: SMESpec, epsilon: float, resolution: int, time: float
) -> tuple[Array, Array]:
    """r̃ of a policy of `as_policy` over the plane of a task with two state channels.

    Returns:
      `[N]` evenly spaced coordinates along a side of the cube X_ε, and `[N, N]` similarities in
      [0, 1] at time t/T, rows by the second state channel.
    """
    task = materialize(spec)
    oracle = engine(task).optimal_action
    low, high = -epsilon / 2.0, 1.0 + epsilon / 2.0
    side = low + (np.arange(resolution) + 0.5) * (high - low) / resolution
    rows = []
    for second in side:
        observations = np.zeros((resolution, 4), dtype=np.float32)
        observations[:, 0], observations[:, 1], observations[:, 2] = side, second, time
        s = observations[:, :2].astype(np.float64)
        a = np.clip(policy(observations), 0.0, 1.0)
        rows.append(task.similarity_of(a, oracle(s)))
    return side, np.array(rows)


def training_curve(
    episodes: str | os.PathLike[str] | Iterable[Any],
    path: str | os.PathLike[str],
    *,
    title: str = "",
    window: int | None = None,
) -> Path:
    """Draw the exact regret of each training episode over environment steps.

    Each dot is an episode; the line is their running median over a centred window.

    Args:
      episodes: the path of a run's episodes.csv, or rows with `step` and `regret`, as
        attributes or as keys.
      path: the file to write, .png, .pdf or .svg.
      title: above the figure.
      window: number of episodes in the median, at least 1; None for a twentieth of them.

    Returns:
      The path written.

    Raises:
      OptionError: no finished episode, missing columns, or an argument is out of range.
      MissingDependencyError: Matplotlib is not installed.
    """
    step, regret = _episodes(episodes)
    if window is None:
        window = max(1, len(step) // 20)
    window = integer_in("window", window, 1)
    with _figure_file(path, (6.2, 3.6)) as figure:
        axes = draw_training(figure, step, regret, "one episode")
        drawn, smooth = _running_median(step, regret, window)
        label = f"median of {window} episodes"
        axes.plot(drawn, smooth, color=COLOURS[0], linewidth=2.2, label=label)
        axes.axhline(0.0, color=GREY, linewidth=1.1)
        axes.annotate(
            "optimal", (1.0, 0.0), xycoords=("axes fraction", "data"), xytext=(0, 3),
            textcoords="offset points", ha="right", color="#555555", fontsize=8,
        )  # fmt: skip
        axes.set_title(literal(title))
        axes.legend(loc="upper right")
    return Path(path)


def draw_training(figure: Figure, step: Array, regret: Array, label: str) -> Axes:
    """The axes of a figure, with a dot for each of `[N]` episodes or evaluations of a training."""
    axes = figure.add_subplot()
    axes.scatter(
        step, regret, s=8, color=GREY, alpha=0.4, linewidths=0, rasterized=True, label=label
    )
    axes.set_ylim(-0.04, 1.04)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("mean regret per step  (1 − r)")
    return axes


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
            rows.pop()  # cut short when the run was killed
        points = [(field(row, "step"), field(row, "regret")) for row in rows]
    except (KeyError, AttributeError, TypeError, ValueError):
        raise OptionError(
            f"{source}: every row must have numbers for step and regret. "
            "Give the episodes.csv of a training run."
        ) from None
    if not points:
        raise OptionError(f"{source}: contains no finished episode. Train for longer.")
    step, regret = np.array(points).T
    return step, regret


def _running_median(step: Array, values: Array, window: int) -> tuple[Array, Array]:
    """Medians over centred windows, shorter at both ends, at some of the steps."""
    before, after = (window - 1) // 2, window // 2
    centres = np.unique(np.linspace(0, len(step) - 1, _DRAWN_POINTS).round().astype(int))
    medians = [np.median(values[max(0, i - before) : i + after + 1]) for i in centres]
    return step[centres], np.array(medians)


@contextlib.contextmanager
def _figure_file(path: str | os.PathLike[str], size: tuple[float, float]) -> Iterator[Figure]:
    """A figure that is written when the block ends without an error: completely or not at all."""
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
    """A figure in the style of this package, and its files.

    Args:
      size: width and height in inches.
      formats: of `FORMATS`.

    Yields:
      The figure to draw in, and a dict that holds the bytes of each format after the block.

    Raises:
      MissingDependencyError: Matplotlib is not installed.
    """
    require_packages("figures", {"matplotlib": "Matplotlib"}, "plot")
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

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
    """Colours for ordered values, from dark to light, all legible on white."""
    from matplotlib import colormaps

    return [tuple(colour) for colour in colormaps["viridis"](np.linspace(0.0, 0.85, count))]


def literal(text: str) -> str:
    """Text that Matplotlib prints as it is, not as a formula."""
    return text.replace("$", r"\$")
