"""`SealedVecEnv`: a hidden task for Stable-Baselines3's algorithms."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from sme_registry.sb3.vec_env import LanesVecEnv, StepResult
from sme_registry.seasons.client import Instance, SealedVectorEnv, TicketLike
from sme_registry.seasons.wire import PATIENCE
from sme_registry.spec.sme_spec import ActionRange
from sme_registry.task.task import Observation


class SealedVecEnv(LanesVecEnv):
    """The lanes of a hidden task, as SB3's `VecEnv`; arguments as in `seasons.make_vec`.

    A finished lane begins its next episode at once. Resets are as in `SealedEnv`.
    """

    def __init__(
        self,
        url: str,
        ticket: TicketLike,
        instance: int = 0,
        num_envs: int = 1,
        *,
        action_range: ActionRange = "symmetric",
        insecure: bool = False,
        patience: float = PATIENCE,
    ) -> None:
        self.instance = Instance(
            url, ticket, instance, num_envs, insecure=insecure, patience=patience
        )
        self._hidden = SealedVectorEnv(self.instance, action_range)
        shared = {
            "render_mode": None, "spec": None,
            "action_space": self._hidden.single_action_space,
            "observation_space": self._hidden.single_observation_space,
        }  # fmt: skip
        super().__init__([SimpleNamespace(**shared) for _ in range(num_envs)])

    def reset(self) -> Observation:
        observation, _ = self._hidden.reset(options=next(filter(None, self._options), None))
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._clear_reset_arguments()
        return observation

    def step_wait(self) -> StepResult:
        observation, reward, terminated, truncated, ended = self._hidden.step(self._take_actions())
        infos: list[dict[str, Any]] = [
            {"TimeLimit.truncated": bool(cut)} for cut in truncated & ~terminated
        ]
        dones = terminated | truncated
        for lane in np.flatnonzero(dones).tolist():
            infos[lane]["terminal_observation"] = ended["final_obs"][lane]
        return observation, reward, dones, infos

    def close(self) -> None:
        self.instance.close()
