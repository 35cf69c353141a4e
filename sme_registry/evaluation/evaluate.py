"""`evaluate`: a policy, a task and a protocol to a report. One pass of the oracle, batch by batch.

Source: METHOD, section 3. What is held at once is a batch and the states of WD that the reference
policies are fitted on, however many states a protocol asks for.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.compiled import Engine, engine
from sme_registry.errors import SpecError
from sme_registry.evaluation import references
from sme_registry.evaluation.policies import as_policy
from sme_registry.evaluation.regions import Observations, Uniform, observations
from sme_registry.evaluation.report import AgentReport, EvaluationReport, RegionReport
from sme_registry.evaluation.score import Score
from sme_registry.io import versions
from sme_registry.spec import EvaluationProtocol, ProtocolFile, SMESpec, catalogue
from sme_registry.task import Task, load_spec, materialize
from sme_registry.task.draw import Array

Progress = Callable[[int, int], None]


def evaluate(
    policy: Any,
    spec_or_id: SMESpec | dict[str, Any] | str | os.PathLike[str],
    protocol: EvaluationProtocol | dict[str, Any] | str | os.PathLike[str] = "paper-v1",
    *,
    action_range: str | None = None,
    name: str | None = None,
    progress: Progress | None = None,
) -> EvaluationReport:
    """Judge a policy within and out of distribution, exactly.

    Args:
      policy: a callable from observations `[B, S + 2]` float32 to actions `[B, A]`, a
        Stable-Baselines3 model, or the path of such a model's .zip (which can run code of whoever
        made it) or of an .onnx file. Models act deterministically. Actions are clipped as the
        environment clips them.
        For a team, a dict from each agent's name to such a policy of the agent's own, from its
        observations `[B, |O_i| + 2]` to its actions `[B, a_i]`; or one such policy that all agents
        share, asked for each in turn, from its shared observation `[B, S + 2 + n]` (see
        `envs.shared`) to `[B, max a_i]`, of which the agent's first a_i are used.
      spec_or_id: the task: a spec, its fields, an id, a digest or a path.
      protocol: a protocol, its fields, its name in the catalogue, or the path of its file.
      action_range: what the policy's actions are in, "unit" for [0, 1] or "symmetric" for
        [−1, 1]; None takes an SB3 model's own action space, and "unit" for any other policy.
      name: what the report calls the policy.
      progress: called after each batch with the states done and the states in all.

    Returns:
      The report, with the reference policies on the same states; of a team also for each agent.

    Raises:
      UnknownNameError, SpecError: no such task or protocol, or a field out of range.
      PolicyError: the policy cannot be loaded, or its actions cannot be used; of a team, whose.
      OptionError: `action_range` is none, or a shell is too thin for float32 observations.
      ResourceLimitError: the task would not fit in memory.
    """
    spec = load_spec(spec_or_id)
    protocol = resolve_protocol(protocol)
    asked = as_policy(policy, spec, action_range=action_range, name=name)
    task = materialize(spec)
    fast = engine(task)

    agents = list(zip(task.names, task.owned, strict=True)) if spec.team is not None else []
    scopes = {_WHOLE: slice(0, spec.action_dim), **dict(agents)}

    regions = []
    fitted: references.References | None = None
    total, done = protocol.states_per_region * len(protocol.edges), 0
    for region in range(len(protocol.edges)):
        batches = _solved(task, fast, protocol, region)
        if fitted is None:
            fitted, batches = _fitted_on(batches, task)
        scores = {who: _Scores(scopes) for who in (_POLICY, *references.NAMES)}
        random = Uniform(protocol.seed, f"evaluation/{region}/random_action")
        for batch in batches:
            acted = asked(batch.observations)
            a = np.clip(acted, 0.0, 1.0)
            scores[_POLICY].add(a, batch.optimal, a != acted)
            others = fitted.actions(batch.s, batch.optimal, random(*batch.optimal.shape))
            for who, a in others.items():
                scores[who].add(a, batch.optimal)
            done += len(batch.s)
            if progress is not None:
                progress(done, total)
        regions.append(scores)

    def reports(scope: str) -> dict[str, tuple[RegionReport, ...]]:
        """Of the policy and each reference, over these channels."""
        return {
            who: tuple(
                scores[who][scope].report(
                    region, edges, scores["constant_half"][scope], regions[0][who][scope]
                )
                for region, (edges, scores) in enumerate(zip(protocol.edges, regions, strict=True))
            )
            for who in regions[0]
        }

    whole, of_agents = reports(_WHOLE), {name: reports(name) for name, _ in agents}
    return EvaluationReport(
        policy=asked.name,
        action_range=asked.action_range,
        spec=spec,
        spec_digest=spec.digest,
        protocol=protocol,
        protocol_digest=protocol.digest,
        regions=whole.pop(_POLICY),
        references=whole,
        agents={
            name: AgentReport(regions=own.pop(_POLICY), references=own)
            for name, own in of_agents.items()
        },
        versions=versions(
            ["numpy", "scipy", "gymnasium", *(["numba"] if fast.backend == "numba" else [])],
            if_imported=_POLICY_LIBRARIES,
        ),
    )


def resolve_protocol(
    protocol: EvaluationProtocol | dict[str, Any] | str | os.PathLike[str],
) -> EvaluationProtocol:
    """The protocol that is meant: itself, its fields, its name in the catalogue, or a file's path.

    Raises:
      UnknownNameError: nothing has this name; says what is near.
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


_POLICY = ""  # the key of the policy in question among the references' names
_POLICY_LIBRARIES = ("torch", "stable_baselines3", "onnxruntime")
_WHOLE = ""  # the key of all action channels among the agents' names


class _Scores(dict[str, Score]):
    """One policy's scores in one region: over all action channels, and over each agent's own."""

    def __init__(self, scopes: dict[str, slice]) -> None:
        super().__init__({name: Score(own.stop - own.start) for name, own in scopes.items()})
        self._scopes = scopes

    def add(self, a: Array, optimal: Array, clipped: npt.NDArray[np.bool_] | None = None) -> None:
        """Count a batch in: `a` `[B, A]` or `[A]`, `optimal` and `clipped` `[B, A]`."""
        missed = np.abs(a - optimal)
        sums = missed.sum(axis=0)
        for name, own in self._scopes.items():
            outside = 0 if clipped is None else int(np.count_nonzero(clipped[:, own]))
            self[name].add(missed[:, own], sums[own], outside)


class _Batch(NamedTuple):
    """States and their optimal actions: `[B, S + 2]` float32, `[B, S]`, `[B, A]`."""

    observations: Observations
    s: Array
    optimal: Array


def _solved(
    task: Task, fast: Engine, protocol: EvaluationProtocol, region: int
) -> Iterator[_Batch]:
    for batch in observations(protocol, region, task.spec):
        # A copy, which a policy that writes into its observations cannot reach.
        s = batch[:, : task.spec.state_dim].astype(np.float64)
        yield _Batch(batch, s, fast.optimal_action(s))


def _fitted_on(
    batches: Iterator[_Batch], task: Task
) -> tuple[references.References, Iterator[_Batch]]:
    """The references fitted on the first states, and all batches again from the first one."""
    wanted = references.fit_states(task.spec)
    kept: list[_Batch] = []
    while sum(len(batch.s) for batch in kept) < wanted and (batch := next(batches, None)):
        kept.append(batch)
    s = np.concatenate([batch.s for batch in kept])[:wanted]
    optimal = np.concatenate([batch.optimal for batch in kept])[:wanted]
    agents = zip(task.observed, task.owned, strict=True)
    return references.fit(s, optimal, agents), itertools.chain(kept, batches)
