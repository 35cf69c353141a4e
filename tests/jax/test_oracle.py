"""The optimal action and rewards are NumPy's, to rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr

from sme_registry import SMESpec, materialize
from sme_registry.jax import oracle
from sme_registry.jax.task import Shape, task_params

WIDE = SMESpec(complexity=4, hidden_width=7, action_dim=16), (9, 18, 6, 10)
# The greatest error in float32 measured over 5,120 states: 7e-7 at L = 1 to 4, 4e-5 at L = 50.
SHAPES = [
    (
        SMESpec(state_dim=3, action_dim=5, r_min=0.5, policy_init="unit_variance"),
        (5, 8, 1, 0),
        jnp.float64,
        1e-12,
    ),
    (SMESpec(complexity=2, hidden_width=7, rotation=0.7), None, jnp.float64, 1e-12),
    (*WIDE, jnp.float64, 1e-12),
    (*WIDE, jnp.float32, 1e-6),
    (SMESpec(), None, jnp.float32, 1e-6),
    (SMESpec(complexity=50), None, jnp.float32, 6e-5),
]


def judge(params, s, a):
    optimal = oracle.optimal_action(params, s)
    similarity = oracle.similarity(params, a, optimal)
    return optimal, similarity, oracle.step_reward(params, similarity)


@pytest.mark.parametrize(("spec", "padded", "dtype", "tolerance"), SHAPES)
def test_actions_similarities_and_rewards_equal_numpys(spec, padded, dtype, tolerance):
    task = materialize(spec)
    rng = np.random.default_rng(0)
    s = rng.uniform(-0.5, 1.5, (256, spec.state_dim))
    a = rng.random((256, spec.action_dim)) ** 2
    a[::2] = task.optimal_action(s[::2]) + rng.normal(0, 0.05, a[::2].shape)
    shape = Shape(*padded) if padded else Shape.of(spec)
    params = task_params(spec, shape=shape, dtype=dtype)
    padding = [(0, 0), (0, shape.action_dim - spec.action_dim)]
    optimal, similarity, reward = jax.jit(judge)(
        params,
        np.pad(s, [(0, 0), (0, shape.state_dim - spec.state_dim)]),
        np.pad(a, padding, constant_values=0.9),
    )
    assert optimal.dtype == similarity.dtype == reward.dtype == dtype
    used = np.asarray(optimal)[:, : spec.action_dim]
    np.testing.assert_allclose(used, task.optimal_action(s), rtol=0, atol=tolerance)
    np.testing.assert_allclose(similarity, task.similarity(s, a), rtol=0, atol=tolerance)
    np.testing.assert_allclose(reward, task.step_reward(s, a), rtol=0, atol=tolerance)


def test_rewards_at_the_threshold_are_not_paid():
    params = task_params(SMESpec(r_min=0.5))
    rewards = jax.jit(oracle.step_reward)(params, np.array([0.5, 0.875, 0.9, 1.0]))
    np.testing.assert_allclose(rewards, [0.0, 0.0, 0.6, 1.0], atol=1e-15)


def test_the_normal_cdf_is_exact_to_rounding():
    x = np.linspace(-12, 12, 10_001)
    np.testing.assert_allclose(jax.jit(oracle.normal_cdf)(x), ndtr(x), rtol=0, atol=1e-15)
