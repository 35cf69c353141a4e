"""Maps of similarity: over the plane of a task, and the colours of every map."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sme_registry.compiled import engine
from sme_registry.errors import OptionError
from sme_registry.evaluation import as_policy
from sme_registry.io import integer_in
from sme_registry.plots.style import canvas, figure_of
from sme_registry.spec import ActionRange, SMESpec, SpecLike, catalogue
from sme_registry.task import load, materialize
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STEP = 0.05  # of the ends of a colour scale


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
    if not 0.0 < epsilon <= 100.0:
        raise OptionError(f"epsilon={epsilon!r:.40}: must be in (0, 100].")
    resolution = integer_in("resolution", resolution, 2, 2000)
    if not 0.0 <= time <= 1.0:
        raise OptionError(f"time={time!r:.40}: must be in [0, 1].")
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
    # Two strokes, so that the outline is visible on dark and on light colours.
    for colour, width in (("white", 3.0), ("black", 1.2)):
        axes.plot([0, 1, 1, 0, 0], [0, 0, 1, 1, 0], color=colour, linewidth=width)
    return image


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
