"""Types of the arrays that environments take and return. `B` environments of a batch."""

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
