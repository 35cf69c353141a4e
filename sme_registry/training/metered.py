"""`MeteredVecEnv`: the environment that a study's agents train in, which keeps the books.

Every learner steps its environment, whatever else it does. So what a run needs to know beside its
learner is counted here: the steps, their exact regret, the time they took; and after each of them
somebody may be told, to evaluate the learner when that is due. No learner needs a hook for it.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from sme_registry.envs import SMEEnv
from sme_registry.envs.single import Observation
from sme_registry.sb3 import LanesVecEnv
from sme_registry.spec import SMESpec


class MeteredVecEnv(LanesVecEnv):
    """One environment as an SB3 `VecEnv`, with its steps counted.

    The same numbers, bit for bit, as `SMEVecEnv` with one environment. But its step is a single
    environment's, without a batch around it: beside PPO's 0.5 ms a step that is worth having.

    Args:
      spec: the task, of a single agent.
      action_range: "symmetric" or "unit".

    Attributes:
      steps: taken so far.
      regret: the sum of their regret.
      seconds: of this thread's CPU time that they took.
      after_step: called after each step with `steps`, and not in `seconds`; what it raises ends
        the training.
    """

    def __init__(self, spec: SMESpec, *, action_range: Literal["unit", "symmetric"]) -> None:
        self._env = SMEEnv(spec, action_range=action_range)
        super().__init__([self._env])
        self.steps, self.regret, self.seconds = 0, 0.0, 0.0
        self.after_step: Callable[[int], None] = lambda steps: None

    def reset(self) -> Observation:
        """Begin an episode, with the seed and options set before; `[1, S + 2]`."""
        observation, _ = self._env.reset(seed=self._seeds[0], options=self._options[0] or None)
        self._has_begun()
        return observation[None]

    def step_wait(self) -> Any:
        """One step; see `SMEVecEnv.step_wait`."""
        begun = time.thread_time()
        observation, reward, terminated, truncated, info = self._env.step(self._waiting()[0])
        self.regret += info["regret"]
        ended = terminated or truncated
        info["TimeLimit.truncated"] = truncated and not terminated
        if ended:
            info["terminal_observation"] = observation
            observation, _ = self._env.reset()
        rewards, dones = np.array([reward], np.float32), np.array([ended])
        self.steps += 1
        self.seconds += time.thread_time() - begun
        self.after_step(self.steps)
        return observation[None], rewards, dones, [info]
