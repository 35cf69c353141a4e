"""`info`: the keys of every step and every reset, of a single environment and of a batch.

At a step the values are those of `SMEEnv`, float64 of NumPy, since some libraries ask for a dtype.
With `safety` there are four more: `cost`, `limit`, `safe_action` and `safe_regret`.
At a reset no action was taken: the same keys hold NaN, so that every info has one structure.
The info of a stream also has `phase` and `lifetime`, int64 of NumPy, which a reset has as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sme_registry.compiled.arrays import (
    ACCUMULATED_REWARD,
    COST,
    REGRET,
    SAFE_REGRET,
    SIMILARITY,
    STEP_REWARD,
    Array,
    Indices,
    Mask,
)
from sme_registry.envs.arguments import from_unit
from sme_registry.spec import SMESpec

if TYPE_CHECKING:
    from sme_registry.envs.batch import BatchStep

NUMBERS = {
    "similarity": SIMILARITY,
    "step_reward": STEP_REWARD,
    "regret": REGRET,
    "accumulated_reward": ACCUMULATED_REWARD,
}
"""The keys whose values are numbers, and the row of a batch's `values` that each is."""

SAFETY_NUMBERS = {"cost": COST, "safe_regret": SAFE_REGRET}
"""Those that a task with `safety` has besides."""

SAFETY_ACTIONS = "limit", "safe_action"
"""Likewise, the keys whose values are `[A]`: the rows of `BatchStep.limits`."""

_ACTIONS = ("optimal_action",)
_NAN = np.float64(np.nan)


def numbers(spec: SMESpec) -> dict[str, int]:
    """The keys of a spec's infos whose values are numbers, and their rows in `values`."""
    return NUMBERS if spec.safety is None else NUMBERS | SAFETY_NUMBERS


def actions(spec: SMESpec) -> tuple[str, ...]:
    """The keys whose values are `[A]`, in the environment's action range."""
    return _ACTIONS if spec.safety is None else _ACTIONS + SAFETY_ACTIONS


def at_reset(spec: SMESpec, action_dim: int | None = None) -> dict[str, Any]:
    """The info of a reset: NaN for every key, those of actions as fresh arrays `[A]`.

    An agent of a team has `action_dim` channels of its own.
    """
    width = spec.action_dim if action_dim is None else action_dim
    arrays = {key: np.full(width, np.nan) for key in actions(spec)}
    return {**arrays, **dict.fromkeys(numbers(spec), _NAN)}


def batch_at_reset(spec: SMESpec, num_envs: int) -> dict[str, Array]:
    """The info of `B` resets: fresh arrays of NaN, those of actions `[B, A]`, others `[B]`."""
    arrays = {key: np.full((num_envs, spec.action_dim), np.nan) for key in actions(spec)}
    return arrays | {key: np.full(num_envs, np.nan) for key in numbers(spec)}


def write_reset(
    info: dict[str, npt.NDArray[Any]], envs: Indices, life: Mapping[str, npt.NDArray[Any]]
) -> None:
    """Overwrite a batched info where an episode begins; `life` is `Batch.life`'s."""
    for key, value in info.items():
        value[envs] = life[key][envs] if key in life else np.nan


def of_batch(step: BatchStep, rescaled: bool) -> dict[str, npt.NDArray[Any]]:
    """The info of a step of single agents: `[B, A]` and `[B]`; see `_of_step`."""
    return _of_step(step, step.values[:, 0], ..., rescaled)


def of_all_agents(step: BatchStep, env: int, rescaled: bool) -> dict[str, Any]:
    """A team's step as one agent's: the actions of all channels, the means over the agents."""
    return _of_step(step, step.values[:, :, env].mean(axis=1), env, rescaled)


def _of_step(step: BatchStep, values: Array, envs: Any, rescaled: bool) -> dict[str, Any]:
    """The info of a step from its `values` `[5 or 7, …]`, and its actions of some environments."""
    info = {
        "optimal_action": from_unit(step.optimal[envs], rescaled),
        **{key: values[row] for key, row in NUMBERS.items()},
    }
    if step.limits.size:
        info |= zip(SAFETY_ACTIONS, from_unit(step.limits[:, envs], rescaled), strict=True)
        info |= {key: values[row] for key, row in SAFETY_NUMBERS.items()}
    return info


def of_life(phase: Any, lifetime: Any) -> dict[str, Any]:
    """What the info of a stream has besides."""
    return {"phase": phase, "lifetime": lifetime}


def masked(info: Mapping[str, npt.NDArray[Any]], mask: Mask | None = None) -> dict[str, Any]:
    """Gymnasium's form of batched info: each key with its mask `_key`; None is all.

    Copies arrays only where there is a mask, and writes 0 where it is False.
    """
    infos: dict[str, Any] = {}
    if mask is None:
        everywhere = np.ones(len(info["similarity"]), bool)
        for key, value in info.items():
            infos[key], infos[f"_{key}"] = value, everywhere
        return infos
    for key, value in info.items():
        columns = mask.reshape(-1, *[1] * (value.ndim - 1))
        infos[key], infos[f"_{key}"] = np.where(columns, value, value.dtype.type(0)), mask.copy()
    return infos
