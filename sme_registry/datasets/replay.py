"""`replay`: every transition of a set once more through its task, from the definition.

What is in a file is believed only where the task says the same: the next state to the bit, π*, r̃, r
and what was paid to 1e-12, and that rows of a trajectory follow one another.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.arrays import Transitions, agents_of
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.errors import FingerprintMismatchError
from sme_registry.evaluation.regions import expansion
from sme_registry.task import Task
from sme_registry.task.draw import Array

TOLERANCE = 1e-12
_ROUNDED = 1e-6  # of r_cum/k where a trajectory begins within an episode: it is seen as float32
_BLOCK = 4096


def replay(transitions: Transitions, recipe: DatasetRecipe, task: Task) -> None:
    """Check a set against its task.

    Args:
      transitions: the set.
      recipe: what it says it was made from.
      task: the recipe's task, drawn here.

    Raises:
      FingerprintMismatchError: names the first array and row that the task contradicts.
    """
    spec, n = recipe.spec, agents_of(recipe.spec)
    S, T, N = spec.state_dim, spec.horizon, len(transitions)
    a = transitions.actions.astype(np.float64)
    optimal = np.concatenate(
        [task.policy(transitions.states[first : first + _BLOCK]) for first in range(0, N, _BLOCK)]
    )
    similarity = task.similarities_of(a, optimal)
    paid_for = similarity
    if task.pays_the_team:
        paid_for = np.broadcast_to(task.similarity_of(a, optimal)[:, None], similarity.shape)
    step_reward = task.reward_of(paid_for)

    _same("next_states", transitions.next_states, task.transition(transitions.states, a))
    _same("optimal_actions", transitions.optimal_actions, optimal, TOLERANCE)
    _same("similarities", transitions.similarities.reshape(N, n), similarity, TOLERANCE)
    _same("step_rewards", transitions.step_rewards.reshape(N, n), step_reward, TOLERANCE)
    _same("regrets", transitions.regrets.reshape(N, n), 1.0 - step_reward, TOLERANCE)
    terminated = np.asarray((step_reward < spec.D).any(axis=1))
    _same("terminations", transitions.terminations, terminated)

    t = np.rint(transitions.observations[:, S].astype(np.float64) * T).astype(np.int64)
    for name, seen, s, step in (
        ("observations", transitions.observations, transitions.states, t),
        ("next_observations", transitions.next_observations, transitions.next_states, t + 1),
    ):
        shown = np.column_stack([s, step / T]).astype(np.float32)
        _same(name, seen[:, : S + 1], shown)

    ends = transitions.terminations | transitions.timeouts
    inner = np.flatnonzero(~ends)
    if not ends[-1]:
        raise _contradicted("timeouts", N - 1, "the last row must end its trajectory")
    for before, after in (("next_states", "states"), ("next_observations", "observations")):
        _same(before, getattr(transitions, before)[inner], getattr(transitions, after)[inner + 1])
    _same("timeouts", ends | (t + 1 < T), np.ones(N, bool))
    _same("episodes", transitions.episodes, np.cumsum(ends) - ends)
    if recipe.coverage is not None:
        _same("states", expansion(transitions.states) <= recipe.coverage, np.ones(N, bool))

    given = transitions.rewards[:, None]
    if transitions.agent_rewards is not None:
        given = transitions.agent_rewards
        _same("rewards", transitions.rewards, given.mean(axis=1), TOLERANCE)
    reward, allowed = _paid(transitions, step_reward, t, spec.k, T)
    _same("rewards", given, reward, allowed)


def _paid(
    transitions: Transitions, step_reward: Array, t: npt.NDArray[np.int64], k: int, horizon: int
) -> tuple[Array, Array]:
    """R of each row and agent, `[N, n]`, and to what it must agree, `[N, 1]`."""
    starts = np.concatenate([[0], transitions.ends[:-1]])
    lengths = np.diff([*starts, len(t)])
    S = transitions.states.shape[1]
    accumulated = transitions.observations[starts, S + 1 :].astype(np.float64) * k
    allowed = k * np.where(np.repeat(t[starts], lengths) == 0, TOLERANCE, _ROUNDED)
    reward = np.empty_like(step_reward)
    for step in range(int(lengths.max())):  # step by step, all trajectories side by side
        running = np.flatnonzero(lengths > step)
        rows = starts[running] + step
        total = accumulated[running] + step_reward[rows]
        paid = (((t[rows] + 1) % k == 0) | (t[rows] + 1 >= horizon))[:, None]
        reward[rows] = np.where(paid, total, 0.0)
        accumulated[running] = np.where(paid, 0.0, total)
    return reward, allowed[:, None]


def _same(
    name: str, found: npt.NDArray[Any], right: npt.NDArray[Any], allowed: float | Array = 0.0
) -> None:
    """Raise at the first row where an array is not what it must be.

    Raises:
      FingerprintMismatchError: says which and how far off.
    """
    off = np.abs(found.astype(np.float64) - right.astype(np.float64))
    wrong = ~(off <= allowed)
    if wrong.any():
        row = int(np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1))[0])
        raise _contradicted(name, row, f"off by {np.max(off[row]):.3g}")


def _contradicted(name: str, row: int, what: str) -> FingerprintMismatchError:
    return FingerprintMismatchError(
        f"{name}, row {row}: {what}: the set's numbers are not those of the task drawn on this "
        "machine. If the file was edited, take it again from its source. If not, this machine's "
        "NumPy or SciPy draws other numbers: install the versions that the set names."
    )
