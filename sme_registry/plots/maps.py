"""Maps: of similarity over the plane of a task, and of retention in a stream."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.evaluation import StreamReport
from sme_registry.evaluation.policies import as_policy
from sme_registry.evaluation.retention import Retention
from sme_registry.evaluation.streams import check_same_stream
from sme_registry.io import integer_in, number_in
from sme_registry.plots.style import canvas, figure_of, read_reports
from sme_registry.spec import SMESpec, catalogue
from sme_registry.spec.sme_spec import ActionRange, SpecLike
from sme_registry.statistics import iqm
from sme_registry.task import load, materialize
from sme_registry.task.draw import Array
from sme_registry.task.engine import engine

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_LifeReport = StreamReport | str | os.PathLike[str]
LifeReports = _LifeReport | Sequence[_LifeReport]

STREAM = "stream.json"  # of a report, in the folder of a run
MATRIX_SCALE = "normalised regret\n(0 = optimal, 1 = constant ½)"
_STEP = 0.05  # of the ends of a colour scale
_LUMINANCE = (0.299, 0.587, 0.114)  # of red, green and blue
_MOST_NUMBERS = 12  # of columns of a matrix whose cells show their values


def similarity_map(
    policy: Any,
    spec_or_id: SpecLike,
    path: str | os.PathLike[str] | None = None,
    *,
    epsilon: float = 1.0,
    resolution: int = 240,
    time: float = 0.5,
    action_range: ActionRange | None = None,
    name: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw r̃ of a policy over the plane of a task with two state channels, beyond its unit square.

    The map covers the cube X_ε in `resolution` points along each side; ε = 1 is [−½, 1½]². The
    policy sees `time` as t/T, and 0 as r_cum/k. The colours cover the similarities that occur, to
    the next 0.05; the scale says which.

    Examples:
      >>> from sme_registry.plots import similarity_map
      >>> figure = similarity_map("linear", "Plane10", "map.png", resolution=20)
    """
    spec = load(spec_or_id, SMESpec)
    if spec.state_dim != 2:
        raise OptionError(
            f"state_dim={spec.state_dim}: must be 2 for a map. Use a task such as SME/Plane1-v1."
        )
    if spec.observation is not None:
        raise OptionError(
            "observation: must be absent for a map, because the policy sees more than the two "
            "state channels. Use a task without it."
        )
    number_in("epsilon", epsilon, 1e-6, 100.0)
    number_in("time", time, 0.0, 1.0)
    resolution = integer_in("resolution", resolution, 2, 2000)
    loaded = as_policy(policy, spec, action_range=action_range, name=name)
    side, similarity = similarity_on_grid(loaded, spec, epsilon, resolution, time)
    scale = colour_scale(similarity)
    inside = (side >= 0.0) & (side <= 1.0)
    title = (
        f"{loaded.name} on {catalogue.title(spec)}, L = {spec.complexity}\n"
        f"mean r̃: {similarity[np.ix_(inside, inside)].mean():.3f} in the unit square, "
        f"{similarity.mean():.3f} in the whole map"
    )
    with canvas(ax, (5.0, 4.2), path, title=title) as (axes,):
        image = draw_similarity(axes, similarity, epsilon, scale)
        label = f"similarity r̃  (1 = optimal)\n{scale_text(scale)}"
        bar = figure_of(axes).colorbar(image, ax=axes, label=label, ticks=scale_ticks(scale))
        bar.outline.set_visible(False)
        axes.locator_params(nbins=5)
        axes.set_xlabel("state channel 1")
        axes.set_ylabel("state channel 2")
    return figure_of(axes)


def colour_scale(similarity: npt.ArrayLike) -> tuple[float, float]:
    """The ends of a scale that covers the similarities, NaN apart, to the next 0.05."""
    values = np.asarray(similarity, dtype=np.float64)
    low, high = np.nanmin(values), np.nanmax(values)
    first, last = math.floor(low / _STEP + 1e-9), math.ceil(high / _STEP - 1e-9)
    return min(first, last - 1) * _STEP, last * _STEP


def scale_ticks(scale: tuple[float, float]) -> Array:
    """The numbers at a scale: every 0.05, or every 0.1 of a long one."""
    steps = round((scale[1] - scale[0]) / _STEP)
    return np.arange(0, steps + 1, 1 if steps <= 8 else 2, dtype=np.float64) * _STEP + scale[0]


def scale_text(scale: tuple[float, float]) -> str:
    """What a figure says about its colours: they do not begin at 0."""
    return f"colours from {scale[0]:.2f} to {scale[1]:.2f}"


def draw_similarity(
    axes: Axes, similarity: Array, epsilon: float, scale: tuple[float, float]
) -> Any:
    """A map of similarities `[N, N]` over the cube X_ε, with the unit square; returns its image."""
    extent = (-epsilon / 2.0, 1.0 + epsilon / 2.0) * 2
    axes.grid(visible=False)
    image = axes.imshow(
        similarity, origin="lower", extent=extent, vmin=scale[0], vmax=scale[1], cmap="viridis",
        interpolation="nearest",
    )  # fmt: skip
    _outline(axes, 0.0, 0.0, 1.0, (3.0, 1.2))
    return image


def _outline(
    axes: Axes, left: float, bottom: float, side: float, widths: tuple[float, float]
) -> None:
    """A square of two strokes, visible on dark and on light colours."""
    x = left + side * np.array([0.0, 1.0, 1.0, 0.0, 0.0])
    y = bottom + side * np.array([0.0, 0.0, 1.0, 1.0, 0.0])
    for colour, width in zip(("white", "black"), widths, strict=True):
        axes.plot(x, y, color=colour, linewidth=width)


def similarity_on_grid(
    policy: Any, spec: SMESpec, epsilon: float, resolution: int, time: float
) -> tuple[Array, Array]:
    """`[N]` coordinates, and r̃ `[N, N]` over the plane, rows by the second state channel."""
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


def retention_map(
    runs: LifeReports,
    path: str | os.PathLike[str] | None = None,
    *,
    region: str = "WD",
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw a retention matrix: normalised regret after each visit (rows) on each phase (columns).

    Bright is good. The cell of the phase that was just visited is outlined. The first row is the
    initial policy, where the reports have one. `runs` are the report of an agent, its path, or the
    folder of its stream.json; or several, one for each seed, whose IQM the cells are. `region` is
    `WD`, `OOD 1`, …, or `OOD` for the mean over the shells.

    Examples:
      >>> from sme_registry.plots import retention_map
      >>> figure = retention_map("runs/life", "retention_map.png")
    """
    reports = read_lives(runs)
    agents = [report.region(region).agent for report in reports]
    M = iqm([agent.normalised_regret for agent in agents])
    labels = [f"visit {visit.visit}" for visit in reports[0].visits]
    visited: list[tuple[int, int]] = [(visit.visit, visit.phase) for visit in reports[0].visits]
    if initial := initial_regrets(agents):
        M = np.concatenate([iqm(initial)[None], M])
        labels = ["initial", *labels]
        visited = [(row + 1, column) for row, column in visited]
    V, P = M.shape
    size = (max(3.6, 1.9 + 0.52 * min(P, 20)), max(2.8, 1.5 + 0.32 * min(V, 30)))
    with canvas(ax, size, path, title=lives_title(reports, title, f", {region}")) as (axes,):
        scale = 0.0, max(1.0, float(M.max()))
        phases = [str(phase) for phase in range(P)]
        image = draw_matrix(axes, M, labels, phases, scale, visited, "viridis_r")
        axes.set_xlabel("evaluated on the task of phase")
        axes.set_ylabel("policy at the end of")
        bar = figure_of(axes).colorbar(image, ax=axes, label=MATRIX_SCALE)
        bar.outline.set_visible(False)
    return figure_of(axes)


def draw_matrix(
    axes: Axes,
    M: Array,
    rows: Sequence[str],
    columns: Sequence[str],
    scale: tuple[float, float],
    visited: Sequence[tuple[int, int]] = (),
    colours: str = "viridis",
) -> AxesImage:
    """A matrix as colours, with its values where they are legible; `visited` cells are outlined."""
    low, high = scale
    image = axes.imshow(
        M, vmin=low, vmax=high, cmap=colours, aspect="auto", interpolation="nearest"
    )
    axes.grid(visible=False)
    digits = 2 if high - low > 0.11 else 3
    if len(columns) <= _MOST_NUMBERS:
        for (row, column), value in np.ndenumerate(M):
            known = not math.isnan(value)
            dark = known and np.dot(image.to_rgba(np.asarray(value))[:3], _LUMINANCE) < 0.5
            axes.text(
                column, row, f"{value:.{digits}f}" if known else "–", ha="center", va="center",
                fontsize=7.5, color="white" if dark else "black",
            )  # fmt: skip
    for row, column in visited:
        _outline(axes, column - 0.47, row - 0.47, 0.94, (2.4, 1.0))
    _tick(axes.yaxis, rows)
    _tick(axes.xaxis, columns)
    return image


def _tick(axis: Any, labels: Sequence[str]) -> None:
    """As many of the labels as are legible."""
    every = -(-len(labels) // 20)
    axis.set_ticks(range(0, len(labels), every), labels[::every])
    axis.set_tick_params(length=0)


def read_lives(given: LifeReports) -> list[StreamReport]:
    """One report or several of one stream, those given by their paths read."""
    reports = read_reports(given, StreamReport, STREAM, "runs")
    check_same_stream(reports)
    return reports


def initial_regrets(agents: Sequence[Retention]) -> list[tuple[float, ...]]:
    """`[n][P]` regret of the initial policies; empty unless every agent has one."""
    known = [a.initial_normalised_regret for a in agents if a.initial_normalised_regret]
    return known if len(known) == len(agents) else []


def lives_title(
    reports: Sequence[StreamReport], title: str | None, end: str = "", *, named: bool = True
) -> str:
    if title is not None:
        return title
    who = f"{reports[0].policy} on " if named else ""
    seeds = f", {len(reports)} seeds" if named and len(reports) > 1 else ""
    return f"{who}{reports[0].title}{end}{seeds}"
