"""`evaluate`: a policy, a task and a protocol to a report, in one pass over batches of states.

Source: METHOD, section 3. Memory holds one batch and the states of WD to which the references are
fitted, regardless of the protocol's number of states.

The similarity depends neither on k, r_min and D, nor on the horizon except through the t/T that the
policy observes. So tasks that differ in these fields only share states, optimal actions and
references, most of the cost of an evaluation: `evaluate_many` computes them once.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from sme_registry.compiled import Engine
from sme_registry.envs import arguments
from sme_registry.errors import PolicyError, SpecError
from sme_registry.evaluation import references
from sme_registry.evaluation.measure import WHOLE, Measurement, OnBatch, Subject, same_draw
from sme_registry.evaluation.policies import as_policy
from sme_registry.evaluation.regions import Observations, states
from sme_registry.evaluation.report import AgentReport, EvaluationReport, RegionReport
from sme_registry.io import versions
from sme_registry.spec import (
    EvaluationProtocol,
    ProtocolFile,
    ProtocolLike,
    SMESpec,
    SpecLike,
    catalogue,
)
from sme_registry.task import load, materialize


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

    Models act deterministically, and actions are clipped as the environment clips them. The report
    has the reference policies on the same states; for a team also each agent.

    Args:
      policy: in any form of `as_policy`: a callable from observations `[B, S + 2]` float32 (with
        m distractors `[B, S + m + 2]`) to actions `[B, A]`, a Stable-Baselines3 model or the path
        of its .zip (it can run code of its author), an .onnx or .npz file, `module:function`,
        the name of a reference such as "linear"; for a team one that all share, or a dict by agent.
      protocol: a protocol, its fields, its name in the catalogue, or the path of its file.
      action_range, name, algorithm: as in `as_policy`.
      progress: called after each batch with the number of states done, and of all states.

    Examples:
      >>> def half(observations):  # [B, 10] to [B, 4]
      ...     return np.full((len(observations), 4), 0.5)
      >>> report = sme_registry.evaluate(half, "Default", "quick-v1")
      >>> round(report.regions[0].normalised_regret, 6)  # in the cube
      1.0
    """
    spec = load(spec_or_id, SMESpec)
    protocol = resolve_protocol(protocol)
    prepared = as_policy(policy, spec, action_range=action_range, name=name, algorithm=algorithm)
    [report] = evaluate_many([(prepared, spec)], protocol, progress=progress)
    if isinstance(report, PolicyError):
        raise report
    return report


def evaluate_many(
    policies: Sequence[tuple[Any, SpecLike]],
    protocol: ProtocolLike = "paper-v1",
    *,
    progress: OnBatch | None = None,
) -> list[EvaluationReport | PolicyError]:
    """Evaluate many policies, each on its task, faster than one by one.

    Tasks that differ only in k, r_min, D and the horizon are evaluated in one pass. For each policy
    it returns the report that `evaluate` would return, bit for bit; or, where its actions are
    invalid, the error that `evaluate` would raise.

    Examples:
      >>> from sme_registry.evaluation import evaluate_many
      >>> reports = evaluate_many([("linear", "Default"), ("linear", "Interval5")], "quick-v1")
      >>> [report.spec.k for report in reports]
      [1, 5]
    """
    protocol = resolve_protocol(protocol)
    subjects: list[Subject] = []
    groups: dict[str, list[int]] = {}
    for index, (policy, task) in enumerate(policies):
        spec = load(task, SMESpec)
        subjects.append((as_policy(policy, spec), spec))
        groups.setdefault(same_draw(spec), []).append(index)

    reports: dict[int, EvaluationReport | PolicyError] = {}
    total = protocol.states_per_region * len(protocol.edges)
    for number, group in enumerate(groups.values()):
        done = _offset(progress, number * total, len(groups) * total)
        together = _evaluate_together([subjects[index] for index in group], protocol, done)
        reports |= zip(group, together, strict=True)
    return [reports[index] for index in range(len(subjects))]


def evaluation_observations(
    spec_or_id: SpecLike, protocol: ProtocolLike = "paper-v1"
) -> Observations:
    """The observations `[regions · n, O]` in which `evaluate` asks a single agent for actions.

    Of a task with distractors, those of the regions: it is asked about other distractors as well.

    Examples:
      >>> from sme_registry.evaluation import evaluation_observations
      >>> evaluation_observations("Default", {"states_per_region": 10}).shape
      (60, 10)
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
    """A protocol from itself, its fields, its name in the catalogue, or the path of its file.

    Examples:
      >>> from sme_registry.evaluation import resolve_protocol
      >>> resolve_protocol("paper-v1").states_per_region
      50000
    """
    if isinstance(protocol, EvaluationProtocol):
        return protocol
    if isinstance(protocol, dict):
        return EvaluationProtocol.from_dict(protocol)
    if not isinstance(protocol, str | os.PathLike):
        raise SpecError(f"protocol={protocol!r:.80}: must be a protocol, its name or its path.")
    path = os.fspath(protocol)
    if path.endswith(".json") or (os.sep in path and os.path.isfile(path)):
        return ProtocolFile.read(path).protocol
    return catalogue.find(ProtocolFile, path).protocol


_POLICY_LIBRARIES = ("torch", "stable_baselines3", "onnxruntime")


def versions_behind(oracle: Engine) -> dict[str, str]:
    numba = ["numba"] if oracle.backend == "numba" else []
    return versions(["numpy", "scipy", "gymnasium", *numba], if_imported=_POLICY_LIBRARIES)


def _offset(progress: OnBatch | None, before: int, total: int) -> OnBatch:
    """`progress` of a part, which `before` states precede."""
    return lambda done, _: None if progress is None else progress(before + done, total)


def _evaluate_together(
    subjects: Sequence[Subject], protocol: EvaluationProtocol, progress: OnBatch
) -> list[EvaluationReport | PolicyError]:
    """The reports of policies on tasks of the same draw, or why there is none."""
    measurement = Measurement(subjects, protocol)
    measurement.run(progress)
    others: dict[str, dict[str, tuple[RegionReport, ...]]] = {}
    if len(measurement.failed) < len(subjects):
        names = references.names(measurement.task.spec)
        others = {
            scope: {name: measurement.region_reports(name, scope) for name in names}
            for scope in measurement.channels
        }
    return [
        measurement.failed.get(index) or _report(measurement, index, others)
        for index in range(len(subjects))
    ]


def _report(
    measurement: Measurement, index: int, others: dict[str, dict[str, tuple[RegionReport, ...]]]
) -> EvaluationReport | PolicyError:
    """The report of a policy that did not fail, with those of the references by scope."""
    (policy, spec), protocol = measurement.subjects[index], measurement.protocol
    by_agent = {
        scope: AgentReport(regions=measurement.region_reports(index, scope), references=regions)
        for scope, regions in others.items()
    }
    whole = by_agent.pop(WHOLE)
    try:
        observation = measurement.observation_report(index)
    except PolicyError as error:
        return error
    return EvaluationReport(
        policy=policy.name,
        action_range=policy.action_range,
        spec=spec,
        spec_digest=spec.digest,
        task=spec.name,
        protocol=protocol,
        protocol_digest=protocol.digest,
        regions=whole.regions,
        references=whole.references,
        agents=by_agent,
        safety=measurement.safety_report(index),
        observation=observation,
        versions=versions_behind(measurement.oracle),
    )
