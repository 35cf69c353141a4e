"""`measure`: policies and references in every region, batch by batch.

Policies whose tasks have the same draw share states, optimal actions and references.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.compiled import Engine
from sme_registry.compiled.network import network
from sme_registry.errors import PolicyError
from sme_registry.evaluation import references
from sme_registry.evaluation.accumulators import Errors
from sme_registry.evaluation.observation import Distraction
from sme_registry.evaluation.policies import Policy, TeamPolicy
from sme_registry.evaluation.regions import Observations, States, Uniform, batch_rows, states
from sme_registry.evaluation.safety import SafetyAccumulator
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.task import Task
from sme_registry.task.draw import Array

Progress = Callable[[int, int], None]

Subject = tuple[Policy | TeamPolicy, SMESpec]
"""A policy and its task."""

Key = int | str
"""The index of a policy, or the name of a reference."""


class _Batch(NamedTuple):
    """A batch of states, and what is the same for all policies in them."""

    states: States
    observations: dict[int, Observations]
    s: Array
    optimal: Array
    limit: Array | None

    def shown(self, x: npt.NDArray[Any]) -> dict[int, Observations]:
        """The observations of each horizon, of what agents see `[B, S + m]`."""
        return {T: self.states.observation(x, T) for T in self.observations}


class Measured(NamedTuple):
    """What was measured in one region."""

    errors: dict[Key, Errors]
    tasks: dict[float, Task]
    safety: dict[tuple[Key, float], SafetyAccumulator]
    distraction: Distraction | None

    @classmethod
    def begin(
        cls,
        subjects: Sequence[Subject],
        task: Task,
        protocol: EvaluationProtocol,
        region: int,
        channels: dict[str, slice],
    ) -> Measured:
        """Nothing measured yet; the arguments are those of `measure`."""
        keys: list[Key] = [*range(len(subjects)), *references.names(task.spec)]
        subjects_with_limits = () if task.spec.safety is None else subjects
        tasks = {spec.r_min: replace(task, spec=spec) for _, spec in subjects_with_limits}
        return cls(
            errors={key: Errors(channels) for key in keys},
            tasks=tasks,
            safety={
                (key, r_min): SafetyAccumulator(own) for key in keys for r_min, own in tasks.items()
            },
            distraction=Distraction(task, protocol, region, len(subjects))
            if task.spec.distractors
            else None,
        )

    def add_policies(
        self, batch: _Batch, subjects: Sequence[Subject], failed: dict[int, PolicyError]
    ) -> dict[Key, Array]:
        """Add a batch of the policies; their actions `[B, A]` in [0, 1]."""
        actions: dict[Key, Array] = {}
        for index, unclipped in _actions(subjects, batch.observations, failed):
            a = actions[index] = np.clip(unclipped, 0.0, 1.0)
            self.errors[index].add(a, batch.optimal, a != unclipped)

        def act(x: npt.NDArray[Any]) -> Iterator[tuple[int, Array]]:
            return _actions(subjects, batch.shown(x), failed)

        if self.distraction is not None:
            self.distraction.add(batch.states, batch.optimal, actions, act)
        return actions

    def add_safety(self, batch: _Batch, actions: Mapping[Any, Array]) -> None:
        """Add a batch of the policies and references, `[B, A]` or `[A]` in [0, 1]."""
        if batch.limit is None:
            return
        for r_min, task in self.tasks.items():
            safe_reward = task.safe_reward_of(batch.optimal, batch.limit)
            for key, a in actions.items():
                self.safety[key, r_min].add(a, batch.optimal, batch.limit, safe_reward)


def measure(
    subjects: Sequence[Subject],
    task: Task,
    oracle: Engine,
    protocol: EvaluationProtocol,
    channels: dict[str, slice],
    progress: Progress,
    failed: dict[int, PolicyError],
) -> Iterator[Measured]:
    """What is measured of the policies and of each reference, region after region."""
    horizons = sorted({spec.horizon for _, spec in subjects})
    fitted: references.References | None = None
    total, done = protocol.states_per_region * len(protocol.edges), 0
    for region in range(len(protocol.edges)):
        known: list[Array] = []
        if fitted is None:
            fitted, known = _fit_references(task, oracle, protocol)
        batches = _batches(task, oracle, protocol, region, horizons, known)
        measured = Measured.begin(subjects, task, protocol, region, channels)
        random = Uniform(protocol.seed, f"evaluation/{region}/random_action")
        for batch in batches:
            actions = measured.add_policies(batch, subjects, failed)
            if len(failed) == len(subjects):
                return
            others = fitted.actions(batch.s, batch.optimal, random(*batch.optimal.shape))
            if batch.limit is not None:
                others |= references.safe_actions(task.spec, batch.optimal, batch.limit)
            for name, a in others.items():
                measured.errors[name].add(a, batch.optimal)
            everyone: dict[Any, Array] = {**actions, **others}
            measured.add_safety(batch, everyone)
            done += len(batch.s)
            progress(done, total)
        yield measured


def _actions(
    subjects: Sequence[Subject],
    observations: dict[int, Observations],
    failed: dict[int, PolicyError],
) -> Iterator[tuple[int, Array]]:
    """The actions of each policy that has not failed, not clipped; writes those that now fail."""
    for index, (policy, spec) in enumerate(subjects):
        if index not in failed:
            try:
                # A copy, since a policy may write into its observations.
                yield index, policy(observations[spec.horizon].copy())
            except PolicyError as error:
                failed[index] = error


def _batches(
    task: Task,
    oracle: Engine,
    protocol: EvaluationProtocol,
    region: int,
    horizons: Sequence[int],
    known: Iterable[Array],
) -> Iterator[_Batch]:
    """The states of a region, with the observations that tasks of each horizon make of them."""
    limit_of = _limit(task, oracle) if task.spec.safety is not None else lambda s: None
    known = iter(known)
    for drawn in states(protocol, region, task.spec):
        x, s = drawn.seen(task), drawn.s.astype(np.float64)
        shown = {T: drawn.observation(x, T) for T in horizons}
        optimal = next(known, None)
        if optimal is None:
            optimal = oracle.optimal_action(s)
        yield _Batch(drawn, shown, s, optimal, limit_of(s))


def _limit(task: Task, oracle: Engine) -> Callable[[Array], Array]:
    """ℓ of states `[B, S]`, by machine code where the oracle is."""
    if oracle.backend == "numpy":
        return task.limit
    v = network(task.limiting)
    return lambda s: task.limit_of(v(np.ascontiguousarray(s.T)).T)


def _fit_references(
    task: Task, oracle: Engine, protocol: EvaluationProtocol
) -> tuple[references.References, list[Array]]:
    """The references fitted on the first states of WD, and the π* `[B, A]` of their batches."""
    count, rows = references.fit_states(task.spec), batch_rows(task.spec)
    s, optimal = [], []
    for drawn in states(protocol, 0, task.spec.derive(observation=None), rows):
        s.append(drawn.s.astype(np.float64))
        optimal.append(oracle.optimal_action(s[-1]))
        if rows * len(s) >= count:
            break
    agents = zip(task.observed, task.owned, strict=True)
    first = np.concatenate(s)[:count], np.concatenate(optimal)[:count]
    return references.fit(*first, agents), optimal
