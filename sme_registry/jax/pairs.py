"""float64 numbers as pairs of uint32, and the transition in them: for devices without float64.

A pair is the number itself, the two halves of its IEEE 754 bits; so a state has the bits that NumPy
gives it, whatever grid it lies on. All numbers are at least 0, where the order of the bits is the
order of the numbers. With m the 53-bit significand and E the biased exponent, a number is
m 2^(E − 1075), and

    x + y    the smaller significand is shifted right by the difference of the exponents, with two
             extra bits, the last of which is 1 if any bit was lost; the sum is rounded to the
             nearest, ties to even. (There is no subtraction, so two extra bits are enough.)
    W a      an integer: 30 bits of W in units of 2⁻²⁹, times the 24 of a float32; never rounded.
    2|x − rint x|   of the k = 1075 − E bits F below the point, 2 min(F, 2ᵏ − F); never rounded.

A significand is written as the two words (high, low). Words are only shifted by 0 to 31 places;
`_left` and `_right` compose larger shifts.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import lax

Words = tuple[jax.Array, jax.Array]


class Pair(NamedTuple):
    """The halves of float64 numbers of at least 0, uint32 of any shape."""

    high: jax.Array
    low: jax.Array


def from_float64(x: npt.NDArray[np.float64]) -> Pair:
    """NumPy's numbers as pairs of NumPy's arrays."""
    bits = np.asarray(x, np.float64).view(np.uint64)
    halves: Any = (bits >> np.uint64(32)).astype(np.uint32), bits.astype(np.uint32)
    return Pair(*halves)


def to_float64(pair: Pair) -> npt.NDArray[np.float64]:
    """Pairs as NumPy's numbers."""
    high, low = (np.asarray(half).astype(np.uint64) for half in pair)
    return (high << np.uint64(32) | low).view(np.float64)


def from_fraction(bits: jax.Array) -> Pair:
    """The numbers bits · 2⁻³², from uint32."""
    return _normalised((jnp.zeros_like(bits), bits), jnp.uint32(1043))


def to_float32(x: Pair) -> jax.Array:
    """The nearest float32, ties to even; 0 below 2⁻¹²⁶."""
    kept, lost = x.high << 3 | x.low >> 29, x.low & 0x1FFFFFFF
    up = (lost > 0x10000000) | ((lost == 0x10000000) & (kept & 1 == 1))
    bits = kept - jnp.uint32((896 << 23) % 2**32) + up.astype(jnp.uint32)
    return lax.bitcast_convert_type(
        jnp.where(x.high >= 897 << 20, bits, jnp.uint32(0)), jnp.float32
    )


def product(W: jax.Array, a: jax.Array) -> Pair:
    """W a, exact: W uint32 in units of 2⁻²⁹, at most 2²⁹, and a float32 in [0, 1]."""
    bits = lax.bitcast_convert_type(a, jnp.uint32)
    exponent = bits >> 23
    # Zero for a below 2⁻¹²⁶: such a number changes no sum with an offset b of at least 2⁻⁵³.
    m = jnp.where(exponent > 0, bits & 0x7FFFFF | 0x800000, jnp.uint32(0))
    W, m = jnp.broadcast_arrays(W, m)
    w1, w0, m1, m0 = W >> 16, W & 0xFFFF, m >> 16, m & 0xFFFF
    cross, other = w0 * m1, w1 * m0
    middle = (w0 * m0 >> 16) + (cross & 0xFFFF) + (other & 0xFFFF)
    high = w1 * m1 + (cross >> 16) + (other >> 16) + (middle >> 16)
    return _normalised((high, W * m), exponent + 896)


def add(x: Pair, y: Pair) -> Pair:
    """x + y as float64 rounds it; both 0, or one of them at least 2⁻¹⁰²²."""
    swap = (y.high > x.high) | ((y.high == x.high) & (y.low > x.low))
    large = Pair(jnp.where(swap, y.high, x.high), jnp.where(swap, y.low, x.low))
    small = Pair(jnp.where(swap, x.high, y.high), jnp.where(swap, x.low, y.low))
    exponent, leading, (high, low) = _unpacked(large)
    other_exponent, _, (other_high, other_low) = _unpacked(small)
    other = other_high << 2 | other_low >> 30, other_low << 2
    other = _right_sticky(other, exponent - other_exponent)
    high, low = _sum((high << 2 | low >> 30, low << 2), other)

    carry = high >> 23  # 1 if the sum has 56 bits, of which 53 are kept
    extra, half = 2 + carry, jnp.uint32(2) << carry
    lost = low & (2 * half - 1)
    high, low = high >> extra, low >> extra | high << (32 - extra)
    up = (lost > half) | ((lost == half) & (low & 1 == 1))
    high, low = _sum((high, low), (jnp.uint32(0), up.astype(jnp.uint32)))
    # Added, not joined: the leading bit, or a carry out of rounding, adds 1 to the exponent.
    return Pair((exponent + carry - leading << 20) + high, low)


def fold(x: Pair) -> Pair:
    """2 |x − rint x| of x below 2²¹."""
    exponent, leading, (high, low) = _unpacked(x)
    below_half = exponent < 1022
    # The bits below the point: all of `low`, and `places` bits of `high`.
    places = jnp.where(below_half, jnp.uint32(0), 1043 - exponent)
    one = jnp.uint32(1) << places
    high = high & (one - 1)
    other_high, other_low = one - high - (low != 0), jnp.uint32(0) - low
    nearer = (other_high < high) | ((other_high == high) & (other_low < low))
    distance = jnp.where(nearer, other_high, high), jnp.where(nearer, other_low, low)
    folded = _normalised(distance, exponent + 1)
    doubled = x.high + (leading << 20)
    return Pair(
        jnp.where(below_half, doubled, folded.high), jnp.where(below_half, x.low, folded.low)
    )


def _unpacked(x: Pair) -> tuple[jax.Array, jax.Array, Words]:
    """The exponent, the leading bit, which only 0 does not have, and the 53-bit significand."""
    exponent = x.high >> 20
    leading = jnp.minimum(exponent, 1)
    return exponent, leading, (x.high & 0xFFFFF | leading << 20, x.low)


def _normalised(words: Words, exponent: jax.Array) -> Pair:
    """The number words · 2^(exponent − 1075), words below 2⁵³, as a pair."""
    high, low = words
    shift = jnp.where(high > 0, lax.clz(high), 32 + lax.clz(low)) - 11
    zero = (high | low) == 0
    high, low = _left(words, shift)
    return Pair(jnp.where(zero, jnp.uint32(0), (exponent - shift - 1 << 20) + high), low)


def _sum(x: Words, y: Words) -> Words:
    low = x[1] + y[1]
    return x[0] + y[0] + (low < x[1]), low


def _left(words: Words, places: jax.Array) -> Words:
    """Shifted left by 0 to 63 places."""
    high, low = words
    whole, part = places >= 32, places & 31
    high, low = jnp.where(whole, low, high), jnp.where(whole, 0, low)
    return high << part | low >> 1 >> (31 - part), low << part


def _right(words: Words, places: jax.Array) -> Words:
    """Shifted right by 0 to 63 places."""
    high, low = words
    whole, part = places >= 32, places & 31
    high, low = jnp.where(whole, 0, high), jnp.where(whole, high, low)
    return high >> part, low >> part | high << 1 << (31 - part)


def _right_sticky(words: Words, places: jax.Array) -> Words:
    """Shifted right by any number of places; the last bit is 1 if any lost bit was."""
    places = jnp.minimum(places, 63)
    shifted = _right(words, places)
    back = _left(shifted, places)
    lost = (back[0] != words[0]) | (back[1] != words[1])
    return shifted[0], shifted[1] | lost
