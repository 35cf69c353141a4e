"""`RegretCallback`: the exact regret of every episode, in the log of a Stable-Baselines3 training.

callback = RegretCallback()
model.learn(20_000, callback=callback)     # rollout/regret, in TensorBoard and on the screen
plots.training_curve(callback.episodes, "regret.png")
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.callbacks import BaseCallback

from sme_registry.envs.episodes import EpisodeSafety, safety_of_step
from sme_registry.errors import OptionError
from sme_registry.spec import SMESpec


class EpisodeRegret(NamedTuple):
    """A finished episode; of a team, one episode of the whole team.

    Attributes:
      step: environment steps of the training over all environments when it ended; a step of a team
        is one step of all its agents.
      regret: mean of 1 − r over its steps, in [0, 1]; exact.
      similarity: mean r̃ over its steps, in [0, 1]; exact.
      episode_return: sum of its rewards. For a team, this, `regret` and `similarity` are means over
        its agents.
      length: number of steps.
      terminated: whether it ended by D; False if it reached the horizon.
      agents_regret: mean regret of each agent, in the team's order; empty for a single agent.
      safety: what it cost; None for a task without `safety`.
    """

    step: int
    regret: float
    similarity: float
    episode_return: float
    length: int
    terminated: bool
    agents_regret: tuple[float, ...] = ()
    safety: EpisodeSafety | None = None


class EpisodeSums:
    """Sums over the present episode of each lane.

    Args:
      lanes: of the environment; those of a team's agents are adjacent, and end together.
      agents: of each team; 1 for a single agent.
      spec: gives that of the task, at the first step of one with `safety`, which needs it.

    Examples:
      >>> from sme_registry.sb3 import EpisodeSums
      >>> sums = EpisodeSums(lanes=1)
      >>> info = {"regret": 0.25, "similarity": 0.9}
      >>> sums.add(1, np.array([0.75]), np.array([True]), [info])[0].regret
      0.25
    """

    def __init__(
        self, lanes: int, agents: int = 1, spec: Callable[[], SMESpec] | None = None
    ) -> None:
        self._agents = agents
        self._spec = cache(spec or _no_spec)
        self._sums = np.zeros((4, lanes))  # return, length, regret, similarity
        self._safety: npt.NDArray[np.float64] | None = None  # those of `EpisodeSafety`, if any

    def add(
        self,
        step: int,
        rewards: npt.NDArray[Any],
        dones: npt.NDArray[Any],
        infos: Sequence[dict[str, Any]],
    ) -> list[EpisodeRegret]:
        """Add one step of every lane; returns the episodes that ended in it.

        Args:
          step: environment steps taken, including this one.
          rewards: `[lanes]`.
          dones: `[lanes]`, whether an episode ended.
          infos: of each lane, as a `VecEnv` returns them.
        """
        try:
            self._sums[2] += [info["regret"] for info in infos]
            self._sums[3] += [info["similarity"] for info in infos]
        except KeyError as error:
            raise OptionError(
                f"RegretCallback: the environment's infos have no {error}. Use it with an "
                "environment of sme_registry, whose wrappers keep the infos."
            ) from None
        safety = safety_of_step(infos, self._spec)
        if safety is not None:
            self._safety = safety if self._safety is None else self._safety + safety
        self._sums[0] += rewards
        self._sums[1] += 1.0
        first_lanes = np.flatnonzero(dones[:: self._agents]) * self._agents
        return [self._finish(step, lane, infos[lane]) for lane in first_lanes.tolist()]

    def _finish(self, step: int, lane: int, info: dict[str, Any]) -> EpisodeRegret:
        lanes = slice(lane, lane + self._agents)
        returned, length, regret, similarity = self._sums[:, lanes].mean(axis=1).tolist()
        by_agent = self._sums[2, lanes] / length if self._agents > 1 else ()
        safety = None
        if self._safety is not None:  # of a single agent
            safety = EpisodeSafety(*(self._safety[:, lane] / length).tolist())
            self._safety[:, lane] = 0.0
        episode = EpisodeRegret(
            step=step,
            regret=regret / length,
            similarity=similarity / length,
            episode_return=returned,
            length=int(length),
            terminated=not info.get("TimeLimit.truncated", False),
            agents_regret=tuple(map(float, by_agent)),
            safety=safety,
        )
        self._sums[:, lanes] = 0.0
        return episode


def _no_spec() -> SMESpec:
    raise OptionError("EpisodeSums: the task has safety: give spec, such as lambda: env.sme_spec.")


class RegretCallback(BaseCallback):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Logs the exact regret of each finished episode: its mean over the episode, not its last step.

    Works with every `VecEnv` of our environments: `SMEVecEnv`, `SMETeamVecEnv`, and SB3's
    `DummyVecEnv` and `SubprocVecEnv` with or without `Monitor`. SB3's logger shows the mean over
    the episodes that ended since its last output, as `rollout/regret` and `rollout/similarity`;
    for a team also `rollout/regret/<agent>`, and for a task with `safety` also `rollout/cost`,
    `rollout/violating_share` and `rollout/safe_regret`.

    Attributes:
      episodes: the finished episodes, oldest first. `plots.training_curve` draws them.

    Examples:
      >>> from stable_baselines3 import PPO
      >>> from sme_registry.sb3 import RegretCallback, SMEVecEnv
      >>> callback = RegretCallback()
      >>> model = PPO("MlpPolicy", SMEVecEnv("Default"), n_steps=128, batch_size=64, n_epochs=1)
      >>> model = model.learn(128, callback=callback)
      >>> callback.episodes[0].step
      100
    """

    def __init__(self, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.episodes: list[EpisodeRegret] = []
        self._sums: EpisodeSums | None = None
        self._agents: Sequence[str] = ()

    @property
    def steps(self) -> int:
        """Environment steps over all environments; a step of a team is one of all its agents."""
        return int(self.model.num_timesteps) // max(1, len(self._agents))

    def _on_training_start(self) -> None:
        # A second `learn` without a reset continues the present episodes.
        if self._sums is None or self.locals.get("reset_num_timesteps", True):
            agents = getattr(self.training_env, "agents", ())
            self._agents = agents if len(agents) > 1 else ()
            self._sums = EpisodeSums(
                self.training_env.num_envs,
                max(1, len(self._agents)),
                lambda: self.training_env.get_attr("sme_spec")[0],
            )

    def _on_step(self) -> bool:
        assert self._sums is not None
        seen = self.locals
        finished = self._sums.add(self.steps, seen["rewards"], seen["dones"], seen["infos"])
        for episode in finished:
            self.episodes.append(episode)
            self.logger.record_mean("rollout/regret", episode.regret)
            self.logger.record_mean("rollout/similarity", episode.similarity)
            for agent, regret in zip(self._agents, episode.agents_regret, strict=True):
                self.logger.record_mean(f"rollout/regret/{agent}", regret)
            for name, value in episode.safety._asdict().items() if episode.safety else ():
                self.logger.record_mean(f"rollout/{name}", value)
        return True
