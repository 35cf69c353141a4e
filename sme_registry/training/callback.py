"""`RunCallback`: logs the exact regret of each episode, saves checkpoints and shows progress.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sme_registry.terminal.progress import Progress
from sme_registry.training.episodes import Episode, EpisodeLog

_RECENT = 20  # episodes in the running mean that the progress shows


class RunCallback(BaseCallback):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Logs finished episodes, saves checkpoints and updates the progress during SB3's training.

    SB3 counts one step for each agent of a team; here and in all files a step is one of the team.

    Args:
      log: of finished episodes.
      progress: of the training.
      save_checkpoint: called every `checkpoint_every` steps.
      checkpoint_every: steps.
      agents: names of a team's agents, whose lanes are adjacent; empty for a single agent.
    """

    def __init__(
        self,
        log: EpisodeLog,
        progress: Progress,
        save_checkpoint: Callable[[], None],
        checkpoint_every: int,
        agents: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self._log, self._progress, self._save_checkpoint = log, progress, save_checkpoint
        self._every = checkpoint_every
        self._agents = tuple(agents)
        self._lanes_each = max(1, len(self._agents))
        self._wall_before = log.episodes[-1].wall_seconds if log.episodes else 0.0
        self._start = time.monotonic()
        self._last_checkpoint = 0

    @property
    def wall_seconds(self) -> float:
        """Seconds of training over all sessions."""
        return self._wall_before + time.monotonic() - self._start

    @property
    def steps_done(self) -> int:
        """Environment steps of the whole run over all environments."""
        return int(self.num_timesteps) // self._lanes_each

    def _on_training_start(self) -> None:
        lanes = self.training_env.num_envs
        # return, length, sum of regret and sum of similarity of the current episode in each lane
        self._sums = np.zeros((4, lanes))
        self._last_checkpoint = self.steps_done
        self._start = time.monotonic()
        self._note = self._running_mean()

    def _on_rollout_start(self) -> None:
        # Between rollouts the model is consistent: it has learnt from all transitions, and they are
        # in its replay buffer. For off-policy algorithms that is after each environment step.
        if self.steps_done - self._last_checkpoint >= self._every:
            self._save_checkpoint()
            self._last_checkpoint = self.steps_done

    def _on_step(self) -> bool:
        infos, dones = self.locals["infos"], self.locals["dones"]
        self._sums[0] += self.locals["rewards"]
        self._sums[1] += 1.0
        self._sums[2] += [info["regret"] for info in infos]
        self._sums[3] += [info["similarity"] for info in infos]
        # The lanes of a team end together, so checking the first one is enough.
        for lane in np.flatnonzero(dones[:: self._lanes_each]) * self._lanes_each:
            self._log_episode(int(lane), int(not infos[lane]["TimeLimit.truncated"]))
        if dones.any():
            self._note = self._running_mean()
        self._progress.update(self.steps_done, self._note)
        return True

    def _log_episode(self, lane: int, terminated: int) -> None:
        """Log the episode that ended in this lane, or in a team's lanes from this one on."""
        lanes = slice(lane, lane + self._lanes_each)
        returned, length, regret, similarity = self._sums[:, lanes].mean(axis=1).tolist()
        regrets = (self._sums[2, lanes] / length).tolist() if self._agents else []
        self._sums[:, lanes] = 0.0
        self._log.add(
            Episode(
                episode=len(self._log.episodes) + 1,
                step=self.steps_done,
                episode_return=returned,
                length=int(length),
                regret=regret / length,
                similarity=similarity / length,
                terminated=terminated,
                wall_seconds=round(self.wall_seconds, 3),
                agents_regret=tuple(regrets),
            )
        )
        self.logger.record_mean("sme/regret", regret / length)
        self.logger.record_mean("sme/similarity", similarity / length)
        for agent, value in zip(self._agents, regrets, strict=True):
            self.logger.record_mean(f"sme/regret/{agent}", value)

    def _running_mean(self) -> str:
        recent = self._log.episodes[-_RECENT:]
        if not recent:
            return ""
        regret = np.mean([episode.regret for episode in recent])
        whose = "team's mean regret" if self._agents else "mean regret"
        return f"{whose} {regret:.3f} (last {len(recent)} episodes)"
