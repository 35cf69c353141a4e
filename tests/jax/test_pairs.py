"""Arithmetic in pairs of uint32 has the bits of float64."""

import jax
import numpy as np
import pytest

from sme_registry.jax import pairs

COUNT = 2**17
ULP = 2.0**-52
RNG = np.random.default_rng(0)


def numbers(lowest, highest, *edges):
    """Float64 from 2^lowest to 2^highest: zeros, bits with frequent ties and long carries."""
    bits = RNG.integers(0, 2**52, COUNT, dtype=np.uint64)
    few = bits & RNG.integers(0, 2**52, COUNT, dtype=np.uint64)
    few &= RNG.integers(0, 2**52, COUNT, dtype=np.uint64) << np.uint64(20)
    few &= np.uint64(2**52 - 1)
    significands = np.choose(RNG.integers(0, 3, COUNT), [bits, few, np.uint64(2**52 - 1) - few])
    exponents = RNG.integers(1023 + lowest, 1023 + highest, COUNT, dtype=np.uint64)
    x = (exponents << np.uint64(52) | significands).view(np.float64)
    x[RNG.random(COUNT) < 0.01] = 0.0
    x[: len(edges)] = edges
    return x


def product(W, a):
    return W.astype(np.float64) * 2.0**-29 * a.astype(np.float64)


def fractions():
    """Float32 in [0, 1], down to 2^-124."""
    a = RNG.random(COUNT, np.float32) * np.float32(2.0) ** RNG.integers(-100, 1, COUNT)
    a[::7], a[::11], a[::13] = 0.0, 1.0, 1 - 2**-24
    return a.astype(np.float32)


W = RNG.integers(0, 2**29 + 1, COUNT, dtype=np.uint32)
W[:3] = 0, 1, 2**29
HALVES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, np.nextafter(0.5, 0), np.nextafter(1, 0), 2.0**20 + 0.5)
OPERATIONS = {
    "sums": (pairs.add, np.add, [numbers(-4, 5), numbers(-4, 5)]),
    "sums of unequal numbers": (pairs.add, np.add, [numbers(-80, 21), numbers(-80, 21)]),
    "sums halfway between two numbers": (
        pairs.add,
        np.add,
        [
            np.array([1.0, 1.0 + ULP, 1.0 + ULP]),
            np.array([ULP / 2, ULP / 2, np.nextafter(1, 0)]),
        ],
    ),
    "products": (pairs.product, product, [W, fractions()]),
    "the fold": (pairs.fold, lambda x: 2.0 * np.abs(x - np.rint(x)), [numbers(-60, 21, *HALVES)]),
    "fractions": (
        pairs.from_fraction,
        lambda bits: bits * 2.0**-32,
        [np.array([0, 1, 3, 2**31, 2**32 - 1], np.uint32)],
    ),
}


@pytest.mark.parametrize(("operation", "in_numpy", "inputs"), OPERATIONS.values(), ids=OPERATIONS)
def test_operations_have_the_bits_of_float64(operation, in_numpy, inputs):
    given = [pairs.from_float64(x) if x.dtype == np.float64 else x for x in inputs]
    computed, expected = pairs.to_float64(jax.jit(operation)(*given)), in_numpy(*inputs)
    different = computed.view(np.uint64) != expected.view(np.uint64)
    assert not different.any(), (computed[different][:5], expected[different][:5])


def test_conversions_lose_nothing_and_float32_is_the_nearest():
    x = np.array([0.0, 5e-324, 2.0**-53, 1 / 3, 0.5, 1.0, 2.0**20 + 0.1])
    assert (pairs.to_float64(pairs.from_float64(x)) == x).all()
    x = numbers(-60, 2, 1 + 2**-24, 1 + 3 * 2**-24, 2 - 2**-30, 1 - 2**-25)
    computed = np.asarray(jax.jit(pairs.to_float32)(pairs.from_float64(x)))
    assert (computed == x.astype(np.float32)).all()
