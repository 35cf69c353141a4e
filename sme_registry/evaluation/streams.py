"""`evaluate_stream`: the policies of a life, a stream and a protocol to a report.

    M[v, j] = mean |a − a*_j| / mean |½ − a*_j|      over the states of a region

a are the actions of policy v, clipped to [0, 1], and a*_j the optimal ones of phase j's task. All
phases have the same S and T, so they share their states, and a policy acts once in each state, with
the inputs of METHOD, section 3: t/T uniform and r_cum/k = 0. Only a policy that observes the phase
acts once for each: on phase j it is given phase j. The oracle runs once for each different task;
memory holds one batch. The task of a drifting phase is that of its last piece, which was in force
at the phase's end.

Fresh agents and reference agents are sequences of policies like any other: one policy for each
visit. `frozen_after_first` and `fresh_per_phase` make such sequences of trained policies; the
references of `retention.LABELS` are exact, need no training, and are in every report.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from sme_registry.compiled import Engine, engine
from sme_registry.compiled.arrays import Observation
from sme_registry.evaluation.evaluate import resolve_protocol, versions_behind
from sme_registry.evaluation.measure import OnBatch, final_specs, same_draw
from sme_registry.evaluation.policies import Policy, check_count, prefixed_errors, stream_policy
from sme_registry.evaluation.regions import BATCH_NUMBERS, batch_rows, states
from sme_registry.evaluation.stream_report import StreamReport, Visit, stream_regions
from sme_registry.spec import EvaluationProtocol, ProtocolLike, StreamLike, StreamSpec
from sme_registry.task import load, materialize_together
from sme_registry.task.draw import Array

_Any = TypeVar("_Any")


def evaluate_stream(
    policies: Sequence[Any],
    stream: StreamLike,
    protocol: ProtocolLike = "paper-v1",
    *,
    initial: Any = None,
    fresh: Sequence[Any] | None = None,
    action_range: str | None = None,
    name: str | None = None,
    algorithm: str | None = None,
    progress: OnBatch | None = None,
) -> StreamReport:
    """Evaluate an agent's life in a stream, exactly and without a rollout.

    The report has the reference agents on the same states.

    Args:
      policies: the agent's policy at the end of each visit, in any form that `evaluate` accepts.
      initial: the policy before the first visit, for the forward transfer.
      fresh: for each phase the policy of an agent trained for as many steps on that phase alone,
        for the plasticity.
      action_range, algorithm: as in `evaluate`, of all policies.
      name: what the report calls the agent; None takes the name of its policies, if they share it.

    Examples:
      >>> from sme_registry.evaluation import evaluate_stream
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> report = evaluate_stream(["linear", "optimal"], stream, "quick-v1")  # after each visit
      >>> len(report.visits)
      2
    """
    stream = load(stream, StreamSpec)
    stream.check_visits()
    protocol = resolve_protocol(protocol)
    P = len(stream.phases)
    V = stream.cycles * P
    check_count("policies", policies, V, f"at the end of each visit ({stream.cycles} × {P})")
    if fresh is not None:
        check_count("fresh", fresh, P, "for each phase")

    def actor(policy: Any, phases: Sequence[int], where: str) -> Actor:
        return Actor(stream_policy(policy, stream, where, action_range, algorithm), phases, where)

    everywhere, nowhere = range(P), Actor(0, ())
    actors = [Actor(j, everywhere) for j in range(P)]
    rows: dict[int, int] = {}  # a policy of several visits acts once
    for v, policy in enumerate(policies):
        if id(policy) not in rows:
            rows[id(policy)] = len(actors)
            actors.append(actor(policy, everywhere, f"policies[{v}]"))
    life = [rows[id(policy)] for policy in policies]
    actors.append(nowhere if initial is None else actor(initial, everywhere, "initial"))
    if fresh is None:
        actors += [nowhere] * P
    else:
        actors += [actor(policy, [j], f"fresh[{j}]") for j, policy in enumerate(fresh)]

    measured, oracle = stream_regrets(stream, actors, protocol, progress)
    *_, before = measured[:-P]
    alone = measured[np.arange(-P, 0), np.arange(P)]
    references = _references(measured[:P], V)
    regions, ood = stream_regions(protocol, measured[life], before, alone, references)
    acting = [actors[row].acts for row in life]
    names = {policy.name for policy in acting if isinstance(policy, Policy)}
    last = acting[-1]
    assert isinstance(last, Policy)
    digests = [spec.digest for spec in final_specs(stream)]
    return StreamReport(
        policy=name or (last.name if len(names) == 1 else f"{V} policies"),
        action_range=last.action_range,
        stream=stream,
        stream_digest=stream.digest,
        name=stream.name,
        protocol=protocol,
        protocol_digest=protocol.digest,
        visits=tuple(
            Visit(visit=v, cycle=v // P, phase=v % P, lifetime=end, spec_digest=digests[v % P])
            for v, end in stream.visit_ends()
        ),
        regions=regions,
        ood=ood,
        versions=versions_behind(oracle),
    )


def frozen_after_first(stream: StreamSpec, policies: Sequence[_Any]) -> list[_Any]:
    """The life of an agent that stops learning after the first visit: its policy at each visit.

    Args:
      stream: the stream.
      policies: the agent's policies at the ends of the visits, or the first of them alone.

    Examples:
      >>> from sme_registry.evaluation import frozen_after_first
      >>> stream = sme_registry.load("Cycle2")
      >>> set(frozen_after_first(stream, ["after the first visit"]))
      {'after the first visit'}
    """
    return [policies[0]] * stream.visits


def fresh_per_phase(stream: StreamSpec, fresh: Sequence[_Any]) -> list[_Any]:
    """The life of an agent that starts anew in each phase: the policy at each visit.

    Args:
      stream: the stream.
      fresh: for each phase a policy trained on that phase alone.

    Examples:
      >>> from sme_registry.evaluation import fresh_per_phase
      >>> stream = sme_registry.load("Cycle2")
      >>> fresh_per_phase(stream, ["first", "second"])[:4]
      ['first', 'second', 'first', 'second']
    """
    return [*fresh] * stream.cycles


def _references(optima: Array, visits: int) -> dict[str, Array]:
    """`[V, P, K]` of each reference agent, from the optima of the phases `[P, P, K]`."""
    P = len(optima)
    return {
        "frozen_optimum": np.repeat(optima[:1], visits, axis=0),
        "fresh_optimum": optima[np.arange(visits) % P],
        "constant_half": np.ones((visits, *optima.shape[1:])),
    }


class Actor(NamedTuple):
    acts: Policy | int  # the index of a phase whose optimum acts
    phases: Sequence[int]  # on whose tasks it is measured
    where: str = ""  # what an error calls it, such as "policies[2]"


def stream_regrets(
    stream: StreamSpec,
    actors: Sequence[Actor],
    protocol: EvaluationProtocol,
    progress: OnBatch | None = None,
) -> tuple[Array, Engine]:
    """The normalised regret of each actor on each of its phases, in every region."""
    specs = final_specs(stream)
    tasks = materialize_together(specs)
    keys = [same_draw(spec) for spec in specs]
    oracles = {key: engine(task) for key, task in zip(keys, tasks, strict=True)}
    N, P, K = len(actors), len(specs), len(protocol.edges)
    errors, of_half = np.zeros((N, P, K)), np.zeros((P, K))
    rows = min(map(batch_rows, specs))
    rows = max(1, min(rows, BATCH_NUMBERS // (len(oracles) * stream.action_dim)))
    done, total = 0, protocol.states_per_region * K
    for region in range(K):
        for drawn in states(protocol, region, specs[0], rows):
            batch = drawn.observation(drawn.s, specs[0].horizon)
            s = drawn.s.astype(np.float64)
            by_key = {key: oracle.optimal_action(s) for key, oracle in oracles.items()}
            optimal = [by_key[key] for key in keys]
            of_half[:, region] += [_distance(np.full_like(a, 0.5), a) for a in optimal]
            for index, actor in enumerate(actors):
                for phase, a in _actions(actor, batch, optimal, stream):
                    errors[index, phase, region] += _distance(a, optimal[phase])
            done += len(batch)
            if progress is not None:
                progress(done, total)
    unmeasured = np.ones((N, P), dtype=bool)
    for index, actor in enumerate(actors):
        unmeasured[index, list(actor.phases)] = False
    errors[unmeasured] = np.nan
    return errors / of_half, oracles[keys[0]]


def _actions(
    actor: Actor, batch: Observation, optimal: Sequence[Array], stream: StreamSpec
) -> Iterator[tuple[int, Array]]:
    """The actor's actions `[B, A]` on each of its phases, in [0, 1]."""
    acts = actor.acts
    if isinstance(acts, int):
        yield from ((phase, optimal[acts]) for phase in actor.phases)
    elif stream.observes_phase:
        for phase in actor.phases:
            shown = acts.in_phase(phase, stream.observed_phases)
            yield phase, _acted(shown, batch, actor.where)
    else:
        a = _acted(acts, batch.copy(), actor.where)  # a copy: a policy may write into it
        yield from ((phase, a) for phase in actor.phases)


def _acted(policy: Policy, observations: Observation, where: str) -> Array:
    with prefixed_errors(where):
        return np.clip(policy(observations), 0.0, 1.0)


def _distance(a: Array, optimal: Array) -> float:
    """Σ |a − a*| over states and channels."""
    difference = a - optimal
    return float(np.abs(difference, out=difference).sum())
