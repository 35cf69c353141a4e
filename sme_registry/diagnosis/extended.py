"""Measurements of tasks with limits or distractors, beyond those of their evaluation.

ℓ are the limits, a* the optimal actions, a the policy's actions, which on a task with distractors d
are a(s, d). N is normalised regret. In the same uniform states,

    owed to the distractors = N of a(s, d) − N of E_d a(s, d)

is the regret that would be gone if the policy took, in every state, the mean of its actions over
the distractors. It is 0 for a policy that ignores them, and never negative. A random policy's
actions differ without them, too: by how much, with d fixed, is subtracted.

`N` states, `A` action_dim, `m` distractors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from sme_registry.compiled import engine
from sme_registry.diagnosis.measure import MAX_NUMBERS, Sample, clipped_actions
from sme_registry.diagnosis.measurements import Distraction, LimitedChannel, Limits
from sme_registry.diagnosis.rollouts import Trajectories
from sme_registry.evaluation import Policy, SafetyReport, SafetyScore
from sme_registry.evaluation.measure import TOLERANCE, SafetyStats
from sme_registry.evaluation.regions import States, Uniform
from sme_registry.task import Task
from sme_registry.task.draw import Array

__all__ = ["distraction", "limits"]

_STATES, _DRAWS = 512, 64
_TINY = 1e-12


def limits(task: Task, states: Sample, run: Trajectories, report: SafetyReport) -> Limits:
    """What a policy does to the limits, in uniform states and in those of its episodes."""
    limit, tightest = task.limit(states.s), 2.0 * _tightness(task)
    above = [a - limit for a in (states.a, states.optimal)]
    own, optimal = ((excess > TOLERANCE).mean(axis=0) for excess in above)
    cost = np.maximum(0.0, above[0]).mean(axis=0) / tightest
    s = run.s[run.alive]
    visited = engine(task).optimal_action(s), task.limit(s)
    cut_off = np.minimum(states.a, limit)
    return Limits(
        report=report,
        visited=_score(task, "visited", run.a[run.alive], *visited),
        cut_off=_score(task, "WD", cut_off, states.optimal, limit),
        channels=tuple(
            LimitedChannel(
                channel=i + 1,
                violating_share=float(own[i]),
                optimal_violating_share=float(optimal[i]),
                cost=float(cost[i]),
            )
            for i in range(task.spec.action_dim)
        ),
    )


def _tightness(task: Task) -> float:
    assert task.spec.safety is not None
    return task.spec.safety.tightness


def _score(task: Task, name: str, a: Array, optimal: Array, limit: Array) -> SafetyScore:
    scores = SafetyStats(task)
    scores.add(a, optimal, limit, task.safe_reward_of(optimal, limit))
    return scores.score(name)


class _Draws(NamedTuple):
    """A policy that acts several times in the same states."""

    regret: float  # N over states and draws
    averaged: float  # N of the mean action of each state
    variance: float  # of the actions of a state, mean over states and channels
    squared_error: float  # mean over draws, states and channels; never below the variance


def distraction(policy: Policy, task: Task, states: Sample, seed: int) -> Distraction:
    """How much of a policy's regret is owed to the distractors, in a few uniform states."""
    m, numbers = task.spec.distractors, task.spec.observation_dim + task.spec.action_dim
    few = min(_STATES, len(states.s), max(8, MAX_NUMBERS // (_DRAWS * numbers)))
    s, d, time = states.drawn
    drawn, optimal = States(s[:few], d[:few], time[:few]), states.optimal[:few]
    half = max(float(np.abs(0.5 - optimal).mean()), _TINY)

    def act(d: Array) -> Array:
        observation = drawn.observation(drawn.seen(task, d), task.spec.horizon)
        return clipped_actions(policy, observation)

    def distractors() -> Iterator[Array]:
        # In pairs, whose mean is ½: what is linear in d then averages out exactly.
        uniform = Uniform(seed, "diagnosis/distractors")
        for _ in range(_DRAWS // 2):
            d = uniform(few, m)
            yield from (d, 1.0 - d)

    varied = _draws(act, distractors(), optimal, half)
    repeated = _Draws(0.0, 0.0, 0.0, 0.0)
    if (act(drawn.d) != act(drawn.d)).any():
        repeated = _draws(act, [drawn.d] * _DRAWS, optimal, half)
    owed = max(0.0, (varied.regret - varied.averaged) - (repeated.regret - repeated.averaged))
    centre = act(np.full((few, m), 0.5))
    return Distraction(
        states=few,
        distractor_draws=_DRAWS,
        normalised_regret=varied.regret,
        averaged_regret=varied.averaged,
        half_regret=float(np.abs(centre - optimal).mean()) / half,
        owed_regret=owed,
        owed_similarity=100.0 * half * owed,
        distractor_share=max(0.0, varied.variance - repeated.variance)
        / max(varied.squared_error, _TINY),
    )


def _draws(
    act: Callable[[Array], Array], distractors: Iterable[Array], optimal: Array, half: float
) -> _Draws:
    """Actions in the same states with each of these distractors `[N, m]`; see `_Draws`."""
    actions = np.array([act(d) for d in distractors])
    mean = actions.mean(axis=0)
    return _Draws(
        regret=float(np.abs(actions - optimal).mean()) / half,
        averaged=float(np.abs(mean - optimal).mean()) / half,
        variance=float(((actions - mean) ** 2).mean()),
        squared_error=float(((actions - optimal) ** 2).mean()),
    )
