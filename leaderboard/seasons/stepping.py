"""`Lanes`: the lanes of one hidden instance, from actions to what an entrant sees, and to regret.

Everything follows from the start and the number of lanes, so a replay of the same actions gives the
same numbers, bit for bit. `L` lanes, `S` state_dim, `A` action_dim.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.envs import SMEVectorEnv
from sme_registry.seasons.wire import StepsAnswer
from sme_registry.spec import SMESpec

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Start:
    """What the steps of an instance follow from, besides the actions; `repr` does not show it.

    Attributes:
      spec: the hidden task.
      seed: of the first lane's episodes; lane i has seed + i.
    """

    spec: SMESpec = field(repr=False)
    seed: int = field(repr=False)


class Regret(NamedTuple):
    """The regret of one request's steps, summed over the lanes.

    Attributes:
      taken: of the actions, in [0, L].
      half: of the constant action ½ in the same states.
    """

    taken: float
    half: float


class Lanes:
    """L lanes of an instance at the start of their first episodes.

    Args:
      start: of the instance.
      lanes: L.

    Attributes:
      observation: `[L, S + 2]`, the present one.
    """

    def __init__(self, start: Start, lanes: int) -> None:
        self._env = SMEVectorEnv(start.spec, lanes, autoreset_mode="SameStep")
        self.observation: Floats = self._env.reset(seed=start.seed)[0]

    def step(self, actions: Floats) -> StepsAnswer:
        """One step of every lane, of actions `[L, A]`, finite, which are clipped to [0, 1]."""
        return self._step(actions)[0]

    def step_with_regret(self, actions: Floats) -> tuple[StepsAnswer, Regret]:
        """`step`, and the regret of the steps, which no entrant is told."""
        steps, info = self._step(actions)
        ended = steps.terminated | steps.truncated
        if ended.any():  # their rows are already those of the next episode
            for name in ("regret", "optimal_action"):
                info[name][ended] = info["final_info"][name][ended]
        task = self._env.task
        half = 1.0 - task.reward_of(task.similarity_of(np.array(0.5), info["optimal_action"]))
        return steps, Regret(float(info["regret"].sum()), float(half.sum()))

    def _step(self, actions: Floats) -> tuple[StepsAnswer, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self._env.step(actions)
        self.observation = observation
        last = np.zeros_like(observation)
        if "final_obs" in info:
            ended = terminated | truncated
            last[ended] = np.stack(info["final_obs"][ended])
        return StepsAnswer(
            observation, reward.astype(np.float32), terminated, truncated, last
        ), info
