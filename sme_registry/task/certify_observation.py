"""Checks of what the agent sees: distractors stay uniform, and the mixing can be undone.

Source: METHOD, section 9. A mixing is undone from float32 observations, whose rounding its inverse
multiplies: so its Jacobian must be well conditioned, and a linear map must recover most of it. Of
20 draws for each entry (3 with 128 channels): the median condition number, largest draw; R² of the
worst recovered channel, smallest draw.

    channels   depth 1         depth 2         depth 3
        2         2.4  .97        4.3  .93        9.5  .90
        8         5.7  .96         21  .91         68  .88
       16         9.7  .95         40  .91        161  .86
       40          21  .95        116  .90        661  .85
      128          52  .94        396  .89      2,840  .83

Noise is drawn by the environment at each step, and has no numbers of the task's to check.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from sme_registry.task.certificate import INF, Check, judged, numbers, reported
from sme_registry.task.draw import Array, Layer
from sme_registry.task.linear_map import held_out_r2
from sme_registry.task.task import Task
from sme_registry.task.uniformity import (
    CONSTANT_STEPS,
    distance_from_uniform,
    distinct_share,
    lanes_followed,
    uniform_bound,
)

LANES = 4_096
STEPS = 1_000
_ROUNDING = 1e-9
_MEASURED_CHANNELS = 512  # above it the fit and the Jacobians take longer than everything else
_LARGEST_CONDITION = 5_000.0
_SINGULAR = 1.0 / float(np.finfo(np.float64).eps)  # of a matrix that float64 cannot invert


def observation_checks(task: Task, seed: int, states: int) -> tuple[Check, ...]:
    """The checks of a task with `observation`; none without."""
    moving = () if task.distractor_transition is None else _distractors(task, seed)
    return (*moving, *(_mixing(task, seed, states) if task.mixing else ()))


def _distractors(task: Task, seed: int) -> tuple[Check, ...]:
    """Autonomous distractors always move under random actions; driven ones under any agent's."""
    assert task.distractor_transition is not None
    m, A = task.spec.distractors, task.spec.action_dim
    lanes = max(256, min(LANES, 2**20 // (m * A)))
    d = numbers(task, seed, "distractors", lanes, m)
    for t in range(STEPS):
        d = task.distractor_step(d, numbers(task, seed, f"distractors/actions/{t}", lanes, A))
    followed = lanes_followed(m, A)
    starts = numbers(task, seed, "distractors/constant_starts", followed, m)
    action = numbers(task, seed, "distractors/constants", 1, A)
    return (
        judged(
            "distractor_row_sums",
            float(np.abs(task.distractor_transition[0].sum(axis=1) - 1.0).max()),
            "How far a row of the distractors' W is from the sum 1, as for the state.",
            passes=(-INF, 0.0),
        ),
        judged(
            "uniform_distractors",
            distance_from_uniform(d),
            f"Largest √N·KS distance of a distractor from uniform, {STEPS:,} random actions after "
            "uniform starts.",
            passes=(-INF, uniform_bound(m)),
        ),
        judged(
            "distinct_distractors",
            distinct_share(task.distractor_step, starts, action),
            f"Smallest share of distinct values of a distractor, over {CONSTANT_STEPS:,} steps of "
            f"one constant action and over {followed} lanes after them: floating point must not "
            "collapse.",
            passes=(0.99, INF),
        ),
    )


def _mixing(task: Task, seed: int, states: int) -> tuple[Check, ...]:
    assert task.spec.observation is not None
    linear = task.spec.observation.mixing == "orthogonal"
    S, n = task.spec.state_dim, task.spec.state_dim + task.spec.distractors
    return (
        judged(
            "mixing_orthogonal",
            max(_orthogonality_error(layer, None if linear else 12.0) for layer in task.mixing),
            "How far a layer's W is from a multiple of an orthogonal matrix (of √12 where it is "
            "nonlinear), which can be inverted without loss.",
            passes=(-INF, _ROUNDING),
        ),
        judged(
            "mixing_centred",
            max(_centre_error(layer, 0.5 if linear else 0.0) for layer in task.mixing),
            "How far a layer is from mapping the centre of the cube to the centre.",
            passes=(-INF, _ROUNDING),
        ),
        *_invertibility(task, numbers(task, seed, "mixing", states, n), S),
        *((_extent(task.mixing[0]),) if linear else ()),
    )


def _orthogonality_error(layer: Layer, scale: float | None) -> float:
    """How far W Wᵀ is from `scale` times the identity, relative to it; None: from any multiple."""
    gram = layer.W @ layer.W.T
    scale = scale or float(np.trace(gram)) / len(gram)
    return float(np.abs(gram / scale - np.eye(len(gram))).max())


def _centre_error(layer: Layer, centre: float) -> float:
    return float(np.abs(layer.b - (centre - 0.5 * layer.W.sum(axis=1))).max())


def _extent(layer: Layer) -> Check:
    return judged(
        "mixing_extent",
        float(np.abs(layer.W).sum(axis=1).max()),
        "Width of the image of the cube in its widest channel: 1, since an observation must fill "
        "[0, 1] and stay inside.",
        passes=(1.0 - _ROUNDING, 1.0 + _ROUNDING),
    )


def _invertibility(task: Task, x: Array, S: int) -> tuple[Check, Check]:
    """How well x is recovered from M(x): locally, and by one linear map."""
    N, n = x.shape
    names = "mixing_condition", "mixing_linear_r2"
    if n > _MEASURED_CHANNELS or 4 * (n + 1) > N // 2:
        why = f"Not measured: it takes too long for {n:,} channels."
        return reported(names[0], None, why), reported(names[1], None, why)
    points = x[: max(8, min(100, 2**22 // n**2))]
    condition = float(np.median(np.linalg.cond(_jacobians(task, points))))
    return (
        judged(
            names[0],
            min(condition, _SINGULAR),
            f"Median condition number of the mixing's Jacobian at {len(points)} uniform points: "
            "by how much inverting it can multiply an error of the float32 observation.",
            passes=(-INF, _LARGEST_CONDITION),
        ),
        judged(
            names[1],
            float(held_out_r2(task.seen(x[:, :S], x[:, S:]), x).min()),
            "R² of the worst channel of state and distractors that a linear map recovers from the "
            "observation, on the other half of the states; 1 where the mixing is linear.",
            passes=(0.75, INF),
        ),
    )


def _jacobians(task: Task, x: Array) -> Array:
    """The Jacobian of the mixing `[P, n, n]` at points `[P, n]`."""
    J = np.broadcast_to(np.eye(x.shape[1]), (*x.shape, x.shape[1]))
    assert task.spec.observation is not None
    for W, b in task.mixing:
        J = W @ J
        if task.spec.observation.mixing == "nonlinear":
            z = x @ W.T + b
            J = (np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi))[:, :, None] * J
            x = ndtr(z)
    return J
