"""Training: one algorithm of Stable-Baselines3 on one task, with exact regret of every episode.

    from sme_registry.training import train
    result = train("SME/Default-v1", algorithm="SAC", steps=20_000, folder="runs/sac")
    result.report.wd_regret, result.episodes[-1].regret

Importing this module does not import PyTorch.
"""

from sme_registry.training.algorithms import ALGORITHMS, default_algorithm, known_algorithm
from sme_registry.training.episodes import Episode, read_episodes
from sme_registry.training.numpy_policy import numpy_policy
from sme_registry.training.record import RunRecord
from sme_registry.training.run import TrainingResult, train

__all__ = [
    "ALGORITHMS",
    "Episode",
    "RunRecord",
    "TrainingResult",
    "default_algorithm",
    "known_algorithm",
    "numpy_policy",
    "read_episodes",
    "train",
]
