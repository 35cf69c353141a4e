"""The retention matrix: normalised regret of policies on the task of each phase, without a rollout.

    M[v, j] = mean |a − a*_j| / mean |½ − a*_j|      over the states of a region

a are the actions of policy v, clipped to [0, 1], and a*_j the optimal ones of phase j's task. All
phases have the same S and T, so they share their states, and a policy acts once in each state, with
the inputs of METHOD, section 3: t/T uniform and r_cum/k = 0. Only a policy that observes the phase
acts once for each: on phase j it is given phase j. The oracle runs once for each different task;
memory holds one batch. The task of a drifting phase is that of its last piece, which was in force
at the phase's end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from sme_registry.compiled import Engine, engine
from sme_registry.envs.types import Observation
from sme_registry.errors import OptionError, PolicyError, UnknownNameError
from sme_registry.evaluation.evaluate import same_draw
from sme_registry.evaluation.measure import Progress
from sme_registry.evaluation.policies import Policy, as_policy
from sme_registry.evaluation.regions import BATCH_NUMBERS, batch_rows, states
from sme_registry.spec import EvaluationProtocol, SMESpec, StreamSpec
from sme_registry.task import materialize_together
from sme_registry.task.draw import Array


class Subject(NamedTuple):
    """What is measured."""

    acts: Policy | int
    phases: Sequence[int]
    where: str = ""


def final_specs(stream: StreamSpec) -> tuple[SMESpec, ...]:
    """The task of each phase at its end: of a drifting one the spec of its last piece."""
    return tuple({piece.phase: piece.spec for piece in stream.pieces}.values())


def prepared(
    policy: Any,
    stream: StreamSpec,
    where: str,
    action_range: str | None = None,
    algorithm: str | None = None,
) -> Policy:
    """A policy in any form, ready for a stream's observations; see `as_policy`."""
    try:
        ready = as_policy(
            policy,
            stream.phases[0].spec,
            action_range=action_range,
            algorithm=algorithm,
            observed_phases=stream.observed_phases,
        )
    except (PolicyError, UnknownNameError) as error:
        raise type(error)(f"{where}: {error}") from error.__cause__
    assert isinstance(ready, Policy)  # streams have no teams
    return ready


def refuse_other_count(name: str, policies: Any, count: int, which: str) -> None:
    """Raise OptionError unless an argument is a sequence of so many policies."""
    if not isinstance(policies, Sequence) or isinstance(policies, str) or len(policies) != count:
        given = f"{len(policies)} of them" if isinstance(policies, list | tuple) else repr(policies)
        raise OptionError(f"{name}={given:.60}: must be {count} policies, one {which}.")


def measure(
    stream: StreamSpec,
    subjects: Sequence[Subject],
    protocol: EvaluationProtocol,
    progress: Progress | None = None,
) -> tuple[Array, Engine]:
    """The normalised regret of each subject on each of its phases, in every region."""
    specs = final_specs(stream)
    tasks = materialize_together(stream, specs)
    keys = [same_draw(spec) for spec in specs]
    oracles = {key: engine(task) for key, task in zip(keys, tasks, strict=True)}
    N, P, K = len(subjects), len(specs), len(protocol.edges)
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
            for index, subject in enumerate(subjects):
                for phase, a in _actions(subject, batch, optimal, stream):
                    errors[index, phase, region] += _distance(a, optimal[phase])
            done += len(batch)
            if progress is not None:
                progress(done, total)
    unmeasured = np.ones((N, P), dtype=bool)
    for index, subject in enumerate(subjects):
        unmeasured[index, list(subject.phases)] = False
    errors[unmeasured] = np.nan
    return errors / of_half, oracles[keys[0]]


def _actions(
    subject: Subject, batch: Observation, optimal: Sequence[Array], stream: StreamSpec
) -> Iterator[tuple[int, Array]]:
    """The subject's actions `[B, A]` on each of its phases, in [0, 1]."""
    acts = subject.acts
    if isinstance(acts, int):
        yield from ((phase, optimal[acts]) for phase in subject.phases)
    elif stream.observes_phase:
        for phase in subject.phases:
            shown = acts.in_phase(phase, stream.observed_phases)
            yield phase, _acted(shown, batch, subject.where)
    else:
        a = _acted(acts, batch.copy(), subject.where)  # a copy: a policy may write into it
        yield from ((phase, a) for phase in subject.phases)


def _acted(policy: Policy, observations: Observation, where: str) -> Array:
    try:
        return np.clip(policy(observations), 0.0, 1.0)
    except PolicyError as error:
        raise PolicyError(f"{where}: {error}") from error.__cause__


def _distance(a: Array, optimal: Array) -> float:
    """Σ |a − a*| over states and channels."""
    difference = a - optimal
    return float(np.abs(difference, out=difference).sum())
