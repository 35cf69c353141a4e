"""The actions that the checks take, and the length of their episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

MAX_STEPS = 250  # of one episode: horizons may be long
LONGEST_HORIZON = 10_000  # that the optimal policy is followed to
INFO_KEYS = {"optimal_action", "similarity", "step_reward", "regret", "accumulated_reward"}


def mixed_actions(optimal: npt.NDArray[Any], rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Actions of the unit range between optimal and random ones, some slightly outside of it."""
    shape = optimal.shape
    share = rng.uniform(0.0, 0.5, (*shape[:-1], 1))
    mixed: npt.NDArray[np.float64] = (1 - share) * optimal + share * rng.uniform(-0.1, 1.1, shape)
    return mixed.astype(np.float32)
