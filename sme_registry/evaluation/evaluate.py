"""`evaluate`: a policy, a task and a protocol to a report, in one pass over batches of states.

Source: METHOD, sections 3, 8 and 9. States, optimal actions and references, most of the cost,
depend neither on k, r_min and D nor on the horizon: `evaluate_many` computes them once for all
tasks that differ in these fields only. With d, d' independent distractors, uniform in the cube:

    sensitivity        mean |a(s, d) − a(s, d')| / mean |½ − a*(s)|      0: it ignores distractors
    d-OOD m            the regions of a report with s in the cube and d in shell m
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.envs import arguments
from sme_registry.errors import PolicyError, SpecError
from sme_registry.evaluation import references
from sme_registry.evaluation.policies import Policy, TeamPolicy, as_policy
from sme_registry.evaluation.regions import (
    ObservationReport,
    Observations,
    Points,
    RegionReport,
    SafetyReport,
    SafetyScore,
    SafetyStats,
    ScopedErrors,
    Sensitivity,
    States,
    Uniform,
    batch_rows,
    probe_layers,
    region_name,
    states,
)
from sme_registry.evaluation.report import AgentReport, EvaluationReport
from sme_registry.io import versions
from sme_registry.spec import EvaluationProtocol, ProtocolFile, SMESpec, catalogue
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.spec.suite import ProtocolLike
from sme_registry.task import Task, load, materialize
from sme_registry.task.draw import Array
from sme_registry.task.engine import chosen_backend, engine, network

WHOLE = ""
"""The scope of all action channels, among the agents' names."""

_POLICY_LIBRARIES = ("torch", "stable_baselines3", "onnxruntime")

OnBatch = Callable[[int, int], None]
"""Called with the number of states done, and of all states."""

Subject = tuple[Policy | TeamPolicy, SMESpec]
"""A policy and its task."""

_MANY, _FEW_STATES = 0.2, 1000

Key = int | str
"""The index of a policy, or the name of a reference."""


def evaluate(
    policy: Any,
    spec_or_id: SpecLike,
    protocol: ProtocolLike = "paper-v1",
    *,
    action_range: str | None = None,
    name: str | None = None,
    algorithm: str | None = None,
    progress: OnBatch | None = None,
) -> EvaluationReport:
    """Evaluate a policy within and out of distribution, exactly.

    The policy is a callable from observations `[B, S + 2]` float32 to actions `[B, A]`, or in any
    other form of `as_policy`, which explains the other arguments. Models act deterministically, and
    actions are clipped as the environment clips them. The report has the reference policies on the
    same states; for a team also each agent. `progress` is called after each batch with the number
    of states done, and of all states.

    Examples:
      >>> def half(observations):  # [B, 10] to [B, 4]
      ...     return np.full((len(observations), 4), 0.5)
      >>> report = sme_registry.evaluate(half, "Default", "quick-v1")
      >>> round(report.regions[0].normalised_regret, 6)  # in the cube
      1.0
    """
    spec = load(spec_or_id, SMESpec)
    prepared = as_policy(policy, spec, action_range=action_range, name=name, algorithm=algorithm)
    [report] = evaluate_many([(prepared, spec)], protocol, progress=progress)
    if isinstance(report, PolicyError):
        raise report
    if action_range is None and policy is not prepared and acts_below_range(prepared, report):
        arguments.warn_of_clipping()
    return report


def acts_below_range(policy: Policy | TeamPolicy, report: EvaluationReport) -> bool:
    """Whether over 20 % of the entries of actions in WD are clipped at 0, as those of tanh are."""
    clipped = report.regions[0].clipped_share
    if isinstance(policy, TeamPolicy) or report.action_range != "unit" or clipped <= _MANY:
        return False
    few = EvaluationProtocol(states_per_region=_FEW_STATES)
    drawn = next(iter(states(few, 0, report.spec)))
    seen = drawn.seen(materialize(report.spec))
    actions = policy.start()(drawn.observation(seen, report.spec.horizon))
    return float((actions < 0.0).mean()) > _MANY


def evaluate_many(
    policies: Sequence[tuple[Any, SpecLike]],
    protocol: ProtocolLike = "paper-v1",
    *,
    progress: OnBatch | None = None,
) -> list[EvaluationReport | PolicyError]:
    """Evaluate many policies, each on its task, faster than one by one.

    For each policy it returns the report that `evaluate` would return, bit for bit; or, where its
    actions are invalid, the error that `evaluate` would raise.

    Examples:
      >>> from sme_registry.evaluation import evaluate_many
      >>> reports = evaluate_many([("linear", "Default"), ("linear", "Interval5")], "quick-v1")
      >>> [report.spec.k for report in reports]
      [1, 5]
    """
    protocol = resolve_protocol(protocol)
    groups: dict[str, dict[int, Subject]] = {}
    for index, (policy, task) in enumerate(policies):
        spec = load(task, SMESpec)
        groups.setdefault(spec.as_drawn.digest, {})[index] = as_policy(policy, spec), spec

    reports: dict[int, EvaluationReport | PolicyError] = {}
    states_of_each = protocol.states_per_region * len(protocol.edges)
    for number, group in enumerate(groups.values()):
        measurement = Measurement(list(group.values()), protocol)
        for count in measurement.run():
            if progress is not None:
                progress(number * states_of_each + count, len(groups) * states_of_each)
        reports |= {index: measurement.report(i) for i, index in enumerate(group)}
    return [reports[index] for index in range(len(policies))]


def evaluation_observations(
    spec_or_id: SpecLike, protocol: ProtocolLike = "paper-v1"
) -> Observations:
    """The observations `[regions · n, O]` in which `evaluate` asks a single agent for actions.

    Of a task with distractors, those of the regions: it is asked about other distractors as well.
    """
    task, protocol = materialize(load(spec_or_id, SMESpec)), resolve_protocol(protocol)
    arguments.single_agent(task)
    return np.concatenate(
        [
            drawn.observation(drawn.seen(task), task.spec.horizon)
            for region in range(len(protocol.edges))
            for drawn in states(protocol, region, task.spec)
        ]
    )


def resolve_protocol(protocol: ProtocolLike) -> EvaluationProtocol:
    """A protocol from itself, its fields, its name in the catalogue, or the path of its file."""
    if isinstance(protocol, EvaluationProtocol):
        return protocol
    if isinstance(protocol, dict):
        return EvaluationProtocol.from_dict(protocol)
    if not isinstance(protocol, str | os.PathLike):
        raise SpecError(f"protocol={protocol!r:.80}: must be a protocol, its name or its path.")
    return catalogue.find(ProtocolFile, protocol).protocol


def versions_behind() -> dict[str, str]:
    numba = ["numba"] if chosen_backend() == "numba" else []
    return versions(["numpy", "scipy", "gymnasium", *numba], if_imported=_POLICY_LIBRARIES)


class _Region(NamedTuple):
    """What was measured in a region, of each policy and reference."""

    errors: dict[Key, ScopedErrors]
    safety: dict[tuple[Key, float], SafetyStats]  # by r_min; empty without safety
    distraction: _Distraction


class Measurement:
    """Policies on tasks of one draw, and the references, in every region of a protocol."""

    def __init__(self, subjects: Sequence[Subject], protocol: EvaluationProtocol) -> None:
        self._subjects, self._protocol = subjects, protocol
        self._task = task = materialize(subjects[0][1])
        self._oracle = engine(task)
        self._references = references.names(task.spec)
        self._channels = {WHOLE: slice(0, task.spec.action_dim)}
        if task.spec.team is not None:
            self._channels |= zip(task.names, task.owned, strict=True)
        self._failed: dict[int, PolicyError] = {}
        self._regions: list[_Region] = []
        self._horizons = sorted({spec.horizon for _, spec in subjects})
        self._limited = {
            spec.r_min: replace(task, spec=spec) for _, spec in subjects if spec.safety is not None
        }

    def run(self) -> Iterator[int]:
        """Measure region after region, or until all policies have failed: the states so far."""
        fitted, first = self._fit_references()
        count = 0
        for region in range(len(self._protocol.edges)):
            measured = self._begin(region)
            for drawn, known in self._batches(region, fitted, first):
                actions = self._add_policies(measured, drawn, known.optimal)
                if len(self._failed) == len(self._subjects):
                    return
                others = references.actions(known, self._references)
                for name, a in others.items():
                    measured.errors[name].add(a, known.optimal)
                self._add_safety(measured, known, {**actions, **others})
                count += len(known.s)
                yield count
            self._regions.append(measured)

    def report(self, index: int) -> EvaluationReport | PolicyError:
        """The report of a policy, or the error with which it failed."""
        if index in self._failed:
            return self._failed[index]
        policy, spec = self._subjects[index]
        by_agent = {
            scope: AgentReport(regions=self._region_reports(index, scope), references=regions)
            for scope, regions in self._reference_reports.items()
        }
        whole = by_agent.pop(WHOLE)
        try:
            observation = self._observation_report(index)
        except PolicyError as error:
            return error
        return EvaluationReport(
            policy=policy.name,
            action_range=policy.action_range,
            spec=spec,
            spec_digest=spec.digest,
            task=spec.name,
            protocol=self._protocol,
            protocol_digest=self._protocol.digest,
            regions=whole.regions,
            references=whole.references,
            agents=by_agent,
            safety=self._safety_report(index),
            observation=observation,
            versions=versions_behind(),
        )

    def _begin(self, region: int) -> _Region:
        keys: list[Key] = [*range(len(self._subjects)), *self._references]
        return _Region(
            errors={key: ScopedErrors(self._channels) for key in keys},
            safety={
                (key, r_min): SafetyStats(task)
                for key in keys
                for r_min, task in self._limited.items()
            },
            distraction=_Distraction(self._task, self._protocol, region, len(self._subjects)),
        )

    def _add_policies(self, measured: _Region, drawn: States, optimal: Array) -> dict[Any, Array]:
        """Add a batch of the policies; their actions `[B, A]` in [0, 1]."""
        actions: dict[Any, Array] = {}
        act = functools.partial(self._actions, drawn)
        for index, unclipped in act(drawn.seen(self._task)):
            a = actions[index] = np.clip(unclipped, 0.0, 1.0)
            measured.errors[index].add(a, optimal, a != unclipped)
        if self._task.spec.distractors:
            measured.distraction.add(drawn, optimal, actions, act)
        return actions

    def _add_safety(
        self, measured: _Region, known: references.Knowledge, actions: dict[Any, Array]
    ) -> None:
        """Add a batch of the policies and references, `[B, A]` or `[A]` in [0, 1]."""
        for r_min, task in self._limited.items():
            safe_reward = task.safe_reward_of(known.optimal, known.limit)
            for key, a in actions.items():
                measured.safety[key, r_min].add(a, known.optimal, known.limit, safe_reward)

    def _actions(self, drawn: States, x: npt.NDArray[Any]) -> Iterator[tuple[int, Array]]:
        """The actions, not clipped, of each policy that has not failed, where agents see x."""
        observations = {T: drawn.observation(x, T) for T in self._horizons}
        for index, (policy, spec) in enumerate(self._subjects):
            if index not in self._failed:
                try:
                    # A copy, since a policy may write into its observations.
                    yield index, policy(observations[spec.horizon].copy())
                except PolicyError as error:
                    self._failed[index] = error

    def _batches(
        self, region: int, fitted: references.References, first: Iterator[Array]
    ) -> Iterator[tuple[States, references.Knowledge]]:
        """The states of a region and what is known of them; `first` is π* of the first batches."""
        random = Uniform(self._protocol.seed, f"evaluation/{region}/random_action")
        for drawn in states(self._protocol, region, self._task.spec):
            s = drawn.s.astype(np.float64)
            optimal = next(first, None)
            if optimal is None:
                optimal = self._oracle.optimal_action(s)
            limit = self._limit_of(s)
            yield drawn, references.Knowledge(self._task, s, lambda: fitted, random, optimal, limit)

    @functools.cached_property
    def _limit_of(self) -> Callable[[Array], Array]:
        """ℓ of states `[B, S]`, by machine code where the oracle is; `[B, 0]` without safety."""
        task = self._task
        if not self._limited:
            return lambda s: np.empty((len(s), 0))
        if self._oracle.backend == "numpy":
            return task.limit
        v = network(task.limiting)
        return lambda s: task.limit_of(v(np.ascontiguousarray(s.T)).T)

    def _fit_references(self) -> tuple[references.References, Iterator[Array]]:
        """The references fitted on the first states of WD, and the π* `[B, A]` of their batches."""
        task = self._task
        count, rows = references.fit_states(task.spec), batch_rows(task.spec)
        s, optimal = [], []
        # Without what else an observation shows, which would not fit in memory.
        for drawn in states(self._protocol, 0, task.spec.derive(observation=None), rows):
            s.append(drawn.s.astype(np.float64))
            optimal.append(self._oracle.optimal_action(s[-1]))
            if rows * len(s) >= count:
                break
        fitted = references.fit(task, np.concatenate(s)[:count], np.concatenate(optimal)[:count])
        return fitted, iter(optimal)

    @functools.cached_property
    def _reference_reports(self) -> dict[str, dict[str, tuple[RegionReport, ...]]]:
        """The regions of the references, by scope and name."""
        return {
            scope: {name: self._region_reports(name, scope) for name in self._references}
            for scope in self._channels
        }

    def _region_reports(self, key: Key, scope: str) -> tuple[RegionReport, ...]:
        """The regions of a policy or a reference, over the channels of a scope."""
        wd = self._regions[0].errors[key][scope]
        return tuple(
            measured.errors[key][scope].report(
                region_name(region), edges, measured.errors["constant"][scope], wd
            )
            for region, (edges, measured) in enumerate(
                zip(self._protocol.edges, self._regions, strict=True)
            )
        )

    def _safety_report(self, index: int) -> SafetyReport | None:
        """The safety of a policy and of the references, by its r_min; None without safety."""
        if not self._limited:
            return None
        r_min = self._subjects[index][1].r_min

        def scores(key: Key) -> tuple[SafetyScore, ...]:
            return tuple(
                measured.safety[key, r_min].score(region_name(region))
                for region, measured in enumerate(self._regions)
            )

        others = {name: scores(name) for name in self._references}
        return SafetyReport(regions=scores(index), references=others)

    def _observation_report(self, index: int) -> ObservationReport | None:
        """What a policy makes of its observation; None where that is the state."""
        policy, spec = self._subjects[index]
        if spec.observation is None:
            return None
        halves = [measured.errors["constant"][WHOLE] for measured in self._regions]
        wd = self._regions[0].errors[index][WHOLE]
        sensitivity, shells = [], []
        for region, measured in enumerate(self._regions if spec.distractors else ()):
            change = measured.distraction.changes[index][WHOLE].relative_to(halves[region])
            sensitivity.append(Sensitivity(name=region_name(region), sensitivity=change))
            shells += [errors[index][WHOLE] for errors in measured.distraction.shells]
        return ObservationReport(
            sensitivity=tuple(sensitivity),
            distractor_regions=tuple(
                errors.report(f"d-{region_name(m)}", self._protocol.edges[m], halves[0], wd)
                for m, errors in enumerate(shells, start=1)
            ),
            probes=probe_layers(policy.hidden, replace(self._task, spec=spec), self._protocol)
            if policy.hidden
            else (),
        )


class _Distraction:
    """The errors of policies under other distractors, in the states of one region.

    `changes` are |a(s, d') − a(s, d)| of each policy; `shells`, only in WD, its errors with d in
    shell 1, 2, ….
    """

    def __init__(self, task: Task, protocol: EvaluationProtocol, region: int, policies: int):
        self._task, m = task, task.spec.distractors
        self._others = Uniform(protocol.seed, f"evaluation/{region}/other_distractors")
        outside = range(1, len(protocol.edges)) if region == 0 and m else ()
        self._outside = [
            Points(protocol, shell, m, f"evaluation/distractors/{shell}") for shell in outside
        ]
        self.changes, *self.shells = (
            [ScopedErrors({WHOLE: slice(0, task.spec.action_dim)}) for _ in range(policies)]
            for _ in range(1 + len(outside))
        )

    def add(
        self,
        drawn: States,
        optimal: Array,
        actions: Mapping[int, Array],
        act: Callable[[npt.NDArray[Any]], Iterator[tuple[int, Array]]],
    ) -> None:
        """Add a batch; `act` maps what agents see `[B, S + m]` to each policy's actions."""
        others = self._others(len(drawn.s), self._task.spec.distractors)
        for index, a in act(drawn.seen(self._task, others)):
            self.changes[index].add(np.clip(a, 0.0, 1.0), actions[index])
        for points, errors in zip(self._outside, self.shells, strict=True):
            d = points(len(drawn.s)).astype(np.float64)
            for index, unclipped in act(drawn.seen(self._task, d)):
                a = np.clip(unclipped, 0.0, 1.0)
                errors[index].add(a, optimal, a != unclipped)
