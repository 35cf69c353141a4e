"""`info`: the keys of every step and every reset, of a single environment and of a batch.

At a step the values are those of `SMEEnv`, float64 of NumPy, since some libraries ask for a dtype.
At a reset no action was taken: the same keys hold NaN, so that every info has one structure.
The info of a stream also has `phase` and `lifetime`, int64 of NumPy, which a reset has as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sme_registry.envs.arguments import from_unit
from sme_registry.envs.types import Array, Lanes, Mask

if TYPE_CHECKING:
    from sme_registry.envs.batch import BatchStep

NUMBERS = "similarity", "step_reward", "regret", "accumulated_reward"
"""The keys whose values are numbers; `optimal_action` `[A]` is the fifth."""

_NAN = np.float64(np.nan)


def at_reset(action_dim: int) -> dict[str, Any]:
    """The info of a reset: NaN for every key, `optimal_action` a fresh array `[A]`."""
    return {"optimal_action": np.full(action_dim, np.nan), **dict.fromkeys(NUMBERS, _NAN)}


def write_reset(
    info: dict[str, npt.NDArray[Any]], lanes: Lanes, life: Mapping[str, npt.NDArray[Any]]
) -> None:
    """Overwrite a batched info in the lanes that begin an episode; `life` is `Batch.life`'s."""
    for key in ("optimal_action", *NUMBERS):
        info[key][lanes] = np.nan
    for key, value in life.items():
        info[key][lanes] = value[lanes]


def batch_at_reset(lanes: int, action_dim: int) -> dict[str, Array]:
    """The info of `B` resets: fresh arrays of NaN, `optimal_action` `[B, A]`, others `[B]`."""
    numbers = {key: np.full(lanes, np.nan) for key in NUMBERS}
    return {"optimal_action": np.full((lanes, action_dim), np.nan), **numbers}


def of_life(phase: Any, lifetime: Any) -> dict[str, Any]:
    """What the info of a stream has besides: its phase, and the environment steps lived."""
    return {"phase": phase, "lifetime": lifetime}


def of_all_agents(step: BatchStep, lane: int, rescaled: bool) -> dict[str, Any]:
    """One lane's step as one agent's: the actions of all channels, the means over the agents."""
    similarity, step_reward, regret, _, accumulated = step.values[:, :, lane].mean(axis=1).tolist()
    return {
        "optimal_action": from_unit(step.optimal[lane], rescaled),
        "similarity": similarity,
        "step_reward": step_reward,
        "regret": regret,
        "accumulated_reward": accumulated,
    }


def masked(info: Mapping[str, npt.NDArray[Any]], mask: Mask | None = None) -> dict[str, Any]:
    """Gymnasium's form of batched info: each key with its mask `_key`; None is every lane.

    Copies arrays only where there is a mask, and writes 0 where it is False.
    """
    infos: dict[str, Any] = {}
    if mask is None:
        every_lane = np.ones(len(info["similarity"]), bool)
        for key, value in info.items():
            infos[key], infos[f"_{key}"] = value, every_lane
        return infos
    for key, value in info.items():
        columns = mask.reshape(-1, *[1] * (value.ndim - 1))
        infos[key], infos[f"_{key}"] = np.where(columns, value, value.dtype.type(0)), mask.copy()
    return infos
