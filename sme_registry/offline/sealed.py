"""`train_sealed`: train BC or IQL on a sealed data set, whose task is hidden."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

from sme_registry.datasets import SealedDataset
from sme_registry.evaluation.networks import OfflinePolicy
from sme_registry.io import integer_in, require_packages
from sme_registry.offline.hyperparameters import ALGORITHMS, resolve_hyperparameters
from sme_registry.offline.train import MAX_STEPS
from sme_registry.training import known_algorithm


def train_sealed(
    data: SealedDataset | str | os.PathLike[str],
    *,
    algorithm: str = "iql",
    steps: int = 20_000,
    batch_size: int = 256,
    seed: int = 0,
    hyperparameters: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> OfflinePolicy:
    """Train BC or IQL on a sealed data set, on the CPU and one thread.

    The learners and arguments are those of `train_offline`. Nothing is evaluated: only the season's
    board can. `data` may be the path of its folder; the policy's `save` writes an .npz file.

    Examples:
      >>> from sme_registry.datasets import DatasetRecipe, SealedDataset
      >>> from sme_registry.offline import train_sealed
      >>> recipe = DatasetRecipe(
      ...     spec=sme_registry.load("Default"),
      ...     behaviours=[{"kind": "mixture", "nu": 0.5}],
      ...     transitions=100,
      ... )
      >>> data = SealedDataset.collect(recipe)
      >>> policy = train_sealed(data, algorithm="bc", steps=10, batch_size=32)
      >>> policy(data.observations[:2]).shape
      (2, 4)
    """
    algorithm = known_algorithm(algorithm, ALGORITHMS)
    settings = resolve_hyperparameters(algorithm, hyperparameters)
    steps = integer_in("steps", steps, 1, MAX_STEPS)
    seed = integer_in("seed", seed, 0, 2**53 - 1)
    require_packages("offline training", {"torch": "PyTorch"}, "offline")
    rows = data if isinstance(data, SealedDataset) else SealedDataset.read(data)
    batch_size = integer_in(
        "batch_size", batch_size, 1, len(rows), advice="The data set has no more rows."
    )
    from sme_registry.offline.learn import learn

    def report(done: int) -> None:
        if progress is not None:
            progress(done, steps)

    [end] = learn(settings, rows, batch_size, seed, [steps], report)
    about = {"algorithm": algorithm, "seed": seed, "steps": steps, "dataset_digest": rows.digest}
    return OfflinePolicy(end.layers, about)
