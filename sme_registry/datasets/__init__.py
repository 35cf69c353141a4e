"""Data sets for offline RL, of a chosen quality, with the exact regret of every transition.

    from sme_registry.datasets import make_dataset, train_offline
    dataset = make_dataset("SME/Default-v1", nu=0.5, transitions=50_000)
    result = train_offline(dataset, algorithm="iql", folder="runs/iql")
    result.record.improvement, result.report.ood_regret

Importing this module does not import PyTorch.
"""

from sme_registry.datasets.collect import collect
from sme_registry.datasets.documents import DatasetRecipe
from sme_registry.datasets.offline import train_offline
from sme_registry.datasets.storage import (
    Dataset,
    SealedDataset,
    make_dataset,
    open_dataset,
)
from sme_registry.datasets.transitions import (
    Transitions,
    positions,
    replay,
    to_d3rlpy,
)
from sme_registry.evaluation.networks import OfflinePolicy

__all__ = [
    "Dataset",
    "DatasetRecipe",
    "OfflinePolicy",
    "SealedDataset",
    "Transitions",
    "collect",
    "make_dataset",
    "open_dataset",
    "positions",
    "replay",
    "to_d3rlpy",
    "train_offline",
]
