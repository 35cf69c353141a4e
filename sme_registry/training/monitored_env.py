"""Training environments that count their steps, their regret and their time.

Every learner steps its environment, so counting here needs no hook in the learner. `after_step` is
called after each step, for example to evaluate the learner at fixed steps.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from sme_registry.envs import SMEEnv, SMEStreamEnv
from sme_registry.envs.types import Observation
from sme_registry.sb3 import LanesVecEnv, SMETeamVecEnv
from sme_registry.spec import SMESpec, StreamSpec


class MonitoredTeamVecEnv(SMETeamVecEnv):
    """Teams as an SB3 `VecEnv` (`SMETeamVecEnv`), with their steps counted."""

    def __init__(
        self, spec: SMESpec, num_envs: int, *, action_range: Literal["unit", "symmetric"]
    ) -> None:
        super().__init__(spec, num_envs, action_range=action_range)
        self.steps, self.seconds = 0, 0.0
        self.agents_regret = np.zeros(len(self.agents))
        self.after_step: Callable[[int], None] = lambda steps: None

    @property
    def regret(self) -> float:
        """Sum over steps of the mean regret over agents."""
        return float(self.agents_regret.mean())

    def step_wait(self) -> Any:
        """One step of all teams; see `SMETeamVecEnv.step_wait`."""
        begun = time.thread_time()
        done = super().step_wait()
        regrets = np.array([info["regret"] for info in done[3]])
        self.agents_regret += regrets.reshape(self.num_teams, -1).sum(axis=0)
        self.steps += self.num_teams
        self.seconds += time.thread_time() - begun
        self.after_step(self.steps)
        return done


class MonitoredVecEnv(LanesVecEnv):
    """One environment as an SB3 `VecEnv`, its steps counted, without the overhead of a batch."""

    def __init__(
        self, document: SMESpec | StreamSpec, *, action_range: Literal["unit", "symmetric"]
    ) -> None:
        self._env: SMEEnv
        if isinstance(document, StreamSpec):
            self._env = SMEStreamEnv(document, action_range=action_range)
        else:
            self._env = SMEEnv(document, action_range=action_range)
        super().__init__([self._env])
        self.steps, self.regret, self.seconds = 0, 0.0, 0.0
        self.cost: float | None = None if self._env.sme_spec.safety is None else 0.0
        self.info: dict[str, Any] = {}
        self.after_step: Callable[[int], None] = lambda steps: None

    def reset(self) -> Observation:
        """Begin an episode with the seed and options set before; observations `[1, …]`."""
        observation, info = self._env.reset(seed=self._seeds[0], options=self._options[0] or None)
        self.reset_infos = [info]
        self._clear_reset_arguments()
        return observation[None]

    def step_wait(self) -> Any:
        """One step; see `SMEVecEnv.step_wait`."""
        begun = time.thread_time()
        observation, reward, terminated, truncated, info = self._env.step(self._take_actions()[0])
        self.regret, self.info = self.regret + info["regret"], info
        if self.cost is not None:
            self.cost += info["cost"]
        ended = terminated or truncated
        info["TimeLimit.truncated"] = truncated and not terminated
        if ended:
            info["terminal_observation"] = observation
            observation, self.reset_infos[0] = self._env.reset()
        rewards, dones = np.array([reward], np.float32), np.array([ended])
        self.steps += 1
        self.seconds += time.thread_time() - begun
        self.after_step(self.steps)
        return observation[None], rewards, dones, [info]
