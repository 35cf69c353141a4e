"""Arithmetic in pairs of uint32 has the bits of float64."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry.jax import pairs

COUNT = 2**20


def sparse_significands(rng: np.random.Generator) -> Any:
    """Bits in which ties of rounding and carries over all places are common."""
    bits = rng.integers(0, 2**52, COUNT, dtype=np.uint64)
    few = bits & rng.integers(0, 2**52, COUNT, dtype=np.uint64)
    few &= rng.integers(0, 2**52, COUNT, dtype=np.uint64) << np.uint64(20)
    ones = np.uint64(2**52 - 1) - (few & np.uint64(2**52 - 1))
    return np.choose(rng.integers(0, 3, COUNT), [bits, few & np.uint64(2**52 - 1), ones])


def numbers(rng: np.random.Generator, lowest: int, highest: int) -> Any:
    """Positive float64 with exponents in [lowest, highest), and a few zeros."""
    exponents = rng.integers(1023 + lowest, 1023 + highest, COUNT, dtype=np.uint64)
    x = (exponents << np.uint64(52) | sparse_significands(rng)).view(np.float64)
    return np.where(rng.random(COUNT) < 0.01, 0.0, x)


def assert_same_bits(pair: Any, expected: Any) -> None:
    computed = pairs.to_float64(pair)
    different = computed.view(np.uint64) != expected.view(np.uint64)
    assert not different.any(), (computed[different][:5], expected[different][:5])


def test_pairs_and_float64_convert_without_loss() -> None:
    x = np.array([0.0, 5e-324, 2.0**-53, 1 / 3, 0.5, 1.0, 2.0**20 + 0.1])
    assert_same_bits(pairs.from_float64(x), x)


@pytest.mark.parametrize(("lowest", "highest"), [(-4, 5), (-80, 21)])
def test_sums_round_as_float64(lowest: int, highest: int) -> None:
    rng = np.random.default_rng(0)
    x, y = numbers(rng, lowest, highest), numbers(rng, lowest, highest)
    total = jax.jit(pairs.add)(pairs.from_float64(x), pairs.from_float64(y))
    assert_same_bits(total, x + y)


def test_sums_halfway_between_two_numbers_round_to_the_even_one() -> None:
    ulp = 2.0**-52
    x, y = np.array([1.0, 1.0 + ulp, 1.0 + ulp]), np.array([ulp / 2, ulp / 2, np.nextafter(1, 0)])
    total = jax.jit(pairs.add)(pairs.from_float64(x), pairs.from_float64(y))
    assert_same_bits(total, x + y)
    assert pairs.to_float64(total)[:2].tolist() == [1.0, 1.0 + 2 * ulp]


def test_products_are_exact() -> None:
    rng = np.random.default_rng(1)
    W = rng.integers(0, 2**29 + 1, COUNT, dtype=np.uint32)
    W[:3] = 0, 1, 2**29
    a = rng.random(COUNT, np.float32) * np.float32(2.0) ** rng.integers(-100, 1, COUNT)
    a[::7], a[::11], a[::13] = 0.0, 1.0, 1 - 2**-24
    a = a.astype(np.float32)
    product = jax.jit(pairs.product)(W, a)
    assert_same_bits(product, W.astype(np.float64) * 2.0**-29 * a.astype(np.float64))


def test_the_fold_is_exact() -> None:
    rng = np.random.default_rng(2)
    x = numbers(rng, -60, 21)
    x[:9] = 0.0, 0.25, 0.5, 0.75, 1.0, 1.5, np.nextafter(0.5, 0), np.nextafter(1, 0), 2.0**20 + 0.5
    assert_same_bits(jax.jit(pairs.fold)(pairs.from_float64(x)), 2.0 * np.abs(x - np.rint(x)))


def test_float32_is_the_nearest() -> None:
    x = numbers(np.random.default_rng(3), -60, 2)
    x[:4] = 1 + 2**-24, 1 + 3 * 2**-24, 2 - 2**-30, 1 - 2**-25
    computed = np.asarray(jax.jit(pairs.to_float32)(pairs.from_float64(x)))
    assert (computed == x.astype(np.float32)).all()


def test_fractions_are_exact() -> None:
    bits = np.array([0, 1, 3, 2**31, 2**32 - 1], np.uint32)
    assert_same_bits(pairs.from_fraction(jnp.asarray(bits)), bits * 2.0**-32)
