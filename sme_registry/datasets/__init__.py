"""Data sets for offline RL, of a chosen quality, with the exact regret of every transition.

from sme_registry.datasets import make_dataset, to_d3rlpy
dataset = make_dataset("SME/Default-v1", nu=0.5, transitions=50_000)
arrays = to_d3rlpy(dataset.transitions())
"""

from sme_registry.datasets.arrays import Transitions, to_d3rlpy
from sme_registry.datasets.collect import collect
from sme_registry.datasets.make import make_dataset
from sme_registry.datasets.recipe import Behaviour, DatasetRecipe
from sme_registry.datasets.record import DatasetRecord
from sme_registry.datasets.replay import replay
from sme_registry.datasets.returns import ExactReturn, exact_return, positions
from sme_registry.datasets.sealed import SealedDataset
from sme_registry.datasets.storage import (
    Dataset,
    check_location,
    datasets_folder,
    list_datasets,
    open_dataset,
)

__all__ = [
    "Behaviour",
    "Dataset",
    "DatasetRecipe",
    "DatasetRecord",
    "ExactReturn",
    "SealedDataset",
    "Transitions",
    "check_location",
    "collect",
    "datasets_folder",
    "exact_return",
    "list_datasets",
    "make_dataset",
    "open_dataset",
    "positions",
    "replay",
    "to_d3rlpy",
]
