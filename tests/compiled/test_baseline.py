"""The benchmarks' plain NumPy baseline is the same environment: only then is it a measure."""

import numpy as np
import pytest

import sme_registry
from benchmarks.plain_numpy import PlainBatch, PlainEnv
from sme_registry import SMESpec, materialize

SPEC = SMESpec(k=3, r_min=0.1, complexity=3)


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
