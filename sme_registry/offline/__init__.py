"""Offline learners: BC and IQL in PyTorch, evaluated in the task of their data set.

    from sme_registry.offline import train_offline
    result = train_offline("sme/Default-v1-nu50-seed7-v0", algorithm="iql", folder="runs/iql")
    result.record.improvement, result.report.ood_regret

Importing this module does not import PyTorch.
"""

from sme_registry.evaluation import OfflinePolicy
from sme_registry.offline.hyperparameters import ALGORITHMS, BCHyperparameters, IQLHyperparameters
from sme_registry.offline.record import BehaviourQuality, Evaluation, OfflineRecord
from sme_registry.offline.sealed import train_sealed
from sme_registry.offline.train import OfflineResult, train_offline

__all__ = [
    "ALGORITHMS",
    "BCHyperparameters",
    "BehaviourQuality",
    "Evaluation",
    "IQLHyperparameters",
    "OfflinePolicy",
    "OfflineRecord",
    "OfflineResult",
    "train_offline",
    "train_sealed",
]
