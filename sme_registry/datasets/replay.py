"""`replay`: check every transition of a data set against its task, from the definition.

The next state must agree to the bit; π*, r̃, r, the reward, limits and costs to 1e-12; what an agent
sees through a mixing to 1e-6, as float32; and the rows of a trajectory must follow one another.
Driven distractors must agree to the bit. Others must lie in the cube: the random numbers that move
them are not in the data set.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.datasets.arrays import Transitions
from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.errors import FingerprintMismatchError
from sme_registry.evaluation.regions import expansion
from sme_registry.task import Task
from sme_registry.task.draw import Array

TOLERANCE = 1e-12
# Of r_cum/k of a trajectory that begins within an episode, and of what a mixing shows: both are
# stored as float32.
_ROUNDED = 1e-6
_BLOCK = 4096


def replay(transitions: Transitions, recipe: DatasetRecipe, task: Task) -> None:
    """Check a data set against its recipe's task, as materialised on this machine.

    A FingerprintMismatchError names the first array and row that differ from the task's.

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
