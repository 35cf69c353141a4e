"""The arrays of environments: their types, and where a step's numbers are in them.

`values` `[5, n, B]` is what one step of a batch computes for n agents in B environments; with
`safety` there are two more rows. A single environment is one buffer: t, the seven values of its
last step, of which it keeps r_cum, the state s `[S]`, and its own distractors `[2 + m]`.
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

SIMILARITY, STEP_REWARD, REGRET, REWARD, ACCUMULATED_REWARD, COST, SAFE_REGRET = range(7)
ROWS, ROWS_WITH_SAFETY = 5, 7

BUFFER_T, BUFFER_VALUES, BUFFER_STATE = 0, 1, 1 + ROWS_WITH_SAFETY
"""The first entry of each part of a single environment."""

OWN_KEY, OWN_DRAWN, OWN_DISTRACTORS = range(3)
"""Of its distractors: the key of their random numbers, how many it has drawn, and d `[m]`."""
