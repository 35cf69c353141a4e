"""Measurements over whole episodes of a policy, and of its training log.

`n` episodes side by side, `S` state_dim, `A` action_dim, `T` steps of the longest episode.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.compiled.values import REWARD, STEP_REWARD
from sme_registry.diagnosis.measure import MAX_NUMBERS
from sme_registry.diagnosis.measurements import (
    LINEAR,
    POLICY,
    OnPolicy,
    RewardSignal,
    Score,
    TrainingSummary,
)
from sme_registry.diagnosis.subject import Log
from sme_registry.envs.batch import Batch
from sme_registry.envs.types import Mask, Observation
from sme_registry.evaluation import references
from sme_registry.evaluation.rollouts import play
from sme_registry.statistics import smoothed
from sme_registry.task import Task, streams
from sme_registry.task.draw import Array

__all__ = [
    "CONSTANTS",
    "Trajectories",
    "episodes_of",
    "on_policy",
    "rollout",
    "training",
]

CONSTANTS = ("best_constant", "constant_half")
_TIME_BINS, _COVERAGE_BINS = 10, 20
_MARGIN = 0.02  # of regret below the constant action's
_TINY = 1e-12


class Trajectories(NamedTuple):
    """Episodes side by side, up to the end of the longest, as one agent experiences them.

    In a team that shares a reward, an agent's step reward here is that of its own similarity, and
    its payout is the team's.
    """

    s: Array  # `[T, n, S]` states
    a: Array  # `[T, n, A]` actions of all agents
    mae: Array  # `[T, n]` mean |a − a*| over channels
    constant_mae: Array  # `[T, n]` the same of the constant ½
    reward: Array  # `[T, n]` step reward r
    payout: Array  # `[T, n]` payout R
    alive: Mask  # `[T, n]` whether the episode was still running
    payout_due: Mask  # `[T, n]` whether a payout was due after the step
    terminated: Mask  # `[n]` whether D terminated the episode because of this agent

    def mean(self, values: Array | Mask) -> float:
        """Over all steps of all episodes."""
        return float(values[self.alive].mean())

    @property
    def score(self) -> Score:
        """Over all steps of all episodes."""
        mae = self.mean(self.mae)
        return Score(
            regret=1.0 - self.mean(self.reward),
            mae=mae,
            normalised_regret=mae / max(self.mean(self.constant_mae), _TINY),
        )


def rollout(
    act: Callable[[Observation], Array],
    task: Task,
    initial_states: Array,
    seed: int,
    *,
    sees_state: bool = False,
) -> tuple[Trajectories, ...]:
    """Whole episodes of a policy in the unit range, from initial states `[n, S]`, by agent.

    `act` maps joint observations `[n, O]` of all agents (one where there is no team), or float32
    states `[n, S]` if it `sees_state`, to the actions `[n, A]` of all. `seed` is of the
    distractors.
    """
    n, agents = len(initial_states), len(task.owned)
    batch = Batch(task, n)
    if task.spec.distractors:
        for lane, word in enumerate(streams.bit_generator(seed, "diagnosis/lanes").random_raw(n)):
            batch.seed(lane, int(word))
    batch.begin(np.arange(n), batch.observe(), initial_states)

    def actions(s: Array, observation: Observation) -> Array:
        return np.clip(act(s.astype(np.float32) if sees_state else observation.copy()), 0.0, 1.0)

    terminated = np.zeros((agents, n), bool)
    rows: list[tuple[npt.NDArray[Any], ...]] = []
    for step in play(batch, actions):
        a, result = step.action, step.result
        due = ((len(rows) + 1) % task.spec.k == 0) | result.truncated
        mae, constant_mae = (_mae(task, x - result.optimal) for x in (a, 0.5))
        received, payout = result.values[STEP_REWARD].copy(), result.values[REWARD].copy()
        reward = task.reward_of(1.0 - mae) if task.pays_the_team else received
        rows.append((step.state, a, mae, constant_mae, reward, payout, step.running, due))
        terminated |= step.running & result.terminated & (received < task.spec.D)
    s, a, mae, constant_mae, reward, payout, running, due = map(np.array, zip(*rows, strict=True))
    return tuple(
        Trajectories(
            s, a, mae[:, i], constant_mae[:, i], reward[:, i], payout[:, i], running, due, ended
        )
        for i, ended in enumerate(terminated)
    )


def _mae(task: Task, difference: Array) -> Array:
    """`[m, n]` mean |a − a*| over each agent's channels, of differences `[n, A]`."""
    distance = np.abs(difference)
    return np.stack([distance[:, owned].mean(axis=1) for owned in task.owned])


def episodes_of(
    act: Callable[[Observation], Array],
    task: Task,
    fitted: references.References,
    episodes: int,
    seed: int,
) -> tuple[dict[str, Trajectories], ...]:
    """Whole episodes of the policy and of references, from the same initial states."""
    S, T = task.spec.state_dim, task.spec.horizon
    n = max(8, min(episodes, MAX_NUMBERS // (T * (S + 8))))
    starts = streams.uniform(seed, "diagnosis/starts", n * S).reshape(n, S)
    runs = {POLICY: rollout(act, task, starts, seed)}
    for name, reference in _reference_actions(task, fitted, n, seed).items():
        runs[name] = rollout(reference, task, starts, seed, sees_state=True)
    return tuple(dict(zip(runs, agent, strict=True)) for agent in zip(*runs.values(), strict=True))


def on_policy(task: Task, runs: dict[str, Trajectories]) -> OnPolicy:
    """A summary of one agent's episodes, from `episodes_of`."""
    S, n = task.spec.state_dim, len(runs[POLICY].terminated)
    run, random = runs[POLICY], runs["uniform_random"]
    edges = np.linspace(0, len(run.s), min(_TIME_BINS, len(run.s)) + 1).round().astype(int)
    bins = [slice(low, high) for low, high in itertools.pairwise(edges.tolist())]
    visited = np.sort(run.s[run.alive], axis=0)
    return OnPolicy(
        episodes=n,
        scores={name: trajectories.score for name, trajectories in runs.items()},
        edges=tuple(edges.astype(float).tolist()),
        regret=tuple(1.0 - float(run.reward[b][run.alive[b]].mean()) for b in bins),
        mae=tuple(float(run.mae[b][run.alive[b]].mean()) for b in bins),
        alive=tuple(float(run.alive[b].mean()) for b in bins),
        mean_length=float(run.alive.sum(axis=0).mean()),
        termination_rate=float(run.terminated.mean()),
        signal=_reward_signal(task, run),
        random_signal=_reward_signal(task, random),
        credit=_credit(run),
        random_credit=_credit(random),
        state_shift=tuple(_distance_from_uniform(visited[:, j]) for j in range(S)),
        coverage=min(_coverage(visited[:, j]) for j in range(S)),
    )


def _reference_actions(
    task: Task, fitted: references.References, n: int, seed: int
) -> dict[str, Callable[[Observation], Array]]:
    """The references as functions of states `[n, S]`."""
    A = task.spec.action_dim
    bits = streams.bit_generator(seed, "diagnosis/random_action")
    return {
        LINEAR: fitted.linear,
        "best_constant": lambda s: np.tile(fitted.constant, (n, 1)),
        "constant_half": lambda s: np.full((n, A), 0.5),
        "uniform_random": lambda s: streams.to_uniform(bits.random_raw(n * A)).reshape(n, A),
    }


def _reward_signal(task: Task, run: Trajectories) -> RewardSignal:
    similarity = 1.0 - run.mae
    rewarded, graded = run.reward > 0.0, similarity > 0.75
    shortfall = np.maximum(0.0, 0.75 + task.spec.r_min / 4.0 - similarity)
    return RewardSignal(
        rewarded=run.mean(rewarded),
        gated=run.mean(graded & ~rewarded),
        flat=run.mean(~graded & ~rewarded),
        shortfall=run.mean(shortfall),
    )


def _credit(run: Trajectories) -> float | None:
    """Squared correlation of step rewards with the payouts that include them."""
    credited = np.full(run.reward.shape, np.nan)
    next_payout = np.full(run.reward.shape[1], np.nan)
    for t in range(len(credited) - 1, -1, -1):
        next_payout = np.where(run.alive[t] & run.payout_due[t], run.payout[t], next_payout)
        credited[t] = next_payout
    known = run.alive & np.isfinite(credited)
    reward, payout = run.reward[known], credited[known]
    if len(reward) < 2 or reward.std() < 1e-9 or payout.std() < 1e-9:
        return None
    return float(np.corrcoef(reward, payout)[0, 1] ** 2)


def _distance_from_uniform(values: Array) -> float:
    """Kolmogorov-Smirnov distance of sorted values from the uniform distribution."""
    n = len(values)
    ranks = np.arange(n + 1) / n
    return float(max((ranks[1:] - values).max(), (values - ranks[:-1]).max()))


def _coverage(values: Array) -> float:
    bins = np.minimum(values * _COVERAGE_BINS, _COVERAGE_BINS - 1).astype(int)
    return float(len(np.unique(bins)) / _COVERAGE_BINS)


def training(log: Log, constant_regret: float) -> TrainingSummary:
    """Summarise a training log of one or more rows, next to the regret of a constant policy."""
    rows = len(log.regret)
    steps, median, window = smoothed(log.step, log.regret)
    improved = np.flatnonzero(median < constant_regret - _MARGIN)
    recent = median[-max(1, len(median) // 3) :]
    best = int(np.argmin(median))
    return TrainingSummary(
        source=log.source,
        rows=rows,
        steps=int(log.step[-1]),
        window=window,
        first_regret=float(median[0]),
        best_regret=float(median[best]),
        best_step=int(steps[best]),
        last_regret=float(median[-1]),
        constant_regret=constant_regret,
        improvement_step=int(steps[improved[0]]) if len(improved) else None,
        recent_improvement=float(recent[0] - recent[-1]),
        unrewarded=None if log.unrewarded is None else float(log.unrewarded.mean()),
        termination_rate=None if log.terminated is None else float(log.terminated.mean()),
    )
