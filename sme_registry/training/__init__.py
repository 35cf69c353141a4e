"""Training: one algorithm of Stable-Baselines3 on one task, with exact regret of every episode."""

from sme_registry.training.algorithms import ALGORITHMS, default_algorithm, known_algorithm
from sme_registry.training.record import RunRecord
from sme_registry.training.run import TrainingResult, train

__all__ = [
    "ALGORITHMS",
    "RunRecord",
    "TrainingResult",
    "default_algorithm",
    "known_algorithm",
    "train",
]
