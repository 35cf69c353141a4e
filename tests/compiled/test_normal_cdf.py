"""Φ by table against mpmath's, computed with 40 digits, and against SciPy's over a dense grid."""

import numpy as np
import pytest
from scipy.special import ndtr

import sme_registry
from benchmarks.plain_numpy import PlainBatch, PlainEnv
from sme_registry import SMESpec, materialize

pytest.importorskip("numba")
from numba import njit

from sme_registry.task.kernels import CELLS_PER_UNIT, LIMIT, normal_cdf

BOUND = 3e-15


@njit
def phi(x):
    out = np.empty(x.size)
    for i in range(x.size):
        out[i] = normal_cdf(x[i])
    return out


def test_the_error_is_below_its_bound_over_a_dense_grid():
    x = np.linspace(-9.0, 9.0, 300_001)
    assert np.abs(phi(x) - ndtr(x)).max() < BOUND


def test_the_error_is_below_its_bound_against_forty_digits():
    mpmath = pytest.importorskip("mpmath")
    borders = (np.arange(-137, 138) + 0.5) / CELLS_PER_UNIT  # where a cell meets the next
    random = np.random.default_rng(0).normal(size=300) * 2.0
    x = np.concatenate([borders, np.nextafter(borders, 9.0), np.nextafter(borders, -9.0), random])
    with mpmath.workdps(40):
        exact = [mpmath.ncdf(mpmath.mpf(float(v))) for v in x]
        errors = [abs(float(mpmath.mpf(float(y)) - e)) for y, e in zip(phi(x), exact, strict=True)]
    assert max(errors) < BOUND


def test_beyond_the_table_it_is_zero_or_one_and_a_half_for_tiny_arguments():
    x = np.array([LIMIT, np.nextafter(LIMIT, 0), np.nextafter(LIMIT, 9), 8.6, 1e300, np.inf])
    low, high = phi(-x), phi(x)
    assert ((low >= 0.0) & (low < 1e-16)).all()
    assert ((high > 1.0 - 1e-15) & (high <= 1.0)).all()
    assert (phi(np.array([0.0, -0.0, 5e-324, -5e-324, -1e-300, 1e-17])) == 0.5).all()


SPEC = SMESpec(k=3, r_min=0.1, complexity=3)


@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_the_plain_environment_is_ours_step_for_step():
    plain, ours = PlainEnv(materialize(SPEC)), sme_registry.make(SPEC).unwrapped
    random = np.random.default_rng(0)
    seen, _ = plain.reset(seed=7)
    np.testing.assert_array_equal(seen, ours.reset(seed=7)[0])
    for _ in range(SPEC.horizon):
        action = random.uniform(-0.2, 1.2, 4).astype(np.float32)
        theirs, mine = plain.step(action), ours.step(action)
        np.testing.assert_array_equal(plain.s, ours.state)
        np.testing.assert_array_equal(theirs[0], mine[0])
        assert theirs[1] == pytest.approx(mine[1], abs=1e-12)
        assert theirs[2:4] == mine[2:4]
        for key, value in theirs[4].items():
            np.testing.assert_allclose(value, mine[4][key], atol=1e-12, rtol=0)


@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_the_plain_batch_is_ours_step_for_step():
    plain = PlainBatch(materialize(SPEC), 70)
    ours = sme_registry.make_vec(SPEC, 70)
    ours.reset(seed=0, options={"state": plain.s})
    random = np.random.default_rng(0)
    for _ in range(SPEC.horizon - 1):
        action = random.uniform(-0.2, 1.2, (70, 4)).astype(np.float32)
        theirs, mine = plain.step(action), ours.step(action)
        np.testing.assert_array_equal(plain.s, ours.unwrapped.state)
        np.testing.assert_array_equal(theirs[0], mine[0])
        np.testing.assert_allclose(theirs[1], mine[1], atol=1e-12, rtol=0)
        for key, value in theirs[4].items():
            np.testing.assert_allclose(value, mine[4][key], atol=1e-12, rtol=0)
