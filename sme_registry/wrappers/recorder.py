"""What both wrappers do: sums over the episodes of each lane, and the file of finished ones."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from sme_registry.envs.episodes import EpisodeSafety
from sme_registry.envs.types import Array, Mask
from sme_registry.errors import OptionError
from sme_registry.io import refuse_existing
from sme_registry.training.episodes import Episode, EpisodeLog

Path = str | os.PathLike[str] | None


class Recorder:
    """Sums over the present episode of each lane, and the finished episodes."""

    def __init__(self, lanes: int, path: Path, force: bool) -> None:
        self.episodes: list[Episode] = []
        self._log: EpisodeLog | None = None
        if path is not None:
            path = refuse_existing(path, force=force)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._log = EpisodeLog(path)
        self._sums = np.zeros((4, lanes))  # return, length, regret, similarity
        self._safety = np.zeros((len(EpisodeSafety._fields), lanes))
        self._steps, self._total_regret, self._start = 0, 0.0, time.monotonic()

    @property
    def online_regret(self) -> float:
        """Mean regret over all steps so far; NaN before the first."""
        return self._total_regret / self._steps if self._steps else float("nan")

    def begin(self, lanes: Any = slice(None)) -> None:
        """Forget the present episodes of some lanes."""
        self._sums[:, lanes] = self._safety[:, lanes] = 0.0

    def add(
        self,
        rewards: Array,
        regret: Array,
        similarity: Array,
        terminated: Mask,
        ended: Mask,
        safety: Array | None = None,
    ) -> dict[str, Array]:
        """Add a step of each lane, `[B]` each, and get `info["episode"]`; NaN regret begins one."""
        stepped = ~np.isnan(regret)
        values = np.array([rewards, np.ones(len(regret)), regret, similarity])
        self._sums += np.where(stepped, values, 0.0)
        if safety is not None:
            self._safety += np.where(stepped, safety, 0.0)
        self._steps += int(stepped.sum())
        self._total_regret += float(regret[stepped].sum())
        lanes = np.flatnonzero(ended & stepped)
        if not len(lanes):
            return {}
        seconds = round(time.monotonic() - self._start, 3)
        for lane in lanes.tolist():
            self._finish(lane, bool(terminated[lane]), seconds, safety is not None)
        returns, lengths, *means = np.where(ended, self._sums, 0.0)
        if safety is not None:
            means += [*np.where(ended, self._safety, 0.0)]
        regrets, similarities, *costs = (mean / np.maximum(lengths, 1.0) for mean in means)
        self.begin(lanes)
        return {
            "r": returns,
            "l": lengths.astype(np.int64),
            "t": np.where(ended, seconds, 0.0),
            "regret": regrets,
            "similarity": similarities,
            "online_regret": np.where(ended, self.online_regret, 0.0),
            **dict(zip(EpisodeSafety._fields, costs, strict=False)),
        }

    def _finish(self, lane: int, terminated: bool, seconds: float, has_safety: bool) -> None:
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
            safety=EpisodeSafety(*(self._safety[:, lane] / length).tolist())
            if has_safety
            else None,
        )
        self.episodes.append(episode)
        if self._log is not None:
            self._log.add(episode)

    def close(self) -> None:
        """Close the file."""
        if self._log is not None:
            self._log.close()


def measured(info: dict[str, Any]) -> tuple[Any, Any]:
    """Regret and similarity of a step; NaN in lanes that began an episode."""
    try:
        return info["regret"], info["similarity"]
    except KeyError as error:
        raise OptionError(
            f"RecordRegret: the environment's info has no {error}. Wrap an environment of "
            "sme_registry, with wrappers that keep its info."
        ) from None
