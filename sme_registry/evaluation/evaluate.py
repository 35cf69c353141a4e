"""`evaluate`: a policy, a task and a protocol to a report, in one pass over batches of states.

Source: METHOD, section 3. Memory holds one batch and the states of WD to which the references are
fitted, regardless of the protocol's number of states.

The similarity depends neither on k, r_min and D, nor on the horizon except through the t/T that the
policy observes. So tasks that differ in these fields only share states, optimal actions and
references, most of the cost of an evaluation: `evaluate_many` computes them once.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from sme_registry.compiled import Engine, engine
from sme_registry.errors import PolicyError, SpecError
from sme_registry.evaluation import references
from sme_registry.evaluation.accumulators import Errors
from sme_registry.evaluation.policies import Policy, TeamPolicy, as_policy
from sme_registry.evaluation.regions import Observations, Uniform, observations
from sme_registry.evaluation.report import (
    AgentReport,
    EvaluationReport,
    RegionReport,
)
from sme_registry.io import versions
from sme_registry.spec import (
    EvaluationProtocol,
    ProtocolFile,
    ProtocolLike,
    SMESpec,
    SpecLike,
    catalogue,
)
from sme_registry.task import Task, load_spec, materialize
from sme_registry.task.draw import Array

Progress = Callable[[int, int], None]


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
      policy: a callable from observations `[B, S + 2]` float32 to actions `[B, A]`; a
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

    Raises:
      UnknownNameError, SpecError: no such task, protocol or policy, or a field out of range.
      PolicyError: the policy cannot be loaded, or its actions are invalid; names a team's agent.
      OptionError: `action_range` is invalid, or a shell is too thin for float32 observations.
      MissingDependencyError: the library that loads the policy is not installed.
      ResourceLimitError: the task would not fit in memory.
    """
    spec = load_spec(spec_or_id)
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

    Raises:
      As `evaluate`, except for invalid actions.
    """
    protocol = resolve_protocol(protocol)
    subjects: list[_Subject] = []
    groups: dict[str, list[int]] = {}
    for index, (policy, task) in enumerate(policies):
        spec = load_spec(task)
        subjects.append((as_policy(policy, spec), spec))
        groups.setdefault(same_draw(spec), []).append(index)

    reports: dict[int, EvaluationReport | PolicyError] = {}
    states = protocol.states_per_region * len(protocol.edges)
    for number, group in enumerate(groups.values()):
        done = _offset(progress, number * states, len(groups) * states)
        together = _evaluate_together([subjects[index] for index in group], protocol, done)
        reports |= zip(group, together, strict=True)
    return [reports[index] for index in range(len(subjects))]


def resolve_protocol(protocol: ProtocolLike) -> EvaluationProtocol:
    """A protocol from itself, its fields, its name in the catalogue, or the path of its file.

    Raises:
      UnknownNameError: no protocol has this name; suggests near ones.
      SpecError: a file or mapping is not a valid protocol.
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


_Subject = tuple[Policy | TeamPolicy, SMESpec]
_POLICY_LIBRARIES = ("torch", "stable_baselines3", "onnxruntime")
_WHOLE = ""  # the key of all action channels among the agents' names


class _Batch(NamedTuple):
    """States and their optimal actions: `[B, S]`, `[B, A]`.

    `observations` `[B, S + 2]` float32 are those of each horizon.
    """

    observations: dict[int, Observations]
    s: Array
    optimal: Array


# The key of a policy is its index, that of a reference its name.
_ErrorsByKey = dict[int | str, Errors]


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
    subjects: Sequence[_Subject], protocol: EvaluationProtocol, progress: Progress
) -> list[EvaluationReport | PolicyError]:
    """The reports of policies on tasks of the same draw, or why there is none."""
    specs = [spec for _, spec in subjects]
    task = materialize(specs[0])
    oracle = engine(task)
    channels = {_WHOLE: slice(0, task.spec.action_dim)}
    if task.spec.team is not None:
        channels |= zip(task.names, task.owned, strict=True)

    failed: dict[int, PolicyError] = {}
    measured = list(_measure(subjects, task, oracle, protocol, channels, progress, failed))

    def regions(key: int | str, scope: str) -> tuple[RegionReport, ...]:
        return _region_reports(measured, protocol, key, scope)

    reports: list[EvaluationReport | PolicyError] = []
    others: dict[str, dict[str, tuple[RegionReport, ...]]] = {}
    if len(failed) < len(subjects):
        others = {
            scope: {key: regions(key, scope) for key in references.NAMES} for scope in channels
        }
    for index, (policy, spec) in enumerate(subjects):
        if index in failed:
            reports.append(failed[index])
            continue
        by_agent = {
            scope: AgentReport(regions=regions(index, scope), references=others[scope])
            for scope in channels
        }
        whole = by_agent.pop(_WHOLE)
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
                versions=versions_behind(oracle),
            )
        )
    return reports


def _measure(
    subjects: Sequence[_Subject],
    task: Task,
    oracle: Engine,
    protocol: EvaluationProtocol,
    channels: dict[str, slice],
    progress: Progress,
    failed: dict[int, PolicyError],
) -> Iterator[_ErrorsByKey]:
    """The errors of the policies and of each reference, region after region.

    Writes the policies that fail to `failed`, and ends once all have.
    """
    horizons = {spec.horizon: spec for _, spec in subjects}
    fitted: references.References | None = None
    total, done = protocol.states_per_region * len(protocol.edges), 0
    for region in range(len(protocol.edges)):
        batches = _batches(horizons, oracle, protocol, region)
        if fitted is None:
            fitted, batches = _fit_references(batches, task)
        errors: _ErrorsByKey = {
            key: Errors(channels) for key in (*range(len(subjects)), *references.NAMES)
        }
        random = Uniform(protocol.seed, f"evaluation/{region}/random_action")
        for batch in batches:
            for index, unclipped in _actions(subjects, batch, failed):
                a = np.clip(unclipped, 0.0, 1.0)
                errors[index].add(a, batch.optimal, a != unclipped)
            if len(failed) == len(subjects):
                return
            others = fitted.actions(batch.s, batch.optimal, random(*batch.optimal.shape))
            for name, a in others.items():
                errors[name].add(a, batch.optimal)
            done += len(batch.s)
            progress(done, total)
        yield errors


def _actions(
    subjects: Sequence[_Subject], batch: _Batch, failed: dict[int, PolicyError]
) -> Iterator[tuple[int, Array]]:
    """The actions of each policy that has not failed, not clipped; writes those that now fail."""
    for index, (policy, spec) in enumerate(subjects):
        if index not in failed:
            try:
                # A copy, since a policy may write into its observations.
                yield index, policy(batch.observations[spec.horizon].copy())
            except PolicyError as error:
                failed[index] = error


def _region_reports(
    measured: list[_ErrorsByKey], protocol: EvaluationProtocol, key: int | str, scope: str
) -> tuple[RegionReport, ...]:
    """The regions of a policy or a reference, over the channels of a scope."""
    return tuple(
        errors[key][scope].report(
            region, edges, errors["constant_half"][scope], measured[0][key][scope]
        )
        for region, (edges, errors) in enumerate(zip(protocol.edges, measured, strict=True))
    )


def _batches(
    horizons: dict[int, SMESpec], oracle: Engine, protocol: EvaluationProtocol, region: int
) -> Iterator[_Batch]:
    """The states of a region, with the observations that tasks of each horizon make of them."""
    of_each = [observations(protocol, region, spec) for spec in horizons.values()]
    S = next(iter(horizons.values())).state_dim
    for parts in zip(*of_each, strict=True):
        s = parts[0][:, :S].astype(np.float64)
        yield _Batch(dict(zip(horizons, parts, strict=True)), s, oracle.optimal_action(s))


def _fit_references(
    batches: Iterator[_Batch], task: Task
) -> tuple[references.References, Iterator[_Batch]]:
    """The references fitted on the first states, and all batches from the first one on."""
    count = references.fit_states(task.spec)
    first: list[_Batch] = []
    while sum(len(batch.s) for batch in first) < count and (batch := next(batches, None)):
        first.append(batch)
    s = np.concatenate([batch.s for batch in first])[:count]
    optimal = np.concatenate([batch.optimal for batch in first])[:count]
    agents = zip(task.observed, task.owned, strict=True)
    return references.fit(s, optimal, agents), itertools.chain(first, batches)
