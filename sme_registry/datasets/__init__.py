"""Data sets for offline RL: of a chosen quality, with the exact regret of every transition."""

from sme_registry.datasets.arrays import Transitions, to_d3rlpy
from sme_registry.datasets.ground_truth import ExactReturn, exact_return, positions
from sme_registry.datasets.make import make_dataset
from sme_registry.datasets.minari_file import Dataset, DatasetRecord, list_datasets, open_dataset
from sme_registry.datasets.recipe import Behaviour, DatasetRecipe
from sme_registry.datasets.replay import replay

__all__ = [
    "Behaviour",
    "Dataset",
    "DatasetRecipe",
    "DatasetRecord",
    "ExactReturn",
    "Transitions",
    "exact_return",
    "list_datasets",
    "make_dataset",
    "open_dataset",
    "positions",
    "replay",
    "to_d3rlpy",
]
