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
from dataclasses import replace
from typing import Any

import numpy as np

from sme_registry.compiled import Engine, engine
from sme_registry.envs import arguments
from sme_registry.errors import PolicyError, SpecError
from sme_registry.evaluation import references
from sme_registry.evaluation.accumulators import WHOLE
from sme_registry.evaluation.measure import Key, Measured, Progress, Subject, measure
from sme_registry.evaluation.observation import (
    Invariance,
    ObservationReport,
    probe_layers,
)
from sme_registry.evaluation.policies import Policy, TeamPolicy, as_policy
from sme_registry.evaluation.region_report import RegionReport
from sme_registry.evaluation.regions import Observations, region_name, states
from sme_registry.evaluation.report import AgentReport, EvaluationReport
from sme_registry.evaluation.safety import SafetyReport, SafetyScore
from sme_registry.io import versions
from sme_registry.spec import (
    EvaluationProtocol,
    ProtocolFile,
    ProtocolLike,
    SMESpec,
    SpecLike,
    catalogue,
)
from sme_registry.task import Task, load, materialize


def evaluate(
    policy: Any,
    spec_or_id: SpecLike,
    protocol: ProtocolLike = "paper-v1",
    *,
    action_range: str | None = None,
    name: str | None = None,
    algorithm: str | None = None,
    progress: Progress | None = None,
) -> EvaluationReport:
    """Evaluate a policy within and out of distribution, exactly.

    Models act deterministically. Actions are clipped as the environment clips them.

    Args:
      policy: a callable from observations `[B, S + 2]` float32 (of a task with m distractors
        `[B, S + m + 2]`, what its agent sees of both first) to actions `[B, A]`; a
        Stable-Baselines3 model, or the path of its .zip (loading it can run code of its author);
        the path of an .onnx file or of an offline policy's .npz; `module:function`; or the name
        of a reference policy, such as "linear". For a team, one of these that all agents share,
        or a dict from each agent's name to its own. `as_policy` has the details.
      spec_or_id: the task: a spec, its fields, an id, a digest or a path.
      protocol: a protocol, its fields, its name in the catalogue, or the path of its file.
      action_range: the range of the policy's actions, "unit" for [0, 1] or "symmetric" for
        [−1, 1]; None takes an SB3 model's own action space, and "unit" for any other policy.
      name: what the report calls the policy.
      algorithm: the class of a model's .zip that does not tell it, such as "sb3_contrib:TQC".
      progress: called after each batch with the number of states done, and of all states.

    Returns:
      The report, with the reference policies on the same states; for a team also for each agent.

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
    progress: Progress | None = None,
) -> list[EvaluationReport | PolicyError]:
    """Evaluate many policies, each on its task, faster than one by one.

    Tasks that differ only in k, r_min, D and the horizon are evaluated in one pass.

    Args:
      policies: each policy with its task, both as in `evaluate`; `as_policy` prepares a policy that
        needs a name or an action range.
      protocol: as in `evaluate`.
      progress: called after each batch with the number of states done, and of all states; states
        that several policies share count once.

    Returns:
      For each policy the report that `evaluate` would return, bit for bit; or, where its actions
      are invalid, the error that `evaluate` would raise.

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
    """The observations in which `evaluate` asks a policy of a single agent for actions.

    Of a task with distractors, those of the regions: it is asked about other distractors as well.

    Args:
      spec_or_id, protocol: as in `evaluate`.

    Returns:
      `[regions · n, O]` float32, region after region.

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


def same_draw(spec: SMESpec) -> str:
    """The same for specs whose states, optimal actions and references are the same."""
    return spec.derive(k=1, r_min=0.0, D=0.0, horizon=1).digest


def versions_behind(oracle: Engine) -> dict[str, str]:
    """The versions of the packages that an evaluation's numbers depend on."""
    numba = ["numba"] if oracle.backend == "numba" else []
    return versions(["numpy", "scipy", "gymnasium", *numba], if_imported=_POLICY_LIBRARIES)


def _offset(progress: Progress | None, before: int, total: int) -> Progress:
    """`progress` of a part, which `before` states precede."""
    return lambda done, _: None if progress is None else progress(before + done, total)


def _evaluate_together(
    subjects: Sequence[Subject], protocol: EvaluationProtocol, progress: Progress
) -> list[EvaluationReport | PolicyError]:
    """The reports of policies on tasks of the same draw, or why there is none."""
    specs = [spec for _, spec in subjects]
    task = materialize(specs[0])
    oracle = engine(task)
    channels = {WHOLE: slice(0, task.spec.action_dim)}
    if task.spec.team is not None:
        channels |= zip(task.names, task.owned, strict=True)

    failed: dict[int, PolicyError] = {}
    measured = list(measure(subjects, task, oracle, protocol, channels, progress, failed))

    def regions(key: Key, scope: str) -> tuple[RegionReport, ...]:
        return _region_reports(measured, protocol, key, scope)

    reports: list[EvaluationReport | PolicyError] = []
    others: dict[str, dict[str, tuple[RegionReport, ...]]] = {}
    if len(failed) < len(subjects):
        others = {
            scope: {key: regions(key, scope) for key in references.names(task.spec)}
            for scope in channels
        }
    for index, (policy, spec) in enumerate(subjects):
        if index in failed:
            reports.append(failed[index])
            continue
        by_agent = {
            scope: AgentReport(regions=regions(index, scope), references=others[scope])
            for scope in channels
        }
        whole = by_agent.pop(WHOLE)
        try:
            observation = _observation_report(measured, protocol, index, policy, task, spec)
        except PolicyError as error:
            reports.append(error)
            continue
        reports.append(
            EvaluationReport(
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
                safety=_safety_report(measured, index, spec),
                observation=observation,
                versions=versions_behind(oracle),
            )
        )
    return reports


def _region_reports(
    measured: list[Measured], protocol: EvaluationProtocol, key: Key, scope: str
) -> tuple[RegionReport, ...]:
    """The regions of a policy or a reference, over the channels of a scope."""
    wd = measured[0].errors[key][scope]
    return tuple(
        errors[key][scope].report(region_name(region), edges, errors["constant_half"][scope], wd)
        for region, (edges, (errors, *_)) in enumerate(zip(protocol.edges, measured, strict=True))
    )


def _safety_report(measured: list[Measured], index: int, spec: SMESpec) -> SafetyReport | None:
    """The safety of a policy and of the references, by its task's r_min; None without safety."""
    if spec.safety is None:
        return None

    def scores(key: Key) -> tuple[SafetyScore, ...]:
        return tuple(
            each.safety[key, spec.r_min].score(region_name(region))
            for region, each in enumerate(measured)
        )

    others = {name: scores(name) for name in references.names(spec)}
    return SafetyReport(regions=scores(index), references=others)


def _observation_report(
    measured: list[Measured],
    protocol: EvaluationProtocol,
    index: int,
    policy: Policy | TeamPolicy,
    task: Task,
    spec: SMESpec,
) -> ObservationReport | None:
    """What a policy makes of its observation; None where that is the state."""
    if spec.observation is None:
        return None
    hidden = policy.hidden
    halves = [errors["constant_half"][WHOLE] for errors, *_ in measured]
    wd = measured[0].errors[index][WHOLE]
    invariance, shells = [], []
    for region, (half, each) in enumerate(zip(halves, measured, strict=True)):
        if each.distraction is not None:
            change = each.distraction.changes[index][WHOLE].relative_to(half)
            invariance.append(Invariance(name=region_name(region), invariance=change))
            shells += [errors[index][WHOLE] for errors in each.distraction.shells]
    return ObservationReport(
        invariance=tuple(invariance),
        distractor_regions=tuple(
            errors.report(f"d-{region_name(region)}", protocol.edges[region], halves[0], wd)
            for region, errors in enumerate(shells, start=1)
        ),
        probes=() if hidden is None else probe_layers(hidden, replace(task, spec=spec), protocol),
    )
