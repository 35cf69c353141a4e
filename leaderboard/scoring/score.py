"""`score_submission`: from a submission and its artefacts to a `Result`.

    run → sandbox → evaluate on the run's own states → N_m → metrics → `aggregation` → θ

Protocol, spec and artefact determine the seed of a run's states:

    seed = first 53 bits of SHA-256(protocol digest, spec digest, artefact digest)

Anyone can recompute it, and each attempt at luckier states needs another policy. The checks of a
policy's behaviour use states and batches that the system's randomness draws, so no policy can
behave well only where it is checked. Memory holds one artefact and one batch of states at a time.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.result import AgentScore, Result, RunScore
from leaderboard.documents.submission import Submission
from leaderboard.errors import Rejection
from leaderboard.gate.isolation import Isolation, available_isolation
from leaderboard.gate.sandbox import Actions, Observations, Sandbox, SandboxLimits, widths
from leaderboard.scoring.aggregation import (
    failed_run,
    levels_of,
    never_listed,
    result_of,
    run_metrics,
)
from leaderboard.scoring.behaviour import COMPARED, Behaviours
from sme_registry import SMESpec, evaluate
from sme_registry.errors import PolicyError, SMEError
from sme_registry.evaluation import EvaluationReport
from sme_registry.io import versions

Progress = Callable[[int, int], None]

_SINGLE_ROWS = 8  # of a checked batch, evaluated one at a time
# May be loaded in the same process, but no number of a result depends on them.
_UNUSED = ("stable_baselines3", "torch")


def evaluation_seed(protocol_digest: str, spec_digest: str, artefact_digest: str) -> int:
    """The seed of a run's states, in [0, 2⁵³)."""
    text = f"{protocol_digest}\n{spec_digest}\n{artefact_digest}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 11


@dataclass
class _Machine:
    """What scores: recorded in the result, whatever becomes of the submission."""

    isolation: Isolation
    versions: dict[str, str] = field(default_factory=lambda: versions(["numpy", "onnx"]))


def score_submission(
    board: BoardDocument,
    submission: Submission,
    artefact: Callable[[str], bytes],
    progress: Progress | None = None,
    *,
    isolation: Isolation | None = None,
) -> Result:
    """Score every run of a submission, and the method over its runs.

    Args:
      board: the suite, the rules, the protocol, and the numbers of runs and bootstrap draws.
      submission: accepted by `checks`.
      artefact: returns a file's bytes by its digest.
      progress: called after each batch with the number of evaluated states and of all states.
      isolation: of the sandbox; None for the one that this machine has.

    Returns:
      The result, a function of board, submission and artefacts up to floating-point rounding,
      except for the last bits in
      `RunScore.actions`. It is a rejection if an
      artefact, or its behaviour, is rejected.

    Raises:
      ScoringFault: a sandbox does not start, was ended from outside, or lacks memory or processor
        time. The submission is not judged.
      BoardError: this system is not Linux.
      MissingDependencyError: onnxruntime is not installed.
      Errors of `artefact` and `progress`; a `Rejection` becomes the result.
    """
    machine = _Machine(isolation or available_isolation())
    try:
        unlisted = never_listed(board, submission)
        runs = _score_runs(board, submission, artefact, progress, machine)
    except Rejection as error:
        return Result(
            submission=submission.digest,
            suite=board.suite.digest,
            protocol=board.protocol.digest,
            status="rejected",
            code=error.code,
            message=error.message,
            versions=machine.versions,
            isolation=machine.isolation,
        )
    return result_of(
        board,
        submission.digest,
        runs,
        machine.versions,
        unlisted=unlisted,
        isolation=machine.isolation,
    )


def _score_runs(
    board: BoardDocument,
    submission: Submission,
    artefact: Callable[[str], bytes],
    progress: Progress | None,
    machine: _Machine,
) -> list[RunScore]:
    """The listed runs in order."""
    instances = board.instances
    states = board.protocol.states_per_region * len(board.protocol.edges)
    policies = sum(run.artefact is not None for run in submission.runs)
    behaviours = Behaviours(board.protocol, submission.digest)
    runs: list[RunScore] = []
    evaluated = 0
    for index, run in enumerate(submission.runs):
        class_name, spec = instances[run.spec]
        if run.artefact is None:
            runs.append(failed_run(board.protocol, class_name, run.spec))
            continue

        def advanced(done: int, _: int, before: int = states * evaluated) -> None:
            if progress is not None:
                progress(before + done, states * policies)

        digest = run.artefact.sha256
        observe = functools.partial(behaviours.observe, f"runs.{index}", spec)
        try:
            data = artefact(digest)
            evaluation = _evaluate(board, spec, data, digest, advanced, machine, observe)
        except Rejection as error:
            raise Rejection(
                error.code,
                f"runs.{index} (class {class_name}, spec {run.spec}, artefact {digest}): "
                f"{error.message}",
            ) from None
        evaluated += 1
        runs.append(_run_score(board, class_name, digest, *evaluation))
    return runs


def agent_names(spec: SMESpec) -> list[str]:
    """The agents of a team, in the order of the channels that they own; none without a team."""
    return [] if spec.team is None else [agent.name for agent in spec.team.agents]


def _evaluate(
    board: BoardDocument,
    spec: SMESpec,
    data: bytes,
    digest: str,
    progress: Progress,
    machine: _Machine,
    observe: Callable[[Sandbox], str | None],
) -> tuple[EvaluationReport, str | None]:
    """Evaluate a policy in the sandbox on the states of its own seed; digest its actions."""
    agents = max(1, len(agent_names(spec)))
    states = board.protocol.states_per_region
    rows = states * len(board.protocol.edges) + COMPARED
    limits = SandboxLimits.for_policy(len(data), rows, agents)
    with Sandbox(data, *widths(spec), limits, isolation=machine.isolation) as sandbox:
        machine.versions["onnxruntime"] = sandbox.runtime
        policy = _CheckedPolicy(sandbox, states, agents)
        report = _report(board, spec, policy, digest, progress)
        with _sandbox_errors():
            actions = observe(sandbox) if board.rules > 1 else None
    used = {name: version for name, version in report.versions.items() if name not in _UNUSED}
    machine.versions |= {**used, "onnxruntime": sandbox.runtime}
    return report, actions


def _report(
    board: BoardDocument,
    spec: SMESpec,
    policy: Callable[[Observations], Actions],
    digest: str,
    progress: Progress | None = None,
) -> EvaluationReport:
    """The evaluation of a sandboxed policy, whose errors it passes on as they are."""
    seed = evaluation_seed(board.protocol.digest, spec.digest, digest)
    protocol = board.protocol.model_copy(update={"seed": seed})
    with _sandbox_errors():
        return evaluate(policy, spec, protocol, action_range="unit", name=digest, progress=progress)


@contextlib.contextmanager
def _sandbox_errors() -> Iterator[None]:
    """Raise the sandbox's errors, which policies wrap like those of any callable, as they are."""
    try:
        yield
    except PolicyError as error:
        if isinstance(error.__cause__, SMEError):
            raise error.__cause__ from None
        raise


class _CheckedPolicy:
    """A sandboxed policy as `evaluate` calls it: region by region, batch by batch, for each agent.

    In each region, a random batch and the last one, which is often smaller, are checked for
    dependence on other rows, and the random one for dependence on the observations' last place.
    """

    def __init__(self, sandbox: Sandbox, states: int, agents: int) -> None:
        self._sandbox, self._states, self._agents = sandbox, states, agents
        self._random = np.random.default_rng(secrets.randbits(128))
        self._begin_region()

    def _begin_region(self) -> None:
        self._first = self._calls = 0
        self._batch_with = int(self._random.integers(self._states))

    def __call__(self, observations: Observations) -> Actions:
        end = self._first + len(observations)
        is_chosen = self._first <= self._batch_with < end
        if is_chosen or end == self._states:
            self._sandbox.check_rows(observations, _SINGLE_ROWS)
        if is_chosen:
            self._sandbox.check_last_place(observations)
        a = self._sandbox(observations)
        self._calls += 1
        if self._calls % self._agents == 0:
            self._first = end
            if end == self._states:
                self._begin_region()
        return a


def _run_score(
    board: BoardDocument,
    class_name: str,
    digest: str,
    report: EvaluationReport,
    actions: str | None,
) -> RunScore:
    regrets = tuple(region.normalised_regret for region in report.regions)
    similarity = tuple(region.similarity for region in report.regions)
    metrics: dict[str, Any] = {**run_metrics(regrets, similarity, levels_of(board.protocol))}
    return RunScore(
        spec=report.spec_digest,
        class_name=class_name,
        artefact=digest,
        evaluation_seed=report.protocol.seed,
        normalised_regret=regrets,
        similarity=similarity,
        agents=tuple(
            AgentScore(
                name=name, normalised_regret=tuple(r.normalised_regret for r in each.regions)
            )
            for name, each in report.agents.items()
        ),
        actions=actions,
        **metrics,
    )
