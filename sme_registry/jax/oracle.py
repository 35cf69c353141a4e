"""The optimal action, similarity and step reward, as functions of a task's params.

    π*(s) = Φ(W_L Φ(… Φ(W_1 s + b_1) …) + b_L)
    r̃     = 1 − ‖a − π*(s)‖₁ / A
    r     = r̂ = max(0, 4 (r̃ − ¾)) if r̂ > r_min, else 0

Source: METHOD, section 1. In the dtype of the params; within 1e-12 of `Task` in float64, whose
order of summation differs. `S` state_dim, `A` action_dim; any leading axes.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import lax

from sme_registry.jax import pairs
from sme_registry.jax.pairs import Pair
from sme_registry.jax.task import Layer, TaskParams
from sme_registry.jax.transition import States


def judge(params: TaskParams, s: States, a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """r̃ and r `[...]` of states `[..., S]` and actions `[..., A]`, clipped to [0, 1]."""
    similarities = similarity(params, a, optimal_action(params, s))
    return similarities, step_reward(params, similarities)


def optimal_action(params: TaskParams, s: States) -> jax.Array:
    """π*(s) of states `[..., S]`, any real numbers: `[..., A]` in [0, 1]; ½ where padded."""
    x = pairs.to_float32(s) if isinstance(s, Pair) else s
    x = x.astype(params.output.W.dtype)
    if params.inner is not None:
        x = _uniform_layer(params.inner.first, x)
        x, _ = lax.scan(_inner_layer, x, (params.inner.stacked, params.inner.active))
    return _uniform_layer(params.output, x)


def similarity(params: TaskParams, a: jax.Array, optimal: jax.Array) -> jax.Array:
    """r̃ of actions, clipped to [0, 1], and the optimal ones, `[..., A]` each: `[...]`."""
    distance = jnp.abs(jnp.clip(a, 0.0, 1.0).astype(optimal.dtype) - optimal)
    total = jnp.where(params.action_mask, distance, 0.0).sum(axis=-1)
    return 1.0 - total / params.action_dim.astype(optimal.dtype)


def step_reward(params: TaskParams, similarity: jax.Array) -> jax.Array:
    """The step reward r of similarities r̃, of any shape; regret is 1 − r."""
    graded = jnp.maximum(0.0, 4.0 * (similarity - 0.75))
    return jnp.where(graded > params.r_min, graded, 0.0)


def normal_cdf(x: jax.Array) -> jax.Array:
    """Φ, within 1e-15 in float64; twice the speed of `jax.scipy.special.ndtr`."""
    return 0.5 + 0.5 * lax.erf(x * math.sqrt(0.5))


def _uniform_layer(layer: Layer, x: jax.Array) -> jax.Array:
    return normal_cdf(x @ layer.W.T + layer.b)


def _inner_layer(x: jax.Array, layer: tuple[Layer, jax.Array]) -> tuple[jax.Array, None]:
    parameters, active = layer
    return jnp.where(active, _uniform_layer(parameters, x), x), None
