"""Retention: the matrix of a life, measured exactly, and the metrics of continual learning.

Axis letters: `V` visits, `P` phases, `K` sets of states (regions). Visit v is an occurrence of a
phase in the life, φ(v) = v mod P. Over the states of a region, with the actions a of the policy at
the end of visit v, clipped to [0, 1], and the optimal ones a*_j of phase j's task:

    M[v, j] = mean |a − a*_j| / mean |½ − a*_j|               normalised regret
    R[v, j] = 1 − M[v, j]                                     performance: 1 optimal, 0 constant ½
    A(v)    = mean over j ≤ v of R[v, j]                      average performance
    B(v)    = mean over j of R[v, j] − R[last(v, j), j]       backward transfer
    F(v)    = mean over j of max_{u<v} R[u, j] − R[v, j]      forgetting
    T       = mean over j ≥ 1 of R[j − 1, j] − R₀[j]          forward transfer
    G       = mean over j of R[P + j, j] − R[j, j]            relearning
    M[v, φ(v)] / N[φ(v)],  M[v, φ(v)] − N[φ(v)]               plasticity ratio, difference
    (O[φ(v)] − o(v)) / O[φ(v)]                                learning transfer

B and F are over the phases that were visited before v, other than φ(v); last(v, j) is the last
visit of phase j before v. R₀ is of the initial policy. N and O are the normalised and the online
regret of fresh agents, which train on one phase, and o the online regret of visits. A metric is NaN
where nothing can be compared. In visit 0 a life is a fresh agent itself, so plasticity and learning
transfer of a life are means over visits 1, 2, ….

In the last visit of a single cycle, A, B and T are ACC, BWT and FWT of Lopez-Paz & Ranzato (2017),
and A and F those of Chaudhry et al. (2018). Learning transfer is the forward transfer of Continual
World (Wołczyk et al. 2021), where the area under the curve of training is 1 − o.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from sme_registry.evaluation.evaluate import OnBatch
from sme_registry.evaluation.policies import Policy, prefixed_errors
from sme_registry.evaluation.regions import (
    BATCH_NUMBERS,
    Observations,
    batch_rows,
    region_name,
    states,
)
from sme_registry.spec import EvaluationProtocol, SMESpec, StreamSpec
from sme_registry.spec.document import Integer, Real, StrictModel, TupleOf
from sme_registry.task.draw import Array
from sme_registry.task.engine import engine
from sme_registry.task.loading import materialize_together

_Optional = TupleOf[Real | None]

LABELS = {
    "frozen_optimum": "optimum of phase 0",
    "fresh_optimum": "optimum of each phase",
    "constant": "constant ½",
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
    known = [value for value in values[1:] if value is not None and not math.isnan(value)]
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


class Retention(StrictModel):
    """A retention matrix and its metrics; the last entry of a metric by visit is of the life."""

    # `[V][P]` of the policy at the end of each visit, on each phase's task
    normalised_regret: TupleOf[TupleOf[Real]]
    # `[P]` of the initial policy; None without one
    initial_normalised_regret: TupleOf[Real] | None = None
    # `[P]` of an agent trained on that phase alone; None without them
    fresh_normalised_regret: TupleOf[Real] | None = None
    # `[V]` mean of 1 − normalised regret over the phases visited so far
    average_performance: TupleOf[Real]
    backward_transfer: _Optional  # `[V]` change of performance since a phase was last trained
    forgetting: _Optional  # `[V]` fall of performance below its best
    forward_transfer: Real | None  # gain over the initial policy on phases not visited yet
    relearning: Real | None  # gain of the second visit of a phase on its first
    # `[V]` normalised regret on the visited phase, over a fresh agent's
    plasticity_ratio: _Optional
    plasticity_difference: _Optional  # `[V]` their difference

    def with_fresh(self, fresh: Array) -> Self:
        """The same with the plasticity against fresh agents of normalised regret `[P]`."""
        M = np.array(self.normalised_regret)[..., None]
        ratio, difference = plasticity(M, fresh[:, None])
        return self.model_copy(
            update={
                "fresh_normalised_regret": tuple(fresh.tolist()),
                "plasticity_ratio": _known(ratio[:, 0]),
                "plasticity_difference": _known(difference[:, 0]),
            }
        )

    def final(self, metric: str) -> float | None:
        """A metric at the end of the life; of a plasticity the mean over visits after visit 0."""
        value = getattr(self, metric)
        if not isinstance(value, tuple):
            return None if value is None else float(value)
        if metric.startswith("plasticity"):
            return mean_after_first(value)
        return None if value[-1] is None else float(value[-1])


class StreamRegion(StrictModel):
    """One region of the states."""

    name: str  # `WD`, `OOD 1`, …; `OOD` for the mean over all shells
    epsilon_low: Real  # ε of the inner face; 0 for WD
    epsilon_high: Real  # ε of the outer face; 0 for WD
    states: Integer  # number of states
    agent: Retention  # the agent's matrix and metrics
    references: dict[str, Retention]  # the same of each reference agent, by its name in `LABELS`


def stream_regions(
    protocol: EvaluationProtocol,
    agent: Array,
    initial: Array | None,
    references: Mapping[str, Array],
) -> list[StreamRegion]:
    """The regions of regrets `[V, P, K]`, then the mean over the shells, without fresh agents."""
    edges, n = protocol.edges, protocol.states_per_region
    names = [(region_name(k), *edge, n) for k, edge in enumerate(edges)]
    names.append(("OOD", edges[1][0], edges[-1][1], n * (len(edges) - 1)))
    of_agent = _retentions(agent, initial)
    of_references = {name: _retentions(M) for name, M in references.items()}
    return [
        StreamRegion(
            name=name,
            epsilon_low=low,
            epsilon_high=high,
            states=count,
            agent=of_agent[k],
            references={name: retentions[k] for name, retentions in of_references.items()},
        )
        for k, (name, low, high, count) in enumerate(names)
    ]


def _retentions(M: Array, initial: Array | None = None) -> list[Retention]:
    """The matrix and the metrics in each region, then of the mean over the shells."""
    unknown = np.full(M.shape[1:], np.nan)
    M, before = with_shells(M), with_shells(unknown if initial is None else initial)
    R = 1.0 - M
    computed = {
        "average_performance": average_performance(R),
        "backward_transfer": backward_transfer(R),
        "forgetting": forgetting(R),
        "forward_transfer": forward_transfer(R, 1.0 - before),
        "relearning": relearning(R),
    }
    nothing = (None,) * len(M)
    return [
        Retention(
            normalised_regret=tuple(map(tuple, M[..., k].tolist())),
            initial_normalised_regret=None if initial is None else tuple(before[:, k].tolist()),
            **{name: _known(values[..., k]) for name, values in computed.items()},
            plasticity_ratio=nothing,
            plasticity_difference=nothing,
        )
        for k in range(M.shape[-1])
    ]


def with_shells(values: Array) -> Array:
    """Values `[…, K]` and their mean over the shells: `[…, K + 1]`."""
    return np.concatenate([values, values[..., 1:].mean(axis=-1, keepdims=True)], axis=-1)


def _known(values: Array) -> Any:
    """Numbers as JSON has them: None for NaN."""
    if values.ndim == 0:
        return None if math.isnan(values) else float(values)
    return tuple(None if math.isnan(value) else value for value in values.tolist())


class Actor(NamedTuple):
    policy: Policy
    phases: Sequence[int]  # on whose tasks it is measured
    where: str  # what an error calls it, such as "policies[2]"
    observed_phases: int = 0  # entries at the end of what it sees


def final_specs(stream: StreamSpec) -> tuple[SMESpec, ...]:
    """The task of each phase at its end: of a drifting one the last."""
    return tuple({segment.phase: segment.spec for segment in stream.segments}.values())


def stream_regrets(
    stream: StreamSpec,
    actors: Sequence[Actor],
    protocol: EvaluationProtocol,
    progress: OnBatch | None = None,
) -> tuple[Array, Array]:
    """Normalised regret of each actor, and of the optimum of each phase, on the phases' tasks.

    `[N, P, K]`, NaN on the phases on which an actor is not measured, and `[P, P, K]`.
    """
    specs = final_specs(stream)
    tasks = materialize_together(specs)
    keys = [spec.as_drawn.digest for spec in specs]
    oracles = {key: engine(task) for key, task in zip(keys, tasks, strict=True)}
    P, K = len(specs), len(protocol.edges)
    errors, half = np.zeros((len(actors), P, K)), np.zeros((P, K))
    of_optima = np.zeros((P, P, K))
    for index, actor in enumerate(actors):
        errors[index, [j for j in range(P) if j not in actor.phases]] = np.nan
    rows = min(map(batch_rows, specs))
    rows = max(1, min(rows, BATCH_NUMBERS // (len(oracles) * stream.action_dim)))
    count, total = 0, protocol.states_per_region * K
    for region in range(K):
        for drawn in states(protocol, region, specs[0], rows):
            batch = drawn.observation(drawn.s, specs[0].horizon)
            s = drawn.s.astype(np.float64)
            by_key = {key: oracle.optimal_action(s) for key, oracle in oracles.items()}
            optimal = [by_key[key] for key in keys]
            half[:, region] += [_distance(np.full_like(a, 0.5), a) for a in optimal]
            for j, a in enumerate(optimal):
                of_optima[j, :, region] += [_distance(a, other) for other in optimal]
            for index, actor in enumerate(actors):
                for phase, a in _actions(actor, batch):
                    errors[index, phase, region] += _distance(a, optimal[phase])
            count += len(batch)
            if progress is not None:
                progress(count, total)
    return errors / half, of_optima / half


def _actions(actor: Actor, batch: Observations) -> Iterator[tuple[int, Array]]:
    """The actor's actions `[B, A]` on each of its phases, in [0, 1]."""
    policy, phases, where, observed_phases = actor
    with prefixed_errors(where):
        if observed_phases:
            for phase in phases:
                informed = policy.in_phase(phase, observed_phases)
                yield phase, np.clip(informed(batch), 0.0, 1.0)
        else:
            a = np.clip(policy(batch.copy()), 0.0, 1.0)  # a copy: a policy may write into it
            yield from ((phase, a) for phase in phases)


def _distance(a: Array, optimal: Array) -> float:
    """Σ |a − a*| over states and channels."""
    difference = a - optimal
    return float(np.abs(difference, out=difference).sum())
