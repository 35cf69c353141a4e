"""`RecordRegret`, for one environment."""

from __future__ import annotations

import os
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sme_registry.envs.episodes import safety_of_step
from sme_registry.wrappers.recorder import Recorder, measured


class RecordRegret(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Records the exact regret of each episode of one environment; see the package.

    Args:
      env: an environment of this package, wrapped or not. `RecordEpisodeStatistics` goes inside;
        its entries of `info["episode"]` are kept.
      path: the file to write, such as `runs/mine/episodes.csv`, a row as soon as an episode ends;
        None writes none.
      force: replace an existing file.

    Attributes:
      episodes: the finished episodes, oldest first, as `plots.training_curve` takes them.

    Examples:
      >>> from sme_registry.wrappers import RecordRegret
      >>> env = RecordRegret(sme_registry.make("Default", horizon=2), "mine/episodes.csv")
      >>> observation, info = env.reset(seed=0)
      >>> steps = [env.step(env.action_space.sample()) for _ in range(2)]
      >>> bool(0 <= steps[-1][-1]["episode"]["regret"] <= 1)
      True
      >>> env.close()
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        path: str | os.PathLike[str] | None = None,
        *,
        force: bool = False,
    ) -> None:
        RecordConstructorArgs.__init__(self, path=None if path is None else str(path), force=force)
        gymnasium.Wrapper.__init__(self, env)
        self._recorder = Recorder(1, path, force)
        self.episodes = self._recorder.episodes

    @property
    def online_regret(self) -> float:
        """Mean regret over all steps so far, in [0, 1]; NaN before the first."""
        return self._recorder.online_regret

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; one that has not ended is not recorded."""
        self._recorder.begin()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One step; the last one of an episode has `info["episode"]`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        values = (reward, *measured(info))
        rewards, regret, similarity = (np.array([value], np.float64) for value in values)
        ended, by_failure = np.array([terminated or truncated]), np.array([terminated])
        inner: Any = self.unwrapped
        safety = safety_of_step([info], lambda: inner.sme_spec)
        episode = self._recorder.add(rewards, regret, similarity, by_failure, ended, safety)
        if episode:
            info["episode"] = {
                **{name: value[0].item() for name, value in episode.items()},
                **info.get("episode", {}),
            }
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Close the file and the environment."""
        self._recorder.close()
        self.env.close()
