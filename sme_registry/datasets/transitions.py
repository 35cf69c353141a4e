"""`Transitions`: a data set as aligned arrays, and its check against its task.

`N` transitions, `S` state_dim, `A` action_dim, `n` agents (1 without a team), `m` distractors (0
without `observation`), `O` = S + m + 1 + n entries of an observation, T horizon.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.documents import DatasetRecipe
from sme_registry.errors import FingerprintMismatchError, SpecError
from sme_registry.evaluation.regions import expansion
from sme_registry.spec import SMESpec
from sme_registry.task import Task, step
from sme_registry.task.episode import Step
from sme_registry.task.task import Array, Indices, Mask, Observation

Arrays = dict[str, npt.NDArray[Any]]

TOLERANCE = 1e-12
# Of r_cum/k of a trajectory that begins within an episode, and of what a mixing shows: both are
# stored as float32.
_ROUNDED = 1e-6


class AlignedArrays:
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
class Transitions(AlignedArrays):
    """Aligned arrays of a data set; every first axis is N.

    A trajectory is an episode or a part of one: a data set restricted to a sub-cube of the states,
    or cut at N rows, has parts. `terminations | timeouts` marks the last row of each trajectory.

    Attributes:
      observations: `[N, O]` float32 in [0, 1]: s, t/T, and each agent's r_cum/k, before the step.
        With `observation` what the agent saw, M(s, d) `[S + m]`, in place of s.
      actions: `[N, A]` float32 in [0, 1], as the environment executed them.
      rewards: `[N]` float64, R in [0, k] and what is paid on top; of a team the mean over agents.
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
      prices, shapings, reward_noises: `[N]` float64, what is paid on top of R; of a team `[N, n]`.
        None where the task does not pay it.
      transition_noises: `[N, S]` float64, ζ; None without noise of the transition.
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
    prices: Array | None = None
    shapings: Array | None = None
    reward_noises: Array | None = None
    transition_noises: Array | None = None

    @property
    def ends(self) -> Indices:
        """`[E]` the index after the last row of each trajectory."""
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
    agent sees through a mixing to 1e-6, as float32. Driven distractors must agree to the bit;
    others must lie in the cube, as the random numbers that move them are not in the data set. A
    FingerprintMismatchError names the first array and row that differ from the task's.

    Examples:
      >>> from sme_registry.datasets import open_dataset, replay
      >>> data = open_dataset("sme/Default-v1-nu50-seed0-v0", "data")
      >>> replay(data.transitions(), data.recipe, sme_registry.materialize(data.recipe.spec))
    """
    spec, columns = recipe.spec, transitions.columns()
    clock = transitions.observations[:, spec.state_dim + spec.distractors].astype(np.float64)
    t = np.rint(clock * spec.horizon).astype(np.int64)
    ends, always = transitions.terminations | transitions.timeouts, np.ones(len(t), bool)
    _same("timeouts", ends[-1:], always[-1:], first=len(t) - 1)
    _same("timeouts", ends | (t + 1 < spec.horizon), always)
    _same("episodes", transitions.episodes, np.cumsum(ends) - ends)
    if recipe.coverage is not None:
        _same("states", expansion(transitions.states) <= recipe.coverage, always)
    inner = np.flatnonzero(~ends)
    for name in ("states", "observations", "distractors"):
        if name in columns:
            _same(f"next_{name}", columns[f"next_{name}"][inner], columns[name][inner + 1])
    if transitions.agent_rewards is not None:
        _same("rewards", transitions.rewards, transitions.agent_rewards.mean(axis=1), TOLERANCE)
    for name, (expected, tolerance) in _expected(columns, task, t, transitions.ends).items():
        stored = columns[name].reshape(len(t), -1)
        _same(name, stored[:, : expected.shape[1]], expected, tolerance)


def _expected(
    columns: Arrays, task: Task, t: Indices, ends: Indices
) -> dict[str, tuple[npt.NDArray[Any], float | Array]]:
    """What a task gives for the rows of a data set, `[N, …]`, and with which tolerance."""
    spec, a = task.spec, columns["actions"].astype(np.float64)
    result = _steps(task, columns, t, ends)
    starts = np.repeat(t[[0, *ends[:-1]]], np.diff(ends, prepend=0))
    of_reward = spec.k * np.where(starts == 0, TOLERANCE, _ROUNDED)[:, None]
    expected: dict[str, tuple[npt.NDArray[Any], float | Array]] = {
        "next_states": (result.state, 0.0),
        "optimal_actions": (result.optimal_action, TOLERANCE),
        "similarities": (result.similarity, TOLERANCE),
        "step_rewards": (result.step_reward, TOLERANCE),
        "regrets": (result.regret, TOLERANCE),
        "terminations": (result.terminated[:, None], 0.0),
        "rewards" if spec.team is None else "agent_rewards": (result.reward, of_reward),
    }
    for name, column in (("prices", result.price), ("shapings", result.shaping)):
        if name in columns:
            expected[name] = column, TOLERANCE * max(1.0, spec.shaping.scale if spec.shaping else 1)
    for which, time in (("", t), ("next_", t + 1)):
        seen = task.seen(columns[f"{which}states"], columns.get(f"{which}distractors"))
        seen = np.concatenate([seen, (time / spec.horizon)[:, None]], axis=1).astype(np.float32)
        of_seen = np.full(seen.shape[1], _ROUNDED if task.mixing else 0.0)
        of_seen[-1] = 0.0  # of t/T, which no mixing touches
        expected[f"{which}observations"] = seen, of_seen
    if spec.safety is not None:
        expected |= {
            "limits": (result.limit, TOLERANCE),
            "safe_actions": (result.safe_action, TOLERANCE),
            "costs": (result.cost, TOLERANCE),
            "safe_regrets": (result.safe_regret, TOLERANCE),
        }
    if spec.distractors:
        d, moved = columns["distractors"], columns["next_distractors"]
        expected["distractors"] = np.clip(d, 0.0, 1.0), 0.0
        is_driven = spec.dynamics == "driven"
        moved = task.distractor_step(d, a) if is_driven else np.clip(moved, 0.0, 1.0)
        expected["next_distractors"] = moved, 0.0
    return expected


def _steps(task: Task, columns: Arrays, t: Indices, ends: Indices) -> Step:
    """The rows of a data set as steps of the task, of all trajectories at once.

    ξ is that of the stored noise of the reward, so that of the reward all else is checked.
    """
    observations, s, a = (columns[name] for name in ("observations", "states", "actions"))
    a, n = a.astype(np.float64), len(task.policies)
    noise = np.zeros((len(t), n + task.spec.state_dim))
    if "reward_noises" in columns:
        noise[:, :n] = columns["reward_noises"].reshape(len(t), n) / task.sigmas[0]
    if "transition_noises" in columns:
        noise[:, n:] = columns["transition_noises"]
    starts, lengths = np.array([0, *ends[:-1]]), np.diff(ends, prepend=0)
    accumulated = observations[starts, -len(task.policies) :].astype(np.float64) * task.spec.k
    rows, results = [], []
    for number in range(int(lengths.max())):
        running = lengths > number
        rows.append(starts[running] + number)
        row = rows[-1]
        result = step(task, s[row], t[row], accumulated[running], a[row], noise[row])
        accumulated[running] = result.accumulated_reward
        results.append(result)
    order = np.argsort(np.concatenate(rows))
    return Step._make(np.concatenate(column)[order] for column in zip(*results, strict=True))


def _same(
    name: str,
    values: npt.NDArray[Any],
    expected: npt.NDArray[Any],
    tolerance: float | Array = 0.0,
    first: int = 0,
) -> None:
    difference = np.abs(values.astype(np.float64) - expected.astype(np.float64))
    wrong = ~(difference <= tolerance)
    if wrong.any():
        row = int(np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1))[0])
        raise FingerprintMismatchError(
            f"{name}, row {first + row}: off by {np.max(difference[row]):.3g}: the data set "
            "differs from its task as materialised on this machine. If the file was edited, "
            "download the data set again. Otherwise NumPy or SciPy compute other numbers here: "
            "install the versions recorded in the data set."
        )


def positions(
    transitions: Transitions, spec: SMESpec, rows: npt.ArrayLike | None = None
) -> dict[str, Any]:
    """The states, times and accumulated rewards of rows of a data set, for `sme_registry.values`.

    `rows` are indices or a mask; None for all. `states` `[M, S]` and `t` `[M]` are exact, those
    accumulated `[M]` as an observation stores them, to a relative precision of 6e-8.

    Examples:
      >>> from sme_registry.datasets import open_dataset, positions
      >>> data = open_dataset("sme/Default-v1-nu50-seed0-v0", "data")
      >>> positions(data.transitions(), data.recipe.spec, [0, 10])["t"].tolist()
      [0, 10]
    """
    if spec.team is not None:
        raise SpecError("team: values are of a single agent. Give the data set of such a task.")
    chosen = slice(None) if rows is None else np.asarray(rows)
    observed = transitions.observations[chosen].astype(np.float64)
    t = np.rint(observed[:, -2] * spec.horizon).astype(np.int64)
    accumulated = np.minimum(observed[:, -1] * spec.k, t % spec.k)
    return {"states": transitions.states[chosen], "t": t, "accumulated": accumulated}
