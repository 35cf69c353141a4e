"""The baseline: the same environments as a researcher would write them, in plain NumPy.

They produce the same numbers (`tests/compiled` checks that states agree bit for bit), with the same
action checks and `info`, but without tuning or compiled code. Φ is SciPy's `ndtr`; the common
`scipy.stats.norm.cdf` costs ninety times as much on four values.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from sme_registry.task import Task

Array = npt.NDArray[Any]


def policy(task: Task, x: Array) -> Array:
    """π*(s) of one state `[S]` or a batch `[B, S]`."""
    for W, b in task.policies[0]:
        x = ndtr(x @ W.T + b)
    return x


def transition(task: Task, s: Array, action: Array) -> Array:
    """T(s, a), summed in METHOD's order, of one state `[S]` or a batch `[B, S]`."""
    action = action.astype(np.float32).astype(np.float64)
    y = s + task.b
    for i in range(task.spec.action_dim):
        y = y + task.W[i] * action[..., i, None]
    return 2.0 * np.abs(y - np.rint(y))


class PlainEnv(gymnasium.Env[Array, Array]):
    """One environment in plain NumPy."""

    def __init__(self, task: Task) -> None:
        self.task, self.sme = task, task.spec
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (self.sme.state_dim + 2,))
        self.action_space = gymnasium.spaces.Box(0.0, 1.0, (self.sme.action_dim,))

    def observation(self) -> Array:
        auxiliary = [self.t / self.sme.horizon, self.accumulated / self.sme.k]
        return np.concatenate([self.s, auxiliary]).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.s = self.np_random.random(self.sme.state_dim)
        self.t, self.accumulated = 0, 0.0
        return self.observation(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape or not np.all(np.isfinite(action)):
            raise ValueError(f"bad action: {action!r}")
        action = np.clip(action, 0.0, 1.0)
        optimal = policy(self.task, self.s)
        similarity = 1.0 - np.mean(np.abs(action - optimal))
        graded = np.maximum(0.0, 4.0 * (similarity - 0.75))
        step_reward = graded if graded > self.sme.r_min else 0.0
        self.s = transition(self.task, self.s, action)
        self.t += 1
        self.accumulated += step_reward
        terminated = bool(step_reward < self.sme.D)
        truncated = self.t >= self.sme.horizon
        reward = 0.0
        if self.t % self.sme.k == 0 or truncated:
            reward, self.accumulated = self.accumulated, 0.0
        info = {
            "optimal_action": optimal,
            "similarity": similarity,
            "step_reward": step_reward,
            "regret": 1.0 - step_reward,
            "accumulated_reward": self.accumulated,
        }
        return self.observation(), float(reward), terminated, truncated, info


class PlainBatch:
    """A batch of `count` environments in plain batched NumPy (all lanes truncate together)."""

    def __init__(self, task: Task, count: int, seed: int = 0) -> None:
        self.task, self.sme, self.count = task, task.spec, count
        self.random = np.random.default_rng(seed)
        self.reset()

    def observation(self) -> Array:
        time = np.full((self.count, 1), self.t / self.sme.horizon)
        accumulated = self.accumulated[:, None] / self.sme.k
        return np.concatenate([self.s, time, accumulated], axis=1).astype(np.float32)

    def reset(self) -> Array:
        self.s = self.random.random((self.count, self.sme.state_dim))
        self.t, self.accumulated = 0, np.zeros(self.count)
        return self.observation()

    def step(self, action: Array) -> tuple[Array, Array, Array, Array, dict[str, Array]]:
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (self.count, self.sme.action_dim) or not np.all(np.isfinite(action)):
            raise ValueError(f"bad action: {action!r}")
        action = np.clip(action, 0.0, 1.0)
        optimal = policy(self.task, self.s)
        similarity = 1.0 - np.mean(np.abs(action - optimal), axis=1)
        graded = np.maximum(0.0, 4.0 * (similarity - 0.75))
        step_reward = np.where(graded > self.sme.r_min, graded, 0.0)
        self.s = transition(self.task, self.s, action)
        self.t += 1
        self.accumulated = self.accumulated + step_reward
        terminated = step_reward < self.sme.D
        truncated = np.full(self.count, self.t >= self.sme.horizon)
        paid = truncated | (self.t % self.sme.k == 0)
        reward = np.where(paid, self.accumulated, 0.0)
        self.accumulated = np.where(paid, 0.0, self.accumulated)
        info = {
            "optimal_action": optimal,
            "similarity": similarity,
            "step_reward": step_reward,
            "regret": 1.0 - step_reward,
            "accumulated_reward": self.accumulated,
        }
        observation = self.observation()
        if truncated.any():
            observation = self.reset()
        return observation, reward, terminated, truncated, info
