"""A task as an `Environment` of gymnax 1.0, for its wrappers and for agents written for it.

    env = Environment("SME/Default-v1", k=10)
    observation, state = env.reset(key)
    observation, state, reward, terminated, truncated, info = env.step(key, state, action)

gymnax is not required; where it is installed, the spaces are its own. For agents written for an
older gymnax, wrap this environment in gymnax's `LegacyStepAPIWrapper`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sme_registry.io import choice
from sme_registry.jax import env
from sme_registry.jax.env import EnvState, Info
from sme_registry.jax.task import TaskParams, task_params
from sme_registry.spec.catalogue import title
from sme_registry.spec.sme_spec import ACTION_RANGES, ActionRange, SpecLike
from sme_registry.task.loading import load_task

__all__ = ["Environment"]

Step = tuple[jax.Array, EnvState, jax.Array, jax.Array, jax.Array, Info]


class Environment:
    """One task with gymnax's methods; rewards are float32, which its wrappers expect.

    Actions are in [−1, 1], or with `action_range="unit"` in [0, 1], and clipped; `overrides` are
    fields of the spec to change. `info` has the values of `sme_registry.jax.env.step`, and gymnax's
    `discount`.
    """

    def __init__(
        self,
        spec: SpecLike = "SME/Default-v1",
        *,
        action_range: ActionRange = "symmetric",
        dtype: Any = jnp.float64,
        **overrides: Any,
    ) -> None:
        choice("action_range", action_range, ACTION_RANGES)
        self.sme_spec = load_task(spec, **overrides).spec
        self.default_params = task_params(self.sme_spec, dtype=dtype)
        self._symmetric = action_range == "symmetric"

    @property
    def name(self) -> str:
        return title(self.sme_spec)

    @property
    def num_actions(self) -> int:
        return self.sme_spec.action_dim

    @partial(jax.jit, static_argnames="self")
    def reset(self, key: jax.Array, params: TaskParams | None = None) -> tuple[jax.Array, EnvState]:
        """Begin an episode: the observation `[S + m + 2]`, and its state."""
        return self.reset_env(key, params)

    @partial(jax.jit, static_argnames="self")
    def step(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: TaskParams | None = None
    ) -> Step:
        """One step; where the episode ends, a new one begins. See `sme_registry.jax.env.step`."""
        return self._step(env.step, key, state, action, params)

    def reset_env(
        self, key: jax.Array, params: TaskParams | None = None
    ) -> tuple[jax.Array, EnvState]:
        """The same as `reset`."""
        return env.reset(key, self._params(params))

    def step_env(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: TaskParams | None = None
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, Info]:
        """One step without a new episode: observation, state, reward, terminated, info."""
        observation, state, reward, terminated, _, info = self._step(
            env.step_env, key, state, action, params
        )
        return observation, state, reward, terminated, info

    def observation_space(self, params: TaskParams | None = None) -> Any:
        """(s, t/T, r_cum/k), or what the agent sees in place of s; each in [0, 1]."""
        return _box(0.0, 1.0, (self.sme_spec.observation_dim,))

    def action_space(self, params: TaskParams | None = None) -> Any:
        """`[A]` in the action range."""
        return _box(-1.0 if self._symmetric else 0.0, 1.0, (self.num_actions,))

    def is_truncated(self, state: EnvState, params: TaskParams | None = None) -> jax.Array:
        return state.t >= self._params(params).horizon

    def _params(self, params: TaskParams | None) -> TaskParams:
        return self.default_params if params is None else params

    def _step(
        self,
        step: Any,
        key: jax.Array,
        state: EnvState,
        action: jax.Array,
        params: TaskParams | None,
    ) -> Step:
        params = self._params(params)
        unit = env.to_unit(jnp.asarray(action), self._symmetric, params.r_min.dtype)
        observation, state, reward, _, info = step(key, state, unit, params)
        info["discount"] = jnp.where(info["terminated"], 0.0, 1.0).astype(jnp.float32)
        reward = reward.astype(jnp.float32)
        return observation, state, reward, info["terminated"], info["truncated"], info


@dataclass(frozen=True)
class Box:
    """gymnax's space of arrays, where gymnax is not installed."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any

    def sample(self, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, self.shape, self.dtype, self.low, self.high)

    def contains(self, x: jax.Array) -> jax.Array:
        return jnp.all((x >= self.low) & (x <= self.high))


def _box(low: float, high: float, shape: tuple[int, ...]) -> Any:
    try:
        from gymnax.environments import spaces  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        return Box(low, high, shape, np.dtype(np.float32))
    return spaces.Box(low, high, shape, jnp.float32)
