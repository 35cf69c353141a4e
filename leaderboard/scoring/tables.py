"""What needs no learning: a table of states, of which the nearest ones answer.

With few state channels such a table fills the cube, however deep the optimum is. A season of such
a class ranks those who fill it.
"""

from __future__ import annotations

import numpy as np

from sme_registry import SMESpec, materialize
from sme_registry.spec import Setting

EASY = 0.1
"""Below it a table leaves little to learn."""

MOST_ROWS = 10_000
_NEIGHBOURS = (1, 8)
_SEEDS = (0, 1)  # public: nothing is measured on hidden tasks
_QUESTIONS = 300


def table_regret(setting: Setting, rows: int) -> float:
    """The normalised regret N₀ within the cube of a table of random states and their optima.

    Args:
      setting: of a class.
      rows: size of the data set, or steps of the budget; at most `MOST_ROWS` are taken.

    Returns:
      The mean over public tasks of this setting, of the better of the nearest state's optimum and
      the mean of the eight nearest ones. Labels are exact, so data with noise do worse.
    """
    return float(np.mean([_regret(setting, rows, seed) for seed in _SEEDS]))


def _regret(setting: Setting, rows: int, seed: int) -> float:
    from scipy.spatial import cKDTree

    task = materialize(SMESpec.from_dict({**setting.to_dict(), "seed": seed}))
    random = np.random.default_rng(seed)
    states = random.random((min(rows, MOST_ROWS), setting.state_dim))
    asked = random.random((_QUESTIONS, setting.state_dim))
    labels, optimum = task.optimal_action(states), task.optimal_action(asked)
    tree = cKDTree(states)
    errors = []
    for count in _NEIGHBOURS:
        _, nearest = tree.query(asked, range(1, min(count, len(states)) + 1))
        errors.append(np.abs(labels[nearest].mean(axis=1) - optimum).mean())
    return float(min(errors) / np.abs(0.5 - optimum).mean())
