"""Wrappers for your own training loop: the exact regret of each episode, in `info` and in a file.

    env = RecordRegret(gymnasium.make("SME/Default-v1"), "runs/mine/episodes.csv")
    envs = RecordVectorRegret(gymnasium.make_vec("SME/Default-v1", 8), "runs/mine/episodes.csv")

When an episode ends, `info["episode"]` has, as with Gymnasium's `RecordEpisodeStatistics`,

    r, l, t         return, number of steps, seconds since the wrapper was created
    regret          mean of 1 − r over the episode's steps, in [0, 1]; exact
    similarity      mean r̃ over them, in [0, 1]; exact
    online_regret   mean of 1 − r over all training steps so far, in [0, 1]

The file is that of `sme train`: `plots.training_curve` and `sme diagnose --log` read it.
"""

from __future__ import annotations

import os
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorWrapper

from sme_registry.envs.types import Array, Mask
from sme_registry.errors import OptionError
from sme_registry.io import refuse_existing
from sme_registry.training.episodes import Episode, EpisodeLog

__all__ = ["RecordRegret", "RecordVectorRegret"]

_Path = str | os.PathLike[str] | None


class _Recorder:
    """Sums over the present episode of each lane, and the finished episodes."""

    def __init__(self, lanes: int, path: _Path, force: bool) -> None:
        self.episodes: list[Episode] = []
        self._log: EpisodeLog | None = None
        if path is not None:
            path = refuse_existing(path, force=force)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._log = EpisodeLog(path)
        self._sums = np.zeros((4, lanes))  # return, length, regret, similarity
        self._steps, self._total_regret, self._start = 0, 0.0, time.monotonic()

    @property
    def online_regret(self) -> float:
        """Mean regret over all steps so far; NaN before the first."""
        return self._total_regret / self._steps if self._steps else float("nan")

    def begin(self, lanes: Any = slice(None)) -> None:
        """Forget the present episodes of some lanes."""
        self._sums[:, lanes] = 0.0

    def add(
        self, rewards: Array, regret: Array, similarity: Array, terminated: Mask, ended: Mask
    ) -> dict[str, Array]:
        """Add a step of each lane, `[B]` each; those whose regret is NaN began an episode instead.

        Returns:
          What `info["episode"]` has, `[B]` each, 0 where no episode ended; empty if none did.
        """
        stepped = ~np.isnan(regret)
        values = np.array([rewards, np.ones(len(regret)), regret, similarity])
        self._sums += np.where(stepped, values, 0.0)
        self._steps += int(stepped.sum())
        self._total_regret += float(regret[stepped].sum())
        lanes = np.flatnonzero(ended & stepped)
        if not len(lanes):
            return {}
        seconds = round(time.monotonic() - self._start, 3)
        for lane in lanes.tolist():
            self._finish(lane, bool(terminated[lane]), seconds)
        returns, lengths, *means = np.where(ended, self._sums, 0.0)
        regrets, similarities = (mean / np.maximum(lengths, 1.0) for mean in means)
        self.begin(lanes)
        return {
            "r": returns,
            "l": lengths.astype(np.int64),
            "t": np.where(ended, seconds, 0.0),
            "regret": regrets,
            "similarity": similarities,
            "online_regret": np.where(ended, self.online_regret, 0.0),
        }

    def _finish(self, lane: int, terminated: bool, seconds: float) -> None:
        episode_return, length, regret, similarity = self._sums[:, lane].tolist()
        episode = Episode(
            episode=len(self.episodes) + 1,
            step=self._steps,
            episode_return=episode_return,
            length=int(length),
            regret=regret / length,
            similarity=similarity / length,
            terminated=int(terminated),
            wall_seconds=seconds,
        )
        self.episodes.append(episode)
        if self._log is not None:
            self._log.add(episode)

    def close(self) -> None:
        """Close the file."""
        if self._log is not None:
            self._log.close()


class RecordRegret(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Records the exact regret of each episode of one environment; see the module.

    Args:
      env: an environment of this package, wrapped or not. `RecordEpisodeStatistics` goes inside;
        its entries of `info["episode"]` are kept.
      path: the file to write, such as `runs/mine/episodes.csv`, a row as soon as an episode ends;
        None writes none.
      force: replace an existing file.

    Raises:
      OptionError: the file exists and `force` is false, or it cannot be written; at the first step,
        if the environment's info has no regret.

    Attributes:
      episodes: the finished episodes, oldest first, as `plots.training_curve` takes them.
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
        self._recorder = _Recorder(1, path, force)
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
        values = (reward, *_measured(info))
        rewards, regret, similarity = (np.array([value], np.float64) for value in values)
        ended, by_failure = np.array([terminated or truncated]), np.array([terminated])
        episode = self._recorder.add(rewards, regret, similarity, by_failure, ended)
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


class RecordVectorRegret(VectorWrapper, RecordConstructorArgs):
    """Records the exact regret of each episode of a vector environment; see the module.

    Each entry of `info["episode"]` is `[num_envs]`, 0 where no episode ended; `info["_episode"]`
    is True where one did. All autoreset modes work.

    Args:
      env: a vector of environments of this package: `make_vec`, `SyncVectorEnv` or
        `AsyncVectorEnv`. `RecordEpisodeStatistics` goes inside.
      path: see `RecordRegret`.
      force: see `RecordRegret`.

    Raises:
      OptionError: see `RecordRegret`.

    Attributes:
      episodes: see `RecordRegret`.
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
        self._recorder = _Recorder(env.num_envs, path, force)
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
        regret, similarity = (np.array(value, np.float64) for value in _measured(info))
        if "final_info" in info:  # SAME_STEP: `info` is of the next episode where one ended
            final = info["_final_info"]
            last_regret, last_similarity = _measured(info["final_info"])
            regret[final], similarity[final] = last_regret[final], last_similarity[final]
        ended = terminated | truncated
        episode = self._recorder.add(rewards, regret, similarity, terminated, ended)
        if episode:
            info["episode"] = {**episode, **info.get("episode", {})}
            info["_episode"] = ended
        return observations, rewards, terminated, truncated, info

    def close(self, **kwargs: Any) -> None:
        """Close the file and the environment."""
        self._recorder.close()
        self.env.close(**kwargs)


def _measured(info: dict[str, Any]) -> tuple[Any, Any]:
    """Regret and similarity of a step; NaN in lanes that began an episode."""
    try:
        return info["regret"], info["similarity"]
    except KeyError as error:
        raise OptionError(
            f"RecordRegret: the environment's info has no {error}. Wrap an environment of "
            "sme_registry, with wrappers that keep its info."
        ) from None
