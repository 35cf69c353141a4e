"""`SealedDataset`: what entrants of a season get of a data set, and nothing that tells its task.

Observations, actions, rewards and the ends of episodes, in Minari's HDF5 layout; its metadata have
only what Minari needs. `N` transitions, `O` = S + 2 entries of an observation, `A` action channels.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.arrays import digest_of
from sme_registry.datasets.collect import ReportProgress, collect
from sme_registry.datasets.minari_format import (
    DATA,
    Episode,
    hdf5_content,
    plain_metadata,
    read_visible,
    require_minari,
    truncations_of,
    visible_episode,
)
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.datasets.storage import check_id, write_minari
from sme_registry.envs.types import Array, Mask, Observation
from sme_registry.errors import MalformedDocumentError, NameTakenError
from sme_registry.task import materialize

_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class SealedDataset:
    """Aligned arrays; row i is one transition, and rows of an episode are contiguous and in order.

    Attributes:
      observations: `[N, O]` float32 in [0, 1], before the step.
      actions: `[N, A]` float32 in [0, 1].
      rewards: `[N]` float64 in [0, k].
      next_observations: `[N, O]` float32, after the step; also at the end of an episode.
      terminations: `[N]` bool: the episode ended by D. Do not bootstrap.
      truncations: `[N]` bool: the episode ended at the horizon, or the data set does. Bootstrap,
        unless the same row terminates.
    """

    observations: Observation
    actions: npt.NDArray[np.float32]
    rewards: Array
    next_observations: Observation
    terminations: Mask
    truncations: Mask

    @classmethod
    def collect(cls, recipe: DatasetRecipe, progress: ReportProgress | None = None) -> Self:
        """Generate the transitions of a recipe of mixtures."""
        rows = collect(recipe, materialize(recipe.spec), progress=progress)
        return cls(
            observations=rows.observations,
            actions=rows.actions,
            rewards=rows.rewards,
            next_observations=rows.next_observations,
            terminations=rows.terminations,
            truncations=truncations_of(rows, recipe.spec),
        )

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a data set's folder, which contains `data/`."""
        require_minari()
        file = Path(path) / "data" / DATA
        try:
            return cls(**read_visible(file))
        except (OSError, KeyError, ValueError, RuntimeError, MemoryError) as error:
            raise MalformedDocumentError(
                f"{file}: cannot be read: {str(error).strip(chr(39))}. Download the data set again."
            ) from None

    def __len__(self) -> int:
        return len(self.rewards)

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def digest(self) -> str:
        return digest_of(self.columns())

    def agrees_with(self, other: Self) -> bool:
        """Whether the other has the same transitions, up to what machines round differently.

        The same recipe gives rewards that differ by some 1e-14 where NumPy's linear algebra, or
        the back-end, is another one. Numbers may differ by 1e-6, the rounding of float32; the ends
        of episodes must be the same.
        """
        columns = other.columns()
        return all(
            mine.shape == columns[name].shape and np.allclose(mine, columns[name], 0, _ROUNDING)
            for name, mine in self.columns().items()
        )

    def write(self, dataset_id: str, folder: str | os.PathLike[str]) -> Path:
        """Write the data set in Minari's format, completely or not at all; returns its folder.

        `dataset_id` is Minari's, `[namespace/]name-v<number>`; `folder` the root of all data sets.
        """
        require_minari()
        root = Path(folder)
        target = root / check_id(dataset_id)
        if os.path.lexists(target):
            raise NameTakenError(
                f"{target} already exists and is not replaced. Remove it yourself."
            )
        episodes = list(self._episodes())
        content = hdf5_content(episodes)
        widths = self.observations.shape[1], self.actions.shape[1]
        metadata = plain_metadata(dataset_id, widths, len(episodes), len(self), len(content))
        write_minari(target, root, content, metadata, force=False)
        return target

    def _episodes(self) -> Iterator[Episode]:
        first = 0
        ends = np.flatnonzero(self.terminations | self.truncations) + 1
        for number, end in enumerate(ends.tolist()):
            rows = slice(first, end)
            yield visible_episode(
                number,
                self.observations[rows],
                self.next_observations[end - 1 : end],
                actions=self.actions[rows],
                rewards=self.rewards[rows],
                terminations=self.terminations[rows],
                truncations=self.truncations[rows],
            )
            first = end
