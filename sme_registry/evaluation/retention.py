"""Retention: metrics of continual learning, pure functions of a retention matrix.

Axis letters: `V` visits, `P` phases, `K` sets of states (regions). Visit v is an occurrence of a
phase in the life, φ(v) = v mod P; M[v, j] is the normalised regret on phase j's task at its end.

    R[v, j] = 1 − M[v, j]                                     performance: 1 optimal, 0 constant ½
    A(v)    = mean over j ≤ v of R[v, j]                      average performance
    B(v)    = mean over j of R[v, j] − R[last(v, j), j]       backward transfer
    F(v)    = mean over j of max_{u<v} R[u, j] − R[v, j]      forgetting
    T       = mean over j ≥ 1 of R[j − 1, j] − R₀[j]          forward transfer
    G       = mean over j of R[P + j, j] − R[j, j]            relearning

B and F are over the phases that were visited before v, other than φ(v); last(v, j) is the last
visit of phase j before v. R₀ is of the initial policy. In the last visit of a single cycle, A, B
and T are ACC, BWT and FWT of Lopez-Paz & Ranzato (2017), and A and F are those of Chaudhry et al.
(2018). With more cycles a visit is what a task is there: B compares with the last time that the
phase was trained, F with the best time of all, T is of the first cycle, in which phases are new,
and G compares the second visit of a phase with its first, after equal steps.

A metric is NaN where nothing can be compared: B and F at the first visit, T without an initial
policy or with one phase, G with one cycle.

    plasticity ratio       M[v, φ(v)] / N[φ(v)]     above 1: it learned less than a fresh agent
    plasticity difference  M[v, φ(v)] − N[φ(v)]     N: of agents that train on one phase

    learning transfer      (O[φ(v)] − o(v)) / O[φ(v)]      o, O: online regret of visits, and of N's

Learning transfer is the forward transfer of Continual World (Wołczyk et al. 2021), (AUC − AUC_b) /
(1 − AUC_b), where the area under the curve of training is the mean step reward over all of its
steps, 1 − o, instead of a mean over evaluations.

In visit 0 a life is a fresh agent itself. So plasticity and learning transfer of a life are means
over visits 1, 2, …; of one with a single visit nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from sme_registry.task.draw import Array

SHELLS = "OOD"
LABELS = {
    "frozen_optimum": "optimum of phase 0",
    "fresh_optimum": "optimum of each phase",
    "constant_half": "constant ½",
    "frozen_agent": "frozen after visit 0",
    "fresh_agents": "fresh agent in each phase",
}
"""The reference agents. Three need no training: one optimum for the whole life, that of the phase
just visited (an agent that learns each phase perfectly and keeps nothing), and the constant ½. Two
are known by their dynamic regret only: the agent itself if it stops learning at the end of its
first visit, and agents that start anew in each visit."""
TRAINED = ("frozen_agent", "fresh_agents")

METRICS = {
    "average_performance": "average performance",
    "backward_transfer": "backward transfer",
    "forgetting": "forgetting",
    "forward_transfer": "forward transfer",
    "relearning": "relearning",
    "plasticity_ratio": "plasticity ratio",
    "plasticity_difference": "plasticity difference",
}
"""The metrics of `Retention`, and their labels."""
BY_VISIT = tuple(name for name in METRICS if name not in ("forward_transfer", "relearning"))
"""Those that have a value for each visit; the others have one for the life."""


def average_performance(R: Array) -> Array:
    """A(v), `[V, K]`: mean performance over the phases visited so far."""
    P = R.shape[1]
    return np.array([row[: min(v + 1, P)].mean(axis=0) for v, row in enumerate(R)])


def backward_transfer(R: Array) -> Array:
    """B(v), `[V, K]`: change of performance since a phase was last trained; below 0: worse."""
    P = R.shape[1]
    return _over_earlier_phases(R, lambda v, j: R[v, j] - R[v - 1 - (v - 1 - j) % P, j])


def forgetting(R: Array) -> Array:
    """F(v), `[V, K]`: fall of performance below its best so far; negative where it is the best."""
    return _over_earlier_phases(R, lambda v, j: R[:v, j].max(axis=0) - R[v, j])


def forward_transfer(R: Array, initial: Array) -> Array:
    """T, `[K]`: what was gained on phases before their first visit."""
    P = R.shape[1]
    gains = [R[j - 1, j] - initial[j] for j in range(1, P)]
    return np.asarray(np.mean(gains, axis=0)) if gains else np.full(R.shape[2], np.nan)


def relearning(R: Array) -> Array:
    """G, `[K]`: what the second visit of a phase gained on its first, after equal steps."""
    P = R.shape[1]
    if len(R) < 2 * P:
        return np.full(R.shape[2], np.nan)
    return np.asarray(np.mean([R[P + j, j] - R[j, j] for j in range(P)], axis=0))


def plasticity(M: Array, fresh: Array) -> tuple[Array, Array]:
    """Ratio and difference, `[V, K]` each, between an agent and fresh ones after equal steps."""
    V, P, _ = M.shape
    phases = np.arange(V) % P
    trained, alone = M[np.arange(V), phases], fresh[phases]
    ratio = np.divide(trained, alone, out=np.full_like(trained, np.nan), where=alone > 0.0)
    return ratio, trained - alone


def learning_transfer(visits: Array, fresh: Array) -> Array:
    """How much less regret a visit cost than a fresh agent's training, as a share of the latter."""
    alone = fresh[np.arange(len(visits)) % len(fresh)]
    return np.divide(alone - visits, alone, out=np.full_like(visits, np.nan), where=alone > 0.0)


def mean_after_first(values: Sequence[float | None]) -> float | None:
    """The mean over the visits after visit 0 of a plasticity or a learning transfer."""
    known = [each for each in values[1:] if each is not None and not math.isnan(each)]
    return float(np.mean(known)) if known else None


def _over_earlier_phases(R: Array, change: Callable[[int, int], Array]) -> Array:
    """`[V, K]` means of `change(v, j)` over phases j visited before v, other than v's own."""
    V, P, K = R.shape
    means = np.full((V, K), np.nan)
    for v in range(1, V):
        changes = [change(v, j) for j in range(min(v, P)) if j != v % P]
        if changes:
            means[v] = np.mean(changes, axis=0)
    return means
