"""`RecordVectorRegret`, for a vector of environments."""

from __future__ import annotations

import os
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from sme_registry.envs.episodes import safety_of_step
from sme_registry.spec import SMESpec
from sme_registry.wrappers.recorder import Recorder, measured


class RecordVectorRegret(VectorWrapper, RecordConstructorArgs):
    """Records the exact regret of each episode of a vector environment; see the package.

    Each entry of `info["episode"]` is `[num_envs]`, 0 where no episode ended; `info["_episode"]`
    is True where one did. All autoreset modes work.

    Args:
      env: a vector of environments of this package: `make_vec`, `SyncVectorEnv` or
        `AsyncVectorEnv`. `RecordEpisodeStatistics` goes inside.
      path: see `RecordRegret`.
      force: see `RecordRegret`.

    Attributes:
      episodes: see `RecordRegret`.

    Examples:
      >>> from sme_registry.wrappers import RecordVectorRegret
      >>> envs = RecordVectorRegret(sme_registry.make_vec("Default", 3, horizon=2))
      >>> observations, infos = envs.reset(seed=0)
      >>> steps = [envs.step(envs.action_space.sample()) for _ in range(2)]
      >>> steps[-1][-1]["episode"]["regret"].shape
      (3,)
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        path: str | os.PathLike[str] | None = None,
        *,
        force: bool = False,
    ) -> None:
        RecordConstructorArgs.__init__(self, path=None if path is None else str(path), force=force)
        VectorWrapper.__init__(self, env)
        self._recorder = Recorder(env.num_envs, path, force)
        self.episodes = self._recorder.episodes

    @property
    def online_regret(self) -> float:
        """Mean regret over all steps so far, in [0, 1]; NaN before the first."""
        return self._recorder.online_regret

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes; those that have not ended are not recorded."""
        mask = (options or {}).get("reset_mask")
        result = self.env.reset(seed=seed, options=options)
        self._recorder.begin(slice(None) if mask is None else np.asarray(mask, bool))
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One step of every lane."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        regret, similarity = (np.array(value, np.float64) for value in measured(info))
        safety = safety_of_step(info, lambda: self._sme_spec)
        if "final_info" in info:  # SAME_STEP: `info` is of the next episode where one ended
            final = info["_final_info"]
            last_regret, last_similarity = measured(info["final_info"])
            regret[final], similarity[final] = last_regret[final], last_similarity[final]
            last_safety = safety_of_step(info["final_info"], lambda: self._sme_spec)
            if safety is not None and last_safety is not None:
                safety[:, final] = last_safety[:, final]
        ended = terminated | truncated
        episode = self._recorder.add(rewards, regret, similarity, terminated, ended, safety)
        if episode:
            info["episode"] = {**episode, **info.get("episode", {})}
            info["_episode"] = ended
        return observations, rewards, terminated, truncated, info

    @cached_property
    def _sme_spec(self) -> SMESpec:
        vector: Any = self.unwrapped
        if hasattr(vector, "sme_spec"):
            spec: SMESpec = vector.sme_spec
        else:  # a vector of Gymnasium's
            spec = vector.get_attr("sme_spec")[0]
        return spec

    def close(self, **kwargs: Any) -> None:
        """Close the file and the environment."""
        self._recorder.close()
        self.env.close(**kwargs)
