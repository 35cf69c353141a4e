"""What happens beside SB3's training loop: exact regret of each episode, checkpoints, progress.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sme_registry.training.episodes import Episode, EpisodeLog
from sme_registry.training.progress import Meter

_RECENT = 20  # episodes in the running mean that the progress shows


class RunCallback(BaseCallback):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Sums what the environment says of each step, and writes it down when an episode ends.

    Args:
      log: where episodes go.
      meter: what shows the progress.
      checkpoint: called with the steps done, every `checkpoint_every` steps.
      checkpoint_every: steps.
      wall_before: seconds of training in earlier sessions.
    """

    def __init__(
        self,
        log: EpisodeLog,
        meter: Meter,
        checkpoint: Callable[[int], None],
        checkpoint_every: int,
        wall_before: float,
    ) -> None:
        super().__init__()
        self._log, self._meter, self._checkpoint = log, meter, checkpoint
        self._every, self._wall_before = checkpoint_every, wall_before
        self._start = time.monotonic()
        self._last_checkpoint = 0

    @property
    def wall_seconds(self) -> float:
        """Seconds of training, over all sessions."""
        return self._wall_before + time.monotonic() - self._start

    def _on_training_start(self) -> None:
        lanes = self.training_env.num_envs
        # return, length, sum of regret, sum of similarity; the episode under way in each lane
        self._sums = np.zeros((4, lanes))
        self._last_checkpoint = self.num_timesteps
        self._start = time.monotonic()
        self._note = self._running_mean()

    def _on_rollout_start(self) -> None:
        # Between rollouts the model is consistent: all it has seen is learnt from and in its
        # replay buffer. For off-policy algorithms that is after each step of the environment.
        if self.num_timesteps - self._last_checkpoint >= self._every:
            self._checkpoint(self.num_timesteps)
            self._last_checkpoint = self.num_timesteps

    def _on_step(self) -> bool:
        infos, dones = self.locals["infos"], self.locals["dones"]
        self._sums[0] += self.locals["rewards"]
        self._sums[1] += 1.0
        self._sums[2] += [info["regret"] for info in infos]
        self._sums[3] += [info["similarity"] for info in infos]
        for lane in np.flatnonzero(dones):
            returned, length, regret, similarity = self._sums[:, lane].tolist()
            self._sums[:, lane] = 0.0
            self._log.add(
                Episode(
                    episode=len(self._log.episodes) + 1,
                    step=self.num_timesteps,
                    episode_return=returned,
                    length=int(length),
                    mean_regret=regret / length,
                    mean_similarity=similarity / length,
                    terminated=int(not infos[lane]["TimeLimit.truncated"]),
                    wall_seconds=round(self.wall_seconds, 3),
                )
            )
            self.logger.record_mean("sme/mean_regret", regret / length)
            self.logger.record_mean("sme/mean_similarity", similarity / length)
        if dones.any():
            self._note = self._running_mean()
        self._meter.update(self.num_timesteps, self._note)
        return True

    def _running_mean(self) -> str:
        recent = self._log.episodes[-_RECENT:]
        if not recent:
            return ""
        regret = np.mean([episode.mean_regret for episode in recent])
        return f"mean regret {regret:.3f} (last {len(recent)} episodes)"
