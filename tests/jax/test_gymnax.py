"""A task behind gymnax's methods, called as gymnax's wrappers call them."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry.errors import OptionError, SpecError
from sme_registry.jax import env as functions
from sme_registry.jax.gymnax import Environment
from sme_registry.jax.task import task_params


class LogState(NamedTuple):
    inner: Any
    total: jax.Array


class LogWrapper:
    """What gymnax's wrapper of the same name does: float32 sums in the carry of a scan."""

    def __init__(self, env):
        self._env = env

    def __getattr__(self, name):
        return getattr(self._env, name)

    def reset(self, key, params=None):
        observation, state = self._env.reset(key, params)
        return observation, LogState(state, jnp.zeros((), jnp.float32))

    def step(self, key, state, action, params=None):
        observation, inner, reward, terminated, truncated, info = self._env.step(
            key, state.inner, action, params
        )
        total = state.total + reward
        info["returned_episode_returns"] = total
        state = LogState(inner, total * (1 - (terminated | truncated)))
        return observation, state, reward, terminated, truncated, info


def test_a_wrapped_environment_runs_in_a_compiled_scan():
    env = LogWrapper(Environment("SME/Default-v1", horizon=5, k=2))
    space = env.action_space(env.default_params)

    def advance(carry, key):
        observation, state = carry
        observation, state, reward, _, truncated, info = env.step(key, state, space.sample(key))
        assert observation.shape == env.observation_space(env.default_params).shape
        logged = reward, truncated, info["returned_episode_returns"], info["discount"]
        return (observation, state), logged

    @jax.jit
    @jax.vmap
    def run(key):
        return jax.lax.scan(advance, env.reset(key), jax.random.split(key, 12))[1]

    reward, truncated, total, discount = run(jax.random.split(jax.random.key(0), 3))
    assert reward.dtype == jnp.float32
    assert truncated.sum(axis=1).tolist() == [2, 2, 2]
    np.testing.assert_allclose(total[:, 4], reward[:, :5].sum(axis=1), rtol=1e-6)
    assert (discount == 1.0).all()


def test_steps_are_those_of_the_functions_with_rescaled_actions():
    key, action = jax.random.key(1), jnp.array([0.5, -1.0, 3.0, 0.0], jnp.float32)
    env, params = Environment(), task_params("SME/Default-v1")
    observation, state = env.reset(key)
    assert not env.is_truncated(state)
    after, _, reward, terminated, truncated, info = env.step(key, state, action, params)
    unit = functions.to_unit(action, symmetric=True)
    expected = jax.jit(functions.step)(key, state, unit, params)
    assert (after == expected[0]).all()
    assert (observation[:8] == state.s.astype(jnp.float32)).all()
    assert reward == expected[2].astype(jnp.float32)
    assert not terminated
    assert not truncated
    assert abs(info["regret"] - expected[4]["regret"]) < 1e-15


def test_names_and_spaces_are_those_of_the_task():
    env = Environment("SME/Default-v1", action_dim=2)
    assert env.num_actions == 2
    assert env.default_params.max_steps_in_episode == 100
    assert Environment("SME/Default-v1").name == "SME/Default-v1"
    actions, observations = env.action_space(), env.observation_space()
    assert (actions.low, actions.high, actions.shape) == (-1.0, 1.0, (2,))
    assert repr(actions) == "Box(low=-1.0, high=1.0, shape=(2,), dtype=dtype('float32'))"
    assert (observations.low, observations.high, observations.shape) == (0.0, 1.0, (10,))
    sample = actions.sample(jax.random.key(0))
    assert sample.shape == (2,)
    assert actions.contains(sample)
    assert not actions.contains(sample + 2)
    assert Environment(action_range="unit").action_space().low == 0.0


def test_a_step_without_a_new_episode_keeps_the_last_state():
    env = Environment("SME/Default-v1", horizon=1, D=0.9)
    key, action = jax.random.key(0), jnp.zeros(4)
    after, state, _, terminated, info = jax.jit(env.step_env)(key, env.reset(key)[1], action)
    assert env.is_truncated(state)
    assert terminated
    assert (info["discount"], after[-2]) == (0.0, 1.0)


def test_unknown_ranges_and_teams_are_refused():
    with pytest.raises(OptionError, match="action_range='wide': must be"):
        Environment(action_range="wide")
    with pytest.raises(SpecError, match=r"^team="):
        Environment("Team4")
