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
    return _normalised((jnp.zeros_like(bits), bits), jnp.int32(1043))


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
    exponent = (bits >> 23).astype(jnp.int32)
    # Zero for a below 2⁻¹²⁶: such a number changes no sum with an offset b of at least 2⁻⁵³.
    m = jnp.where(exponent > 0, bits & 0x7FFFFF | 0x800000, jnp.uint32(0))
    W, m = jnp.broadcast_arrays(W, m)
    w1, w0, m1, m0 = W >> 16, W & 0xFFFF, m >> 16, m & 0xFFFF
    cross, other = w0 * m1, w1 * m0
    middle = (w0 * m0 >> 16) + (cross & 0xFFFF) + (other & 0xFFFF)
    high = w1 * m1 + (cross >> 16) + (other >> 16) + (middle >> 16)
    return _normalised((high, W * m), exponent + 896)


def add(x: Pair, y: Pair) -> Pair:
    """x + y as float64 rounds it."""
    swap = (y.high > x.high) | ((y.high == x.high) & (y.low > x.low))
    large = Pair(jnp.where(swap, y.high, x.high), jnp.where(swap, y.low, x.low))
    small = Pair(jnp.where(swap, x.high, y.high), jnp.where(swap, x.low, y.low))
    distance = (large.high >> 20) - (small.high >> 20)
    low2 = _left(_significand(large), jnp.uint32(2))
    shifted = _right_sticky(_left(_significand(small), jnp.uint32(2)), distance)
    high, low = _sum(low2, shifted)
    carry = high >> 23  # 1 if the sum has 56 bits
    high, low = _right_sticky((high, low), carry)
    up = ((low & 3) == 3) | ((low & 7) == 6)
    high, low = _sum(_right((high, low), jnp.uint32(2)), (jnp.uint32(0), up.astype(jnp.uint32)))
    # The significand's leading bit adds 1 to the exponent, and so does a carry out of rounding.
    exponent = (large.high >> 20) + carry
    zero = exponent == 0
    return Pair(jnp.where(zero, 0, (exponent - 1 << 20) + high), jnp.where(zero, 0, low))


def fold(x: Pair) -> Pair:
    """2 |x − rint x| of x below 2²¹."""
    exponent = x.high >> 20
    below_half = exponent < 1022
    doubled = jnp.where(exponent > 0, x.high + jnp.uint32(1 << 20), x.high)
    # The bits below the point: all of `low`, and `places` bits of `high`.
    places = jnp.where(below_half, jnp.uint32(0), 1043 - exponent)
    one = jnp.uint32(1) << places
    high, low = _significand(x)[0] & (one - 1), x.low
    other_high, other_low = one - high - (low != 0), jnp.uint32(0) - low
    nearer = (other_high < high) | ((other_high == high) & (other_low < low))
    distance = jnp.where(nearer, other_high, high), jnp.where(nearer, other_low, low)
    folded = _normalised(distance, exponent.astype(jnp.int32) + 1)
    return Pair(
        jnp.where(below_half, doubled, folded.high), jnp.where(below_half, x.low, folded.low)
    )


def _significand(x: Pair) -> Words:
    """The 53 bits with the leading one, which 0 (and what is below 2⁻¹⁰²²) does not have."""
    leading = jnp.where(x.high >> 20 > 0, jnp.uint32(1 << 20), jnp.uint32(0))
    return x.high & 0xFFFFF | leading, x.low


def _normalised(words: Words, exponent: jax.Array) -> Pair:
    """The number words · 2^(exponent − 1075), words below 2⁵³, as a pair."""
    high, low = words
    shift = jnp.where(high > 0, lax.clz(high), 32 + lax.clz(low)) - 11
    zero = (high | low) == 0
    high, low = _left(words, jnp.where(zero, 0, shift))
    biased = exponent.astype(jnp.uint32) - shift.astype(jnp.uint32)
    return Pair(jnp.where(zero, 0, (biased - 1 << 20) + high), jnp.where(zero, 0, low))


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
