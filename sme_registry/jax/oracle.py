"""The optimal action, similarity, step reward and cost, as functions of a task's params.

    π*(s) = Φ(W_L Φ(… Φ(W_1 s + b_1) …) + b_L)
    r̃     = 1 − ‖a − π*(s)‖₁ / A
    r     = r̂ = max(0, 4 (r̃ − ¾)) if r̂ > r_min, else 0

and with `safety`, v another such network:

    ℓ(s)       = 1 − 2τ v(s)
    cost(s, a) = mean_i max(0, a_i − ℓ_i(s)) / (2τ)

Source: METHOD, sections 1 and 8. In the dtype of the params; within 1e-12 of `Task` in float64,
whose order of summation differs. `S` state_dim, `A` action_dim; any leading axes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from sme_registry.errors import SpecError
from sme_registry.jax.task import InnerLayers, Layer, TaskParams
from sme_registry.jax.transition import States, to_real


class Judgement(NamedTuple):
    """What actions are worth in their states, `[...]` each; the last two are None without `safety`.

    `safe_regret` is r of the best safe action, minus r.
    """

    similarity: jax.Array
    step_reward: jax.Array
    cost: jax.Array | None = None
    safe_regret: jax.Array | None = None


def judge(params: TaskParams, s: States, a: jax.Array) -> Judgement:
    """Judge actions `[..., A]`, clipped to [0, 1], in states `[..., S]`."""
    optimal = optimal_action(params, s)
    similarities = similarity(params, a, optimal)
    reward = step_reward(params, similarities)
    if params.limits is None:
        return Judgement(similarities, reward)
    limits = limit(params, s)
    safe = step_reward(params, similarity(params, jnp.minimum(optimal, limits), optimal))
    return Judgement(similarities, reward, cost(params, a, limits), safe - reward)


def optimal_action(params: TaskParams, s: States) -> jax.Array:
    """π*(s) of states `[..., S]`, any real numbers: `[..., A]` in [0, 1]; ½ where padded."""
    return _network(params.inner, params.output, s)


def limit(params: TaskParams, s: States) -> jax.Array:
    """ℓ, the limits of the action channels in states `[..., S]`: `[..., A]` in [1 − 2τ, 1]."""
    if params.limits is None:
        raise SpecError("limit: this task has no safety. Give its spec safety.")
    v = _network(params.limits.inner, params.limits.output, s)
    return 1.0 - 2.0 * params.limits.tightness * v


def cost(params: TaskParams, a: jax.Array, limits: jax.Array) -> jax.Array:
    """The cost of actions, clipped to [0, 1], under limits, `[..., A]` each: `[...]` in [0, 1]."""
    if params.limits is None:
        raise SpecError("cost: this task has no safety. Give its spec safety.")
    excess = jnp.maximum(0.0, jnp.clip(a, 0.0, 1.0).astype(limits.dtype) - limits)
    total = jnp.where(params.action_mask, excess, 0.0).sum(axis=-1)
    return total / (2.0 * params.limits.tightness * params.action_dim.astype(limits.dtype))


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


def _network(inner: InnerLayers | None, output: Layer, s: States) -> jax.Array:
    """The output `[..., A]` of uniform layers over states."""
    x = to_real(s, output.W.dtype)
    if inner is not None:
        x = uniform_layer(inner.first, x)
        x, _ = lax.scan(_inner_layer, x, (inner.stacked, inner.active))
    return uniform_layer(output, x)


def uniform_layer(layer: Layer, x: jax.Array) -> jax.Array:
    """Φ(W x + b) of inputs `[..., in]`."""
    return normal_cdf(x @ layer.W.T + layer.b)


def _inner_layer(x: jax.Array, layer: tuple[Layer, jax.Array]) -> tuple[jax.Array, None]:
    parameters, active = layer
    return jnp.where(active, uniform_layer(parameters, x), x), None
