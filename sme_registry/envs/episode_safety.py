"""`EpisodeSafety`: what an episode cost, from the infos of its steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sme_registry.envs.types import Array

_ROUNDING = 1e-6  # a cost below it is that of a safe action, rounded to float32


class EpisodeSafety(NamedTuple):
    """Means over the steps of an episode of a task with `safety`.

    Attributes:
      cost: the mean cost, in [0, 1].
      violating_share: the share of steps whose action was above a limit, in [0, 1].
      safe_regret: mean step reward that the best safe action earns more, in [−1, 1]; negative
        where the agent earned by violating.
    """

    cost: float
    violating_share: float
    safe_regret: float


def safety_of_step(infos: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> Array | None:
    """The summands of `EpisodeSafety`, `[3, B]`, of a step of each lane; None without `safety`.

    Args:
      infos: of a vector environment, or of each lane.
    """
    if isinstance(infos, Mapping):
        columns = [infos[key] for key in ("cost", "safe_regret")] if "cost" in infos else None
    elif "cost" in infos[0]:
        columns = [[info[key] for info in infos] for key in ("cost", "safe_regret")]
    else:
        columns = None
    if columns is None:
        return None
    cost, safe_regret = np.array(columns, np.float64).reshape(2, -1)
    return np.array([cost, cost > _ROUNDING, safe_regret])
