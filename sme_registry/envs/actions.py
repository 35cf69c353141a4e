"""Action ranges, and turning what a user passes into actions of the unit range.

"unit" is [0, 1], the paper's. "symmetric" is [−1, 1], rescaled by a = (u + 1)/2, what SB3 prefers.
The range changes learning, not the task: it belongs to a run's record, not to the task's digest.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from sme_registry.errors import ActionError, OptionError


def space(action_range: str, action_dim: int) -> tuple[gymnasium.spaces.Box, bool]:
    """The action space `[A]` of a range, and whether its actions must be rescaled.

    Raises:
      OptionError: not "unit" or "symmetric".
    """
    if action_range not in ("unit", "symmetric"):
        raise OptionError(f"action_range={action_range!r}: must be 'unit' or 'symmetric'.")
    low = 0.0 if action_range == "unit" else -1.0
    return gymnasium.spaces.Box(low, 1.0, (action_dim,), np.float32), low < 0.0


def checked(
    action: Any,
    shape: tuple[int, ...],
    rescaled: bool,
    ignored: npt.NDArray[np.bool_] | None = None,
) -> npt.NDArray[np.float64]:
    """Actions as contiguous float64 of the unit range, `shape`; zero in the rows to ignore.

    Whether they are finite is seen by the step itself, which reads each of them anyway.

    Raises:
      ActionError: not numbers, or of another shape.
    """
    try:
        array = np.asarray(action)
    except ValueError:
        raise ActionError(f"action={action!r:.80}: must be an array of shape {shape}.") from None
    if array.dtype.kind not in "fiu":
        raise ActionError(f"action={action!r:.80}: must be numbers, got dtype {array.dtype}.")
    if array.shape != shape:
        raise ActionError(f"action of shape {array.shape}: must be of shape {shape}.")
    array = np.array(array, dtype=np.float64, order="C")
    if ignored is not None:
        array[ignored] = 0.0
    return (array + 1.0) / 2.0 if rescaled else array


def not_finite() -> ActionError:
    """What to raise where a step refused its actions."""
    return ActionError("action: has NaN or infinite entries. Give finite numbers.")


def to_range(unit: npt.NDArray[Any], rescaled: bool) -> npt.NDArray[Any]:
    """Actions of the unit range in the environment's own."""
    return 2.0 * unit - 1.0 if rescaled else unit
