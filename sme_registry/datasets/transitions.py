"""`Transitions`: a data set as aligned NumPy arrays, one row (s, a, R, s') for each transition.

`N` transitions, `S` state_dim, `A` action_dim, `n` agents (1 without a team), `m` distractors (0
without `observation`), `O` = S + m + 1 + n entries of an observation. Rows of one trajectory are
contiguous and in order.

`replay` checks each of them against its task, from the definition.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.compiled.arrays import Array, Mask, Observation
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.errors import FingerprintMismatchError
from sme_registry.evaluation.regions import expansion
from sme_registry.task import Task

Indices = npt.NDArray[np.int64]

TOLERANCE = 1e-12
# Of r_cum/k of a trajectory that begins within an episode, and of what a mixing shows: both are
# stored as float32.
_ROUNDED = 1e-6
_BLOCK = 4096


class Columns:
    """A base of dataclasses of aligned arrays, of which some may be None."""

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays by name, in the order of the class, without those that are None."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return {name: array for name, array in named.items() if array is not None}

    def __len__(self) -> int:
        return len(next(iter(self.columns().values())))

    @property
    def digest(self) -> str:
        """`sha256:` and 64 hex digits over the names, types, shapes and bytes of all arrays."""
        content = hashlib.sha256()
        for name, array in self.columns().items():
            little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
            content.update(f"{name}/{little.dtype.str}/{little.shape}\n".encode())
            content.update(little.data)
        return "sha256:" + content.hexdigest()


@dataclass(frozen=True, eq=False)
class Transitions(Columns):
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

    @property
    def ends(self) -> Indices:
        """`[E]` the index after the last row of each of the `E` trajectories."""
        return np.flatnonzero(self.terminations | self.timeouts) + 1

    @property
    def truncations(self) -> Mask:
        """`[N]` timeouts, and horizons that end an episode in a step that terminates it, too."""
        agents = 1 if self.agent_rewards is None else self.agent_rewards.shape[1]
        at_horizon: Mask = self.next_observations[:, -1 - agents] == 1.0
        return self.timeouts | at_horizon


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


def replay(transitions: Transitions, recipe: DatasetRecipe, task: Task) -> None:
    """Check a data set against its recipe's task, as materialised on this machine.

    The next state must agree to the bit; π*, r̃, r, the reward, limits and costs to 1e-12; what an
    agent sees through a mixing to 1e-6, as float32; and the rows of a trajectory must follow one
    another. Driven distractors must agree to the bit. Others must lie in the cube: the random
    numbers that move them are not in the data set. A FingerprintMismatchError names the first array
    and row that differ from the task's.

    Examples:
      >>> from sme_registry.datasets import open_dataset, replay
      >>> data = open_dataset("sme/Default-v1-nu50-seed0-v0", "data")
      >>> replay(data.transitions(), data.recipe, sme_registry.materialize(data.recipe.spec))
    """
    spec, n = recipe.spec, len(task.policies)
    S, T, N = spec.state_dim, spec.horizon, len(transitions)
    a = transitions.actions.astype(np.float64)
    optimal = np.concatenate(
        [task.policy(transitions.states[first : first + _BLOCK]) for first in range(0, N, _BLOCK)]
    )
    similarity = task.similarities_of(a, optimal)
    rewarded = similarity
    if task.pays_the_team:
        rewarded = np.broadcast_to(task.similarity_of(a, optimal)[:, None], similarity.shape)
    step_reward = task.reward_of(rewarded)

    _same("next_states", transitions.next_states, task.transition(transitions.states, a))
    _same("optimal_actions", transitions.optimal_actions, optimal, TOLERANCE)
    _same("similarities", transitions.similarities.reshape(N, n), similarity, TOLERANCE)
    _same("step_rewards", transitions.step_rewards.reshape(N, n), step_reward, TOLERANCE)
    _same("regrets", transitions.regrets.reshape(N, n), 1.0 - step_reward, TOLERANCE)
    terminated = np.asarray((step_reward < spec.D).any(axis=1))
    _same("terminations", transitions.terminations, terminated)

    if spec.safety is not None:
        _replay_safety(transitions, task, a, optimal, step_reward[:, 0])
    if spec.distractors:
        _replay_distractors(transitions, task, a)

    width, rounded = S + spec.distractors, _ROUNDED if task.mixing else 0.0
    t = np.rint(transitions.observations[:, width].astype(np.float64) * T).astype(np.int64)
    columns = transitions.columns()
    for which, step in (("", t), ("next_", t + 1)):
        name = f"{which}observations"
        shown = task.seen(columns[f"{which}states"], columns.get(f"{which}distractors"))
        _same(name, columns[name][:, :width], shown.astype(np.float32), rounded)
        _same(name, columns[name][:, width], (step / T).astype(np.float32))

    ends = transitions.terminations | transitions.timeouts
    inner = np.flatnonzero(~ends)
    if not ends[-1]:
        raise _mismatch("timeouts", N - 1, "the last row must end its trajectory")
    for after in ("states", "observations", "distractors"):
        if after in columns:
            before = f"next_{after}"
            _same(before, columns[before][inner], columns[after][inner + 1])
    _same("timeouts", ends | (t + 1 < T), np.ones(N, bool))
    _same("episodes", transitions.episodes, np.cumsum(ends) - ends)
    if recipe.coverage is not None:
        _same("states", expansion(transitions.states) <= recipe.coverage, np.ones(N, bool))

    rewards = transitions.rewards[:, None]
    if transitions.agent_rewards is not None:
        rewards = transitions.agent_rewards
        _same("rewards", transitions.rewards, rewards.mean(axis=1), TOLERANCE)
    expected, tolerance = _rewards(transitions, step_reward, t, spec.k, T)
    _same("rewards", rewards, expected, tolerance)


def _replay_safety(
    transitions: Transitions, task: Task, a: Array, optimal: Array, step_reward: Array
) -> None:
    columns = transitions.columns()
    limit = task.limit(transitions.states)
    safe_regret = task.safe_reward_of(optimal, limit) - step_reward
    _same("limits", columns["limits"], limit, TOLERANCE)
    _same("safe_actions", columns["safe_actions"], np.minimum(optimal, limit), TOLERANCE)
    _same("costs", columns["costs"], task.cost_of(a, limit), TOLERANCE)
    _same("safe_regrets", columns["safe_regrets"], safe_regret, TOLERANCE)


def _replay_distractors(transitions: Transitions, task: Task, a: Array) -> None:
    columns, spec = transitions.columns(), task.spec
    for name in ("distractors", "next_distractors"):
        d = columns[name]
        _same(name, (d >= 0.0) & (d <= 1.0), np.ones(d.shape, bool))
    if spec.observation is not None and spec.observation.dynamics == "driven":
        moved = task.distractor_step(columns["distractors"], a)
        _same("next_distractors", columns["next_distractors"], moved)


def _rewards(
    transitions: Transitions, step_reward: Array, t: npt.NDArray[np.int64], k: int, horizon: int
) -> tuple[Array, Array]:
    """R of each row and agent `[N, n]`, and its tolerance `[N, 1]`."""
    starts = np.concatenate([[0], transitions.ends[:-1]])
    lengths = np.diff([*starts, len(t)])
    n = step_reward.shape[1]
    accumulated = transitions.observations[starts, -n:].astype(np.float64) * k
    tolerance = k * np.where(np.repeat(t[starts], lengths) == 0, TOLERANCE, _ROUNDED)
    reward = np.empty_like(step_reward)
    for step in range(int(lengths.max())):  # all trajectories at once
        running = np.flatnonzero(lengths > step)
        rows = starts[running] + step
        total = accumulated[running] + step_reward[rows]
        paid = (((t[rows] + 1) % k == 0) | (t[rows] + 1 >= horizon))[:, None]
        reward[rows] = np.where(paid, total, 0.0)
        accumulated[running] = np.where(paid, 0.0, total)
    return reward, tolerance[:, None]


def _same(
    name: str,
    values: npt.NDArray[Any],
    expected: npt.NDArray[Any],
    tolerance: float | Array = 0.0,
) -> None:
    difference = np.abs(values.astype(np.float64) - expected.astype(np.float64))
    wrong = ~(difference <= tolerance)
    if wrong.any():
        row = int(np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1))[0])
        raise _mismatch(name, row, f"off by {np.max(difference[row]):.3g}")


def _mismatch(name: str, row: int, reason: str) -> FingerprintMismatchError:
    return FingerprintMismatchError(
        f"{name}, row {row}: {reason}: the data set differs from its task as materialised on this "
        "machine. If the file was edited, download the data set again. Otherwise NumPy or SciPy "
        "compute other numbers here: install the versions recorded in the data set."
    )
