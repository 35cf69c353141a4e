"""Data sets for offline RL, of a chosen quality, with the exact regret of every transition.

    from sme_registry.datasets import make_dataset, train_offline
    dataset = make_dataset("SME/Default-v1", nu=0.5, transitions=50_000)
    result = train_offline(dataset, algorithm="iql", folder="runs/iql")
    result.record.improvement, result.report.ood_regret

Importing this module does not import PyTorch.
"""

from sme_registry.datasets.collect import collect
from sme_registry.datasets.documents import BCHyperparameters, DatasetRecipe, IQLHyperparameters
from sme_registry.datasets.offline import train_offline, train_sealed
from sme_registry.datasets.storage import (
    Dataset,
    SealedDataset,
    list_datasets,
    make_dataset,
    open_dataset,
)
from sme_registry.datasets.transitions import (
    Transitions,
    exact_return,
    positions,
    replay,
    to_d3rlpy,
)
from sme_registry.evaluation import OfflinePolicy

__all__ = [
    "BCHyperparameters",
    "Dataset",
    "DatasetRecipe",
    "IQLHyperparameters",
    "OfflinePolicy",
    "SealedDataset",
    "Transitions",
    "collect",
    "exact_return",
    "list_datasets",
    "make_dataset",
    "open_dataset",
    "positions",
    "replay",
    "to_d3rlpy",
    "train_offline",
    "train_sealed",
]
