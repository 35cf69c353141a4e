"""`evaluate`: a policy, a task and a protocol to a report, in one pass over batches of states.

Source: METHOD, section 3. Memory holds one batch and the states of WD to which the references are
fitted, regardless of the protocol's number of states.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.compiled import Engine, engine
from sme_registry.errors import SpecError
from sme_registry.evaluation import references
from sme_registry.evaluation.policies import Policy, TeamPolicy, as_policy
from sme_registry.evaluation.regions import Observations, Uniform, observations, region_name
from sme_registry.evaluation.report import (
    AgentReport,
    ChannelReport,
    EvaluationReport,
    RegionReport,
)
from sme_registry.io import versions
from sme_registry.spec import EvaluationProtocol, ProtocolFile, ProtocolLike, SpecLike, catalogue
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
    task = materialize(spec)
    oracle = engine(task)
    channels = {_WHOLE: slice(0, spec.action_dim)}
    if spec.team is not None:
        channels |= zip(task.names, task.owned, strict=True)

    measured = list(_errors_by_region(prepared, task, oracle, protocol, channels, progress))
    reports = {scope: _report(measured, protocol, scope) for scope in channels}
    whole = reports.pop(_WHOLE)
    return EvaluationReport(
        policy=prepared.name,
        action_range=prepared.action_range,
        spec=spec,
        spec_digest=spec.digest,
        task=spec.name,
        protocol=protocol,
        protocol_digest=protocol.digest,
        regions=whole.regions,
        references=whole.references,
        agents=reports,
        versions=versions(
            ["numpy", "scipy", "gymnasium", *(["numba"] if oracle.backend == "numba" else [])],
            if_imported=_POLICY_LIBRARIES,
        ),
    )


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


_POLICY = ""  # the key of the evaluated policy among the references' names
_POLICY_LIBRARIES = ("torch", "stable_baselines3", "onnxruntime")
_WHOLE = ""  # the key of all action channels among the agents' names


class _Accumulator:
    """Mean and spread of |a − a*| over states, and its sum for each action channel, in float64."""

    def __init__(self, action_dim: int) -> None:
        self._states = 0
        self._mean = 0.0
        # Σ (‖a − a*‖₁/A − mean)², which is exactly 0 for the optimum, unlike Σ x² − n m².
        self._squares = 0.0
        self._sums = np.zeros(action_dim)
        self._clipped = 0

    def add(self, errors: Array, sums: Array, clipped: int) -> None:
        """Add a batch of |a − a*| `[B, A]` and the number of its entries that were clipped.

        `sums` `[A]` over states are computed over all channels of a task at once, so that an
        agent's channels have the same bits in its own report and in its team's.
        """
        deviations = errors.mean(axis=1)
        count, mean = len(deviations), float(deviations.mean())
        deviations -= mean
        states = self._states + count
        shift = mean - self._mean
        self._squares += float(deviations @ deviations) + shift**2 * self._states * count / states
        self._mean += shift * count / states
        self._states = states
        self._sums += sums
        self._clipped += clipped

    def report(
        self,
        region: int,
        edges: tuple[float, float],
        constant_half: _Accumulator,
        wd: _Accumulator,
    ) -> RegionReport:
        """The report of this region; `constant_half` is of the policy ½, `wd` of this one in WD."""
        similarity, wd_similarity = 1.0 - self._mean, 1.0 - wd._mean
        channels = zip(self._sums, constant_half._sums, strict=True)
        return RegionReport(
            name=region_name(region),
            epsilon_low=edges[0],
            epsilon_high=edges[1],
            states=self._states,
            similarity=similarity,
            similarity_sd=math.sqrt(self._squares / (self._states - 1)),
            mae=self._mean,
            normalised_regret=self._mean / constant_half._mean,
            similarity_decay=(wd_similarity - similarity) / wd_similarity,
            similarity_loss=100.0 * (wd_similarity - similarity),
            clipped_share=self._clipped / (self._states * len(self._sums)),
            channels=tuple(
                ChannelReport(
                    mae=float(total) / self._states, normalised_regret=float(total / half)
                )
                for total, half in channels
            ),
        )


class _Errors(dict[str, _Accumulator]):
    """A policy's errors in one region: over all action channels, and over each agent's."""

    def __init__(self, channels: dict[str, slice]) -> None:
        super().__init__(
            {scope: _Accumulator(owned.stop - owned.start) for scope, owned in channels.items()}
        )
        self._channels = channels

    def add(self, a: Array, optimal: Array, clipped: npt.NDArray[np.bool_] | None = None) -> None:
        """Add a batch: `a` `[B, A]` or `[A]`, `optimal` and `clipped` `[B, A]`."""
        errors = np.abs(a - optimal)
        sums = errors.sum(axis=0)
        for scope, owned in self._channels.items():
            count = 0 if clipped is None else int(np.count_nonzero(clipped[:, owned]))
            self[scope].add(errors[:, owned], sums[owned], count)


class _Batch(NamedTuple):
    """States and their optimal actions: `[B, S + 2]` float32, `[B, S]`, `[B, A]`."""

    observations: Observations
    s: Array
    optimal: Array


def _errors_by_region(
    policy: Policy | TeamPolicy,
    task: Task,
    oracle: Engine,
    protocol: EvaluationProtocol,
    channels: dict[str, slice],
    progress: Progress | None,
) -> Iterator[dict[str, _Errors]]:
    """The errors of the policy and of each reference, by name, region after region."""
    fitted: references.References | None = None
    total, done = protocol.states_per_region * len(protocol.edges), 0
    for region in range(len(protocol.edges)):
        batches = _batches(task, oracle, protocol, region)
        if fitted is None:
            fitted, batches = _fit_references(batches, task)
        errors = {name: _Errors(channels) for name in (_POLICY, *references.NAMES)}
        random = Uniform(protocol.seed, f"evaluation/{region}/random_action")
        for batch in batches:
            unclipped = policy(batch.observations)
            a = np.clip(unclipped, 0.0, 1.0)
            errors[_POLICY].add(a, batch.optimal, a != unclipped)
            others = fitted.actions(batch.s, batch.optimal, random(*batch.optimal.shape))
            for name, a in others.items():
                errors[name].add(a, batch.optimal)
            done += len(batch.s)
            if progress is not None:
                progress(done, total)
        yield errors


def _report(
    measured: list[dict[str, _Errors]], protocol: EvaluationProtocol, scope: str
) -> AgentReport:
    """The regions of the policy and of each reference, over the channels of a scope."""
    by_name = {
        name: tuple(
            errors[name][scope].report(
                region, edges, errors["constant_half"][scope], measured[0][name][scope]
            )
            for region, (edges, errors) in enumerate(zip(protocol.edges, measured, strict=True))
        )
        for name in measured[0]
    }
    return AgentReport(regions=by_name.pop(_POLICY), references=by_name)


def _batches(
    task: Task, oracle: Engine, protocol: EvaluationProtocol, region: int
) -> Iterator[_Batch]:
    for batch in observations(protocol, region, task.spec):
        # A copy, so that a policy that writes into its observations does not change the states.
        s = batch[:, : task.spec.state_dim].astype(np.float64)
        yield _Batch(batch, s, oracle.optimal_action(s))


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
