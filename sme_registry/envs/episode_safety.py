"""`EpisodeSafety`: what an episode cost, from the infos of its steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sme_registry.envs.types import Array
from sme_registry.spec import SMESpec

# Excess over the limits, summed over channels, up to which an action is safe: evaluation's
# tolerance of one channel or, where A > 16, what rounding to float32 can add to a safe action.
_TOLERANCE, _ROUNDING = 1e-6, 6e-8


class EpisodeSafety(NamedTuple):
    """Means over the steps of an episode of a task with `safety`.

    Attributes:
      cost: the mean cost, in [0, 1].
      violating_share: the share of steps whose action was above its limits by more than 10⁻⁶,
        summed over channels (6·10⁻⁸ A where A > 16), in [0, 1]. Infos have no action, so this is
        not evaluation's rule, by which one channel must be: it differs where several are above by
        less.
      safe_regret: mean step reward that the best safe action earns more, in [−1, 1]; negative
        where the agent earned by violating.
    """

    cost: float
    violating_share: float
    safe_regret: float


def safety_of_step(
    infos: Mapping[str, Any] | Sequence[Mapping[str, Any]], spec: Callable[[], SMESpec]
) -> Array | None:
    """The summands of `EpisodeSafety`, `[3, B]`, of a step of each lane; None without `safety`.

    Args:
      infos: of a vector environment, or of each lane.
      spec: gives that of the task; called where the infos have costs.
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
    safety, A = spec().safety, spec().action_dim
    assert safety is not None  # the infos have costs
    excess = cost * (2.0 * safety.tightness * A)
    return np.array([cost, excess > max(_TOLERANCE, _ROUNDING * A), safe_regret])
