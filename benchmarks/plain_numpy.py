"""The baseline: the same environment as a researcher would write it, in plain NumPy.

The paper's formulas as they stand, one operation a line, no tuning and no compiled code; Φ is
SciPy's `ndtr` (`scipy.stats.norm.cdf` would make the baseline three times as slow, and flatter us).
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
        action = np.clip(np.asarray(action, dtype=np.float64), 0.0, 1.0)
        optimal = policy(self.task, self.s)
        similarity = 1.0 - np.mean(np.abs(action - optimal))
        graded = np.maximum(0.0, 4.0 * (similarity - 0.75))
        step_reward = graded if graded > self.sme.r_min else 0.0
        moved = self.s + action @ self.task.W + self.task.b
        self.s = np.arccos(np.cos(2.0 * np.pi * moved)) / np.pi
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
        action = np.clip(np.asarray(action, dtype=np.float64), 0.0, 1.0)
        optimal = policy(self.task, self.s)
        similarity = 1.0 - np.mean(np.abs(action - optimal), axis=1)
        graded = np.maximum(0.0, 4.0 * (similarity - 0.75))
        step_reward = np.where(graded > self.sme.r_min, graded, 0.0)
        moved = self.s + action @ self.task.W + self.task.b
        # The fold of METHOD; arccos(cos) would make the baseline thirty times as slow here.
        self.s = 2.0 * np.abs(moved - np.rint(moved))
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
