"""Training: one algorithm on one task, with exact regret of every episode.

    from sme_registry.training import train
    result = train("SME/Default-v1", algorithm="SAC", steps=20_000, folder="runs/sac")
    result.report.wd_regret, result.episodes[-1].regret

Importing this module imports neither PyTorch nor JAX.
"""

from sme_registry.training.record import RunRecord as RunRecord
from sme_registry.training.record import model_of_cell as model_of_cell
from sme_registry.training.record import read_episodes as read_episodes
from sme_registry.training.run import TrainingResult, train

__all__ = [
    "TrainingResult",
    "train",
]
