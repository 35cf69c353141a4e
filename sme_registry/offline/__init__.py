"""Offline learners: BC and IQL in PyTorch, trained on a data set and judged in its known task."""

from sme_registry.evaluation import OfflinePolicy
from sme_registry.offline.hyperparameters import ALGORITHMS, BCHyperparameters, IQLHyperparameters
from sme_registry.offline.train import OfflineRecord, OfflineResult, train_offline

__all__ = [
    "ALGORITHMS",
    "BCHyperparameters",
    "IQLHyperparameters",
    "OfflinePolicy",
    "OfflineRecord",
    "OfflineResult",
    "train_offline",
]
