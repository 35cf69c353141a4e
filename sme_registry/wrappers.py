"""Wrappers for your own training loop: exact regret in `info` and in a file; costs from `step`.

    env = RecordRegret(gymnasium.make("SME/Default-v1"), "runs/mine/episodes.csv")
    envs = RecordVectorRegret(gymnasium.make_vec("SME/Default-v1", 8), "runs/mine/episodes.csv")

When an episode ends, `info["episode"]` has, as with Gymnasium's `RecordEpisodeStatistics`,

    r, l, t         return, number of steps, seconds since the wrapper was created
    regret          mean of 1 − r over the episode's steps, in [0, 1]; exact
    similarity      mean r̃ over them, in [0, 1]; exact
    online_regret   mean of 1 − r over all training steps so far, in [0, 1]

and for a task with safety `cost`, `violating_share` and `safe_regret` (`EpisodeSafety`).

The file is that of `sme train`: `plots.training_curve` and `sme diagnose --log` read it.

    env = StepWithCost(sme_registry.make("Safety20"))
    observation, reward, cost, terminated, truncated, info = env.step(action)

is the interface of Safety-Gymnasium, which OmniSafe and SafePO expect. FSRL and our own algorithms
read `info["cost"]` and need no wrapper.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv

from sme_registry.envs.arguments import check_has_limits
from sme_registry.envs.episodes import Episodes, info_of_envs
from sme_registry.errors import OptionError
from sme_registry.io import check_new
from sme_registry.spec import SMESpec
from sme_registry.training.record import EpisodeLog

try:
    from gymnasium.vector import VectorWrapper
except ImportError:  # Gymnasium 0.29, which CleanRL needs, has no wrappers of vectors
    VectorWrapper = object  # type: ignore[assignment, misc]

__all__ = ["RecordRegret", "RecordVectorRegret", "StepWithCost", "VectorStepWithCost"]

Path = str | os.PathLike[str] | None


class _Recorder(Episodes):
    """The episodes of an environment or a vector, and their file."""

    def __init__(self, lanes: int, spec: Callable[[], SMESpec], path: Path, force: bool) -> None:
        super().__init__(lanes, spec=spec)
        self._log: EpisodeLog | None = None
        if path is not None:
            path = check_new(path, force=force)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._log = EpisodeLog(path)

    def record(self, *step: Any) -> list[dict[str, float]]:
        """`add` a step; returns what `info["episode"]` has of each episode that ended in it."""
        statistics = []
        for episode in self.add(*step):
            if self._log is not None:
                self._log.add(episode)
            safety = episode.safety._asdict() if episode.safety is not None else {}
            statistics.append(
                {
                    "r": episode.episode_return,
                    "l": episode.length,
                    "t": episode.wall_seconds,
                    "regret": episode.regret,
                    "similarity": episode.similarity,
                    "online_regret": self.online_regret,
                    **safety,
                }
            )
        return statistics

    def close(self) -> None:
        if self._log is not None:
            self._log.close()


class RecordRegret(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Records the exact regret of each episode of one environment; see the module.

    `RecordEpisodeStatistics` goes inside; its entries of `info["episode"]` are kept. The file gets
    a row as soon as an episode ends; one that exists is replaced only with `force`.

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
        self, env: gymnasium.Env[Any, Any], path: Path = None, *, force: bool = False
    ) -> None:
        RecordConstructorArgs.__init__(self, path=None if path is None else str(path), force=force)
        gymnasium.Wrapper.__init__(self, env)
        inner: Any = self.unwrapped
        self._recorder = _Recorder(1, lambda: inner.sme_spec, path, force)
        self.episodes = self._recorder.finished

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
        ended = terminated or truncated
        for statistics in self._recorder.record(reward, info, terminated, ended):
            info["episode"] = {**statistics, **info.get("episode", {})}
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        self._recorder.close()
        self.env.close()


class RecordVectorRegret(VectorWrapper):
    """Records the exact regret of each episode of a vector environment; see the module.

    Each entry of `info["episode"]` is `[num_envs]`, 0 where no episode ended; `info["_episode"]`
    is True where one did. Takes a vector of `make_vec`, or Gymnasium's `SyncVectorEnv` or
    `AsyncVectorEnv`, in any autoreset mode; the rest is as in `RecordRegret`.

    Examples:
      >>> from sme_registry.wrappers import RecordVectorRegret
      >>> envs = RecordVectorRegret(sme_registry.make_vec("Default", 3, horizon=2))
      >>> observations, infos = envs.reset(seed=0)
      >>> steps = [envs.step(envs.action_space.sample()) for _ in range(2)]
      >>> steps[-1][-1]["episode"]["regret"].shape
      (3,)
    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], path: Path = None, *, force: bool = False
    ) -> None:
        super().__init__(env)
        self._recorder = _Recorder(env.num_envs, self._sme_spec, path, force)
        self.episodes = self._recorder.finished
        mode = env.metadata.get("autoreset_mode", "NextStep")
        self._next_step = getattr(mode, "value", mode) == "NextStep"
        self._resting = np.zeros(env.num_envs, bool)  # their next step begins an episode

    @property
    def online_regret(self) -> float:
        return self._recorder.online_regret

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes; those that have not ended are not recorded."""
        mask = (options or {}).get("reset_mask")
        result = self.env.reset(seed=seed, options=options)
        envs = slice(None) if mask is None else np.asarray(mask, bool)
        self._recorder.begin(envs)
        self._resting[envs] = False
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        numbers = _numbers(info)
        if "final_info" in info:  # SAME_STEP: `info` is of the next episode where one ended
            final = info["_final_info"]
            for key, last in _numbers(info["final_info"]).items():
                numbers[key][final] = last[final]
        ended, episode = terminated | truncated, {}
        statistics = self._recorder.record(rewards, numbers, terminated, ended, ~self._resting)
        if self._next_step:
            self._resting = ended
        if statistics:
            for key in statistics[0]:
                column = np.array([one[key] for one in statistics])
                episode[key] = np.zeros(len(ended), column.dtype)
                episode[key][ended] = column
            info["episode"] = {**episode, **info.get("episode", {})}
            info["_episode"] = ended
        return observations, rewards, terminated, truncated, info

    def _sme_spec(self) -> SMESpec:
        vector: Any = self.unwrapped
        spec: SMESpec = getattr(vector, "sme_spec", None) or vector.get_attr("sme_spec")[0]
        return spec

    def close(self, **kwargs: Any) -> None:
        self._recorder.close()
        self.env.close(**kwargs)


def _numbers(info: Mapping[str, Any]) -> dict[str, Any]:
    return {key: np.array(column, float)[0] for key, column in info_of_envs([info]).items()}


class StepWithCost(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """One environment with the cost of a step as the third value that `step` returns.

    The task must have `safety`. It is the outermost wrapper: Gymnasium's own expect five values.

    Examples:
      >>> from sme_registry.wrappers import StepWithCost
      >>> env = StepWithCost(sme_registry.make("Safety20"))
      >>> observation, info = env.reset(seed=0)
      >>> action = env.action_space.sample()
      >>> observation, reward, cost, terminated, truncated, info = env.step(action)
      >>> bool(cost == info["cost"])
      True
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        _check_limits(self, env)

    def step(  # type: ignore[override]
        self, action: Any
    ) -> tuple[Any, Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, float(info["cost"]), terminated, truncated, info


class VectorStepWithCost(VectorWrapper):
    """A vector with the costs `[num_envs]` of a step as the third value that `step` returns.

    The task must have `safety`. All autoreset modes work; Safety-Gymnasium's vectors are in
    `SAME_STEP` mode.

    Examples:
      >>> from sme_registry.wrappers import VectorStepWithCost
      >>> envs = VectorStepWithCost(sme_registry.make_vec("Safety20", 3))
      >>> observations, infos = envs.reset(seed=0)
      >>> envs.step(envs.action_space.sample())[2].shape
      (3,)
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(envs)
        _check_limits(self, envs)

    def step(  # type: ignore[override]
        self, actions: Any
    ) -> tuple[Any, Any, Any, Any, Any, dict[str, Any]]:
        """Observations, rewards, costs, whether terminated, whether truncated, infos.

        A cost is 0 where the step began an episode. In `SAME_STEP` mode costs are those of the last
        step, and last observations are also under Safety-Gymnasium's name, `final_observation`.
        """
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        costs = np.array(info["cost"], np.float64)
        if "final_info" in info:
            ended = info["_final_info"]
            costs[ended] = info["final_info"]["cost"][ended]
            info["final_observation"] = info["final_obs"]
            info["_final_observation"] = info["_final_obs"]
        return observations, rewards, costs, terminated, truncated, info


def _check_limits(wrapper: Any, env: Any) -> None:
    name, spec = type(wrapper).__name__, getattr(env.unwrapped, "sme_spec", None)
    if spec is None:
        raise OptionError(
            f"{name}: {env!r:.80} has no `sme_spec`. Wrap an environment of sme_registry.make, "
            "or a vector of sme_registry.make_vec."
        )
    check_has_limits(name, spec)
