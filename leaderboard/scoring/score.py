"""`score_submission`: from a submission and its artefacts to a `Result`.

    run → sandbox → evaluate on the run's own states → N_m → metrics → `aggregation` → θ

Protocol, spec and artefact determine the seed of a run's states:

    seed = first 53 bits of SHA-256(protocol digest, spec digest, artefact digest)

Anyone can recompute it, and each attempt at luckier states needs another policy. Memory holds one
artefact and one batch of states at a time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from importlib import metadata
from typing import Any

from leaderboard.artefact.gate import widths
from leaderboard.artefact.sandbox import Actions, Observations, Sandbox, SandboxLimits
from leaderboard.documents.board import BoardDocument
from leaderboard.documents.result import AgentScore, Result, RunScore
from leaderboard.documents.submission import Submission
from leaderboard.errors import Rejection
from leaderboard.scoring.aggregation import never_listed, result_of
from leaderboard.scoring.metrics import failed_run, levels_of, run_metrics
from sme_registry import SMESpec, evaluate
from sme_registry.errors import PolicyError, SMEError
from sme_registry.evaluation import EvaluationReport

Progress = Callable[[int, int], None]

# May be loaded in the same process, but no number of a result depends on them.
_UNUSED = ("stable_baselines3", "torch")


def evaluation_seed(protocol_digest: str, spec_digest: str, artefact_digest: str) -> int:
    """The seed of a run's states, in [0, 2⁵³)."""
    text = f"{protocol_digest}\n{spec_digest}\n{artefact_digest}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 11


def score_submission(
    board: BoardDocument,
    submission: Submission,
    artefact: Callable[[str], bytes],
    progress: Progress | None = None,
) -> Result:
    """Score every run of a submission, and the method over its runs.

    Args:
      board: the suite, the protocol, and the numbers of runs and bootstrap draws.
      submission: accepted by `checks`.
      artefact: returns a file's bytes by its digest.
      progress: called after each batch with the number of evaluated states and of all states.

    Returns:
      The result, a function of board, submission and artefacts up to floating-point rounding. It
      is a rejection if an artefact, or its behaviour, is rejected.

    Raises:
      BoardError: a sandbox cannot be started or was ended from outside. The submission is not
        judged.
      MissingDependencyError: onnxruntime is not installed.
      Errors of `artefact` and `progress`; a `Rejection` becomes the result.
    """
    try:
        unlisted = never_listed(board, submission)
        runs, versions = _score_runs(board, submission, artefact, progress)
    except Rejection as error:
        return Result(
            submission=submission.digest,
            suite=board.suite.digest,
            protocol=board.protocol.digest,
            status="rejected",
            code=error.code,
            message=error.message,
        )
    return result_of(board, submission.digest, runs, versions, unlisted=unlisted)


def _score_runs(
    board: BoardDocument,
    submission: Submission,
    artefact: Callable[[str], bytes],
    progress: Progress | None,
) -> tuple[list[RunScore], dict[str, str]]:
    """The listed runs in order, and the versions of packages."""
    instances = board.instances
    states = board.protocol.states_per_region * len(board.protocol.edges)
    policies = sum(run.artefact is not None for run in submission.runs)
    versions: dict[str, str] = {}
    runs: list[RunScore] = []
    evaluated = 0
    for index, run in enumerate(submission.runs):
        class_name, spec = instances[run.spec]
        if run.artefact is None:
            runs.append(failed_run(board, class_name, run.spec))
            continue

        def advanced(done: int, _: int, before: int = states * evaluated) -> None:
            if progress is not None:
                progress(before + done, states * policies)

        digest = run.artefact.sha256
        try:
            report = _evaluate(board, spec, artefact(digest), digest, advanced)
        except Rejection as error:
            raise Rejection(
                error.code,
                f"runs.{index} (class {class_name}, spec {run.spec}, artefact {digest}): "
                f"{error.message}",
            ) from None
        evaluated += 1
        runs.append(_run_score(board, class_name, report, digest))
        versions = versions or _versions(report)
    return runs, versions


def agent_names(spec: SMESpec) -> list[str]:
    """The agents of a team, in the order of the channels that they own; none without a team."""
    return [] if spec.team is None else [agent.name for agent in spec.team.agents]


def _evaluate(
    board: BoardDocument, spec: SMESpec, data: bytes, digest: str, progress: Progress
) -> EvaluationReport:
    """Evaluate a policy in the sandbox on the states of its own seed."""
    seed = evaluation_seed(board.protocol.digest, spec.digest, digest)
    protocol = board.protocol.model_copy(update={"seed": seed})
    agents = max(1, len(agent_names(spec)))
    limits = SandboxLimits(cpu_seconds=agents * SandboxLimits.cpu_seconds)
    with Sandbox(data, *widths(spec), limits) as sandbox:
        evaluated = 0

        def policy(observations: Observations) -> Actions:
            nonlocal evaluated
            # `evaluate` proceeds region by region and asks for each agent in turn, so these are
            # the first states of a region, for each agent.
            if evaluated % (agents * protocol.states_per_region) < agents * len(observations):
                sandbox.check_rows(observations)
            evaluated += len(observations)
            return sandbox(observations)

        try:
            return evaluate(
                policy, spec, protocol, action_range="unit", name=digest, progress=progress
            )
        except PolicyError as error:
            # `evaluate` wraps the sandbox's errors like those of any callable.
            if isinstance(error.__cause__, SMEError):
                raise error.__cause__ from None
            raise


def _run_score(
    board: BoardDocument, class_name: str, report: EvaluationReport, digest: str
) -> RunScore:
    regrets = tuple(region.normalised_regret for region in report.regions)
    similarity = tuple(region.similarity for region in report.regions)
    metrics: dict[str, Any] = {**run_metrics(regrets, similarity, levels_of(board))}
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
        **metrics,
    )


def _versions(report: EvaluationReport) -> dict[str, str]:
    return {
        **{name: version for name, version in report.versions.items() if name not in _UNUSED},
        "onnxruntime": metadata.version("onnxruntime"),
    }
