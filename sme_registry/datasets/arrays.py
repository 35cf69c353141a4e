"""`Transitions`: a data set as aligned NumPy arrays, one row (s, a, R, s') for each transition.

`N` transitions, `S` state_dim, `A` action_dim, `n` agents (1 without a team), `m` distractors (0
without `observation`), `O` = S + m + 1 + n entries of an observation. Rows of one trajectory are
contiguous and in order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.envs.types import Array, Mask, Observation

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Transitions:
    """Aligned arrays of a data set; every first axis is N.

    A trajectory is an episode or a part of one: a data set restricted to a sub-cube of the states,
    or cut at N rows, has parts. `terminations | timeouts` marks the last row of each trajectory.

    Attributes:
      observations: `[N, O]` float32 in [0, 1]: s, t/T, and each agent's r_cum/k, before the step.
        With `observation` what the agent saw, M(s, d) `[S + m]`, in place of s.
      actions: `[N, A]` float32 in [0, 1], as the environment executed them.
      rewards: `[N]` float64 in [0, k], R; of a team the mean over its agents.
      next_observations: `[N, O]` float32, after the step; also at the end of a trajectory.
      terminations: `[N]` bool: the episode ended by D. Do not bootstrap.
      timeouts: `[N]` bool: the trajectory ends here but the task continues. Bootstrap from
        `next_observations`. Never true together with a termination.
      optimal_actions: `[N, A]` float64 in [0, 1], π*(s).
      regrets, similarities, step_rewards: `[N]` float64 in [0, 1]: 1 − r, r̃ and r; of a team
        `[N, n]`, one column for each agent.
      states, next_states: `[N, S]` float64 in [0, 1], to the bit.
      episodes: `[N]` int64, index of the row's trajectory, from 0; non-decreasing.
      components: `[N]` int64, index of the recipe's behaviour policy that acted.
      agent_rewards: `[N, n]` float64, R of each agent of a team; None for a single agent.
      costs, limits, safe_actions: `[N]`, `[N, A]`, `[N, A]` float64 in [0, 1]: the cost of the
        action, ℓ(s), and min(π*(s), ℓ(s)); None without `safety`, as is the next.
      safe_regrets: `[N]` float64 in [−1, 1], the step reward of the safe action minus r.
      distractors, next_distractors: `[N, m]` float64 in [0, 1]; None without distractors.
    """

    observations: Observation
    actions: npt.NDArray[np.float32]
    rewards: Array
    next_observations: Observation
    terminations: Mask
    timeouts: Mask
    optimal_actions: Array
    regrets: Array
    similarities: Array
    step_rewards: Array
    states: Array
    next_states: Array
    episodes: Indices
    components: Indices
    agent_rewards: Array | None = None
    costs: Array | None = None
    limits: Array | None = None
    safe_actions: Array | None = None
    safe_regrets: Array | None = None
    distractors: Array | None = None
    next_distractors: Array | None = None

    def __len__(self) -> int:
        return len(self.rewards)

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays by name, in the order of this class, without those that are None."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: array for name, array in named.items() if array is not None}

    @property
    def ends(self) -> Indices:
        """`[E]` the index after the last row of each of the `E` trajectories."""
        return np.flatnonzero(self.terminations | self.timeouts) + 1

    @property
    def digest(self) -> str:
        return digest_of(self.columns())


def digest_of(arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """`sha256:` and 64 hex digits over the names, types, shapes and bytes of arrays, in order."""
    content = hashlib.sha256()
    for name, array in arrays.items():
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        content.update(f"{name}/{little.dtype.str}/{little.shape}\n".encode())
        content.update(little.data)
    return "sha256:" + content.hexdigest()


def to_d3rlpy(
    transitions: Transitions, *, final_observations: bool = False
) -> dict[str, npt.NDArray[Any]]:
    """The arguments of d3rlpy's `MDPDataset`, as copies: `MDPDataset(**to_d3rlpy(transitions))`.

    d3rlpy uses row i + 1 as the observation after row i. The last row of a trajectory that ended
    without a termination has no successor, so d3rlpy drops it: one row in T, and every trajectory
    of a single step. With `final_observations` each such trajectory gets one more row, its final
    observation with an action and a reward of 0, which d3rlpy uses as a successor and not as a
    transition, so no row is lost. Do not use it for algorithms that read rows instead of
    transitions, such as return-conditioned sequence models.

    Examples:
      >>> from sme_registry.datasets import open_dataset, to_d3rlpy
      >>> data = open_dataset("sme/Default-v1-nu50-seed0-v0", "data")
      >>> sorted(to_d3rlpy(data.transitions()))
      ['actions', 'observations', 'rewards', 'terminals', 'timeouts']
    """
    arrays: dict[str, npt.NDArray[Any]] = {
        "observations": transitions.observations,
        "actions": transitions.actions,
        "rewards": transitions.rewards.astype(np.float32),
        "terminals": transitions.terminations.astype(np.float32),
        "timeouts": transitions.timeouts.astype(np.float32),
    }
    if not final_observations:
        return {name: array.copy() for name, array in arrays.items()}
    stopped = np.flatnonzero(transitions.timeouts)
    added: dict[str, npt.NDArray[Any] | float] = {
        "observations": transitions.next_observations[stopped],
        "timeouts": 1.0,
    }
    arrays["timeouts"] = np.zeros_like(arrays["timeouts"])  # they move to the added rows
    return {
        name: np.insert(array, stopped + 1, added.get(name, 0.0), axis=0)
        for name, array in arrays.items()
    }
