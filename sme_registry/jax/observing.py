"""What the agent sees in place of the state: distractors, and a map over both.

    x   = M(s, d)                            seen; then t/T and r_cum/k
    d'  uniform                              noise
    d'  = ψ(d + u W + b),  u uniform         autonomous
    d'  = ψ(d + a W + b),  a the action      driven

Source: METHOD, section 9. Distractors and their transition are exact, as states are. M is computed
in the dtype of the params: within 1e-12 of `Task` in float64, and 1e-5 in float32. `S` state_dim,
`A` action_dim, `m` distractors; of one task and one state, or any leading axes in `seen`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sme_registry.jax import oracle
from sme_registry.jax.task import Layer, TaskParams
from sme_registry.jax.transition import States, from_words, moved, to_real

# Uses of a key, which also draws a start from the first places of its stream.
_OF_START, _OF_STEP = 2**32 - 1, 2**32 - 2


def first_distractors(key: jax.Array, params: TaskParams) -> States | None:
    """The distractors `[m]` with which an episode begins; None without distractors."""
    if not params.form.distractors:
        return None
    return _uniform(jax.random.fold_in(key, _OF_START), params)


def drawn(key: jax.Array, params: TaskParams) -> States | None:
    """The random numbers of a step: the next noise `[m]`, or u `[A]` float32; None if driven."""
    if params.form.dynamics not in ("noise", "autonomous"):
        return None
    key = jax.random.fold_in(key, _OF_STEP)
    if params.form.dynamics == "noise":
        return _uniform(key, params)
    return jax.random.uniform(key, params.W.shape[-2:-1], jnp.float32)


def next_distractors(
    params: TaskParams, d: States | None, a: jax.Array, numbers: States | None
) -> States | None:
    """The distractors `[m]` of the next state, from d, the action and the numbers of `drawn`."""
    if params.form.dynamics in (None, "noise"):
        return numbers
    driving = numbers if params.form.dynamics == "autonomous" else a
    assert params.observing is not None
    W, b = params.observing.W, params.observing.b
    assert W is not None
    assert b is not None
    assert d is not None
    assert isinstance(driving, jax.Array)
    return moved(W, b, d, driving)


def seen(params: TaskParams, s: States, d: States | None) -> jax.Array:
    """M(s, d) `[..., S + m]` float32, 0 where padded; s itself in a task without `observation`."""
    if params.observing is None:
        return to_real(s, jnp.float32)
    layers = params.observing.mixing
    dtype = jnp.float32 if layers is None else layers.W.dtype
    x = jnp.concatenate([to_real(each, dtype) for each in (s, d) if each is not None], axis=-1)
    if layers is None:
        return x
    if params.form.mixing == "orthogonal":
        return (x @ layers.W[0].T + layers.b[0]).astype(jnp.float32)
    for i in range(len(layers.W)):
        x = oracle.uniform_layer(Layer(layers.W[i], layers.b[i]), x)
    exist = jnp.concatenate([params.state_mask, jnp.ones(params.form.distractors, bool)])
    return jnp.where(exist, x, 0.0).astype(jnp.float32)


def _uniform(key: jax.Array, params: TaskParams) -> States:
    return from_words(jax.random.bits(key, (params.form.distractors,), jnp.uint32), params)
