"""States have the bits of NumPy's over whole episodes; actions and rewards are within rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr

from sme_registry import SMESpec, materialize
from sme_registry.jax import task as functions
from sme_registry.jax.task import next_state, task_params
from sme_registry.task import step

ENVS, STEPS = 16, 99


def actions(rng, A):
    """Float32 actions `[STEPS, ENVS, A]`: uniform, out of range, tiny, and on the boundary."""
    shape = (STEPS, ENVS, A)
    uniform = rng.random(shape, np.float32)
    kinds = [uniform, 3.0 * uniform - 1.0, uniform**20, np.rint(2.0 * uniform) / 2.0]
    return np.choose(rng.integers(0, len(kinds), shape), kinds).astype(np.float32)


def numpy_states(spec, start, a):
    task, s = materialize(spec), start
    zeros, states = np.zeros((ENVS, 1)), []
    for t in range(STEPS):
        s = step(task, s, np.full(ENVS, t), zeros, a[t].astype(np.float64)).state
        states.append(s)
    return np.stack(states)


@pytest.mark.parametrize(("S", "A"), [(1, 1), (3, 16), (2, 40)])
def test_states_equal_numpys_over_whole_episodes(S, A):
    spec = SMESpec(state_dim=S, action_dim=A, seed=S)
    rng = np.random.default_rng(A)
    start, a = rng.random((ENVS, S)), actions(rng, A)
    params = task_params(spec)

    @jax.jit
    def rollout(s, a):
        def advance(s, a):
            s = jax.vmap(next_state, (None, 0, 0))(params, s, a)
            return s, s

        return jax.lax.scan(advance, s, a)[1]

    assert (np.asarray(rollout(start, a)) == numpy_states(spec, start, a)).all()


def test_float64_actions_are_rounded_as_in_numpy():
    spec = SMESpec()
    rng = np.random.default_rng(0)
    s, a = rng.random((64, 8)), rng.random((64, 4))
    computed = jax.jit(next_state)(task_params(spec), jnp.asarray(s), jnp.asarray(a))
    assert (np.asarray(computed) == materialize(spec).transition(s, a)).all()


WIDE = SMESpec(complexity=4, hidden_width=7, action_dim=16)
# The greatest error in float32 measured over 5,120 states: 7e-7 at L = 1 to 4, 4e-5 at L = 50.
SHAPES = [
    (
        SMESpec(state_dim=3, action_dim=5, r_min=0.5, policy_init="unit_variance"),
        jnp.float64,
        1e-12,
    ),
    (SMESpec(complexity=2, hidden_width=7, rotation=0.7), jnp.float64, 1e-12),
    (WIDE, jnp.float64, 1e-12),
    (WIDE, jnp.float32, 1e-6),
    (SMESpec(), jnp.float32, 1e-6),
    (SMESpec(complexity=50), jnp.float32, 6e-5),
]


def judge(params, s, a):
    optimal = functions.optimal_action(params, s)
    similarity = functions.similarity(params, a, optimal)
    return optimal, similarity, functions.step_reward(params, similarity)


@pytest.mark.parametrize(("spec", "dtype", "tolerance"), SHAPES)
def test_actions_similarities_and_rewards_equal_numpys(spec, dtype, tolerance):
    task = materialize(spec)
    rng = np.random.default_rng(0)
    s = rng.uniform(-0.5, 1.5, (256, spec.state_dim))
    a = rng.random((256, spec.action_dim)) ** 2
    a[::2] = task.optimal_action(s[::2]) + rng.normal(0, 0.05, a[::2].shape)
    optimal, similarity, reward = jax.jit(judge)(task_params(spec, dtype=dtype), s, a)
    assert optimal.dtype == similarity.dtype == reward.dtype == dtype
    np.testing.assert_allclose(optimal, task.optimal_action(s), rtol=0, atol=tolerance)
    np.testing.assert_allclose(similarity, task.similarity(s, a), rtol=0, atol=tolerance)
    np.testing.assert_allclose(reward, task.step_reward(s, a), rtol=0, atol=tolerance)


def test_rewards_at_the_threshold_are_not_paid():
    params = task_params(SMESpec(r_min=0.5))
    rewards = jax.jit(functions.step_reward)(params, np.array([0.5, 0.875, 0.9, 1.0]))
    np.testing.assert_allclose(rewards, [0.0, 0.0, 0.6, 1.0], atol=1e-15)


def test_the_normal_cdf_is_exact_to_rounding():
    x = np.linspace(-12, 12, 10_001)
    np.testing.assert_allclose(jax.jit(functions.normal_cdf)(x), ndtr(x), rtol=0, atol=1e-15)
