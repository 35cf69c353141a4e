"""The arrays of environments: their types, and where a step's numbers are in them.

`values` `[5, n, B]` is what one step of a batch computes for n agents in B environments; with
`safety` there are two more rows. A single environment is one buffer: t, the five values of its last
step, of which it keeps r_cum, and the state s `[S]`. With `safety` or `observation` there are more
numbers behind them: two values of its last step, and its own distractors.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
"""States, joint actions of the unit range, rewards."""

Observation: TypeAlias = npt.NDArray[np.float32]
"""Observations, each entry in [0, 1]."""

Action: TypeAlias = npt.NDArray[np.floating[Any]]
"""Actions of an agent, in its environment's range."""

Mask: TypeAlias = npt.NDArray[np.bool_]
"""`[B]` which environments."""

Indices: TypeAlias = npt.NDArray[np.int64]
"""Indices of environments, or a count for each of them."""

SIMILARITY, STEP_REWARD, REGRET, REWARD, ACCUMULATED_REWARD = range(5)
ROWS = 5
COST, SAFE_REGRET = 5, 6
ROWS_WITH_SAFETY = 7

LANE_T, LANE_VALUES, LANE_STATE = 0, 1, 1 + ROWS
"""The first entry of each part of a single environment."""

HAS_MORE = 4.0
"""Added to the end of a single step of a task with `safety` or `observation`."""

OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS = range(3)
"""Of its distractors: the key of their random numbers, how many it has drawn, and d `[m]`."""

MORE_COST, MORE_SAFE_REGRET, MORE_OWN = range(3)
"""The first entry of each part behind the plain numbers of a single environment."""
