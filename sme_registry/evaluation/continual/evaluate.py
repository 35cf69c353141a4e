"""`evaluate_stream`: the policies of a life, a stream and a protocol to a report.

Fresh agents and reference agents are sequences of policies like any other: one policy for each
visit. `frozen_after_first` and `fresh_per_phase` make such sequences of trained policies; the
references of `report.LABELS` are exact, need no training, and are in every report.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from sme_registry.evaluation.continual.report import StreamReport, Visit, stream_regions
from sme_registry.evaluation.continual.retention import (
    Subject,
    final_specs,
    measure,
    prepared,
    refuse_other_count,
)
from sme_registry.evaluation.evaluate import resolve_protocol, versions_behind
from sme_registry.evaluation.measure import Progress
from sme_registry.evaluation.policies import Policy
from sme_registry.spec import ProtocolLike, StreamLike, StreamSpec
from sme_registry.task import load
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
    progress: Progress | None = None,
) -> StreamReport:
    """Evaluate an agent's life in a stream, exactly and without a rollout.

    Args:
      policies: the agent's policy at the end of each visit, in any form that `evaluate` accepts;
        of a stream with P phases and C cycles C·P of them. A policy that observes the phase is
        given the phase on whose task it is evaluated.
      stream: a stream, its fields, an id, a digest or a path.
      protocol: as in `evaluate`.
      initial: the agent's policy before training, for the forward transfer.
      fresh: for each phase the policy of an agent trained for as many steps on that phase alone,
        for the plasticity.
      action_range: as in `evaluate`, of all policies.
      name: what the report calls the agent; None takes the name of its policies, if they share it.
      algorithm: as in `evaluate`.
      progress: called after each batch with the number of states done, and of all states.

    Returns:
      The report, with the reference agents on the same states.

    Examples:
      >>> from sme_registry.evaluation import evaluate_stream
      >>> phases = [{"spec": "Default", "steps": 100}, {"spec": "Complexity10", "steps": 100}]
      >>> stream = sme_registry.StreamSpec(phases=phases)
      >>> report = evaluate_stream(["linear", "optimal"], stream, "quick-v1")  # after each visit
      >>> len(report.visits)
      2
    """
    stream = load(stream, StreamSpec)
    stream.refuse_many_visits()
    protocol = resolve_protocol(protocol)
    P = len(stream.phases)
    V = stream.cycles * P
    refuse_other_count("policies", policies, V, f"at the end of each visit ({stream.cycles} × {P})")
    if fresh is not None:
        refuse_other_count("fresh", fresh, P, "for each phase")

    def subject(policy: Any, phases: Sequence[int], where: str) -> Subject:
        return Subject(prepared(policy, stream, where, action_range, algorithm), phases, where)

    everywhere = range(P)
    subjects = [Subject(j, everywhere) for j in range(P)]
    rows: dict[int, int] = {}
    life = []
    for v, policy in enumerate(policies):
        if id(policy) not in rows:
            rows[id(policy)] = len(subjects)
            subjects.append(subject(policy, everywhere, f"policies[{v}]"))
        life.append(rows[id(policy)])
    start = len(subjects)
    if initial is not None:
        subjects.append(subject(initial, everywhere, "initial"))
    alone = len(subjects)
    for j, policy in enumerate(fresh or ()):
        subjects.append(subject(policy, [j], f"fresh[{j}]"))

    measured, oracle = measure(stream, subjects, protocol, progress)
    regions, ood = stream_regions(
        protocol,
        measured[life],
        measured[start] if initial is not None else None,
        measured[alone + np.arange(P), np.arange(P)] if fresh is not None else None,
        _references(measured[:P], V),
    )
    acting = [subjects[row].acts for row in life]
    names = {policy.name for policy in acting if isinstance(policy, Policy)}
    last = acting[-1]
    assert isinstance(last, Policy)
    digests = [each.digest for each in final_specs(stream)]
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
