"""Next states, ψ(s + a W + b) with ψ(x) = 2 |x − rint x|, with the bits of `Task.transition`.

Source: METHOD, section 1. In float64, or, where the task's states are pairs, in uint32 alone.
`S` state_dim, `A` action_dim; any leading axes.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from sme_registry.jax import pairs
from sme_registry.jax.pairs import Pair
from sme_registry.jax.task import TaskParams

States = jax.Array | Pair

_UNROLLED = 16  # channels; above it the program would grow with A


def next_state(params: TaskParams, s: States, a: jax.Array) -> States:
    """The next states of states `[..., S]` and actions `[..., A]`, exact to the bit.

    Actions are clipped to [0, 1] and rounded to float32. The sum runs in the order of the
    definition, s + b and then W_i a_i for i = 1…A; each product is exact, so that it does not
    matter whether a compiler fuses it with its sum.
    """
    return moved(params.W, params.b, s, a)


def moved(W: jax.Array, b: jax.Array | Pair, s: States, a: jax.Array) -> States:
    """The same for any transition, such as that of distractors `[..., m]`."""
    a = jnp.clip(a, 0.0, 1.0).astype(jnp.float32)
    y: Any
    if isinstance(b, Pair):
        assert isinstance(s, Pair)
        y = pairs.add(s, b)
        y = _sum_over_channels(lambda y, W, a: pairs.add(y, pairs.product(W, a)), y, W, a)
        return pairs.fold(y)
    a = a.astype(jnp.float64)
    y = _sum_over_channels(lambda y, W, a: y + W * a, jnp.asarray(s) + b, W, a)
    return 2.0 * jnp.abs(y - jnp.rint(y))


def from_words(words: jax.Array, params: TaskParams) -> States:
    """Random uint32 as uniform states on the grid 2⁻³², in [0, 1), as the task has states."""
    if isinstance(params.b, Pair):
        return pairs.from_fraction(words)
    return words.astype(jnp.float64) * 2.0**-32


def to_real(s: States, dtype: Any) -> jax.Array:
    """States as real numbers of a dtype; pairs through float32."""
    return (pairs.to_float32(s) if isinstance(s, Pair) else s).astype(dtype)


def _sum_over_channels(add: Any, y: Any, W: jax.Array, a: jax.Array) -> Any:
    channels = W.shape[0]
    if channels <= _UNROLLED:
        for i in range(channels):
            y = add(y, W[i], a[..., i, None])
        return y

    def body(i: jax.Array, y: Any) -> Any:
        return add(y, W[i], lax.dynamic_slice_in_dim(a, i, 1, axis=-1))

    return lax.fori_loop(0, channels, body, y)
