"""`score_submission`: from a submission and its artefacts to a `Result`.

    run → sandbox → evaluate on the run's own states → N_m → metrics → θ, intervals

Protocol, spec and artefact determine the seed of a run's states:

    seed = first 53 bits of SHA-256(protocol digest, spec digest, artefact digest)

Anyone can recompute it, and each attempt at luckier states needs another policy. Memory holds one
artefact and one batch of states at a time.

θ of a metric is the mean over classes of the interquartile mean within a class, and not the pooled
interquartile mean, which hardly changes when a method fails on one whole class.
`python -m benchmarks.interval_coverage` measures the coverage of its intervals.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

import numpy as np

from leaderboard.artefact.gate import widths
from leaderboard.artefact.sandbox import Actions, Observations, Sandbox, SandboxLimits
from leaderboard.documents.board import BoardDocument
from leaderboard.documents.checks import check_runs
from leaderboard.documents.result import (
    METRICS,
    AgentScore,
    ClassScore,
    Estimate,
    Result,
    RunScore,
    Scores,
)
from leaderboard.documents.submission import Submission
from leaderboard.errors import Rejection
from sme_registry import SMESpec, evaluate
from sme_registry.errors import PolicyError, SMEError
from sme_registry.evaluation import EvaluationReport
from sme_registry.statistics import aggregate, iqm, stratified_bootstrap

Progress = Callable[[int, int], None]

ORACLE_OOD, ORACLE_WD, FLAT = 0.01, 0.02, 0.01
"""Oracle-like: N̄ at most the first, or N₀ at most the second and |N̄ − N₀| at most the third."""

_SIGNED = ("ood_decay", "regret_slope", "similarity_loss")  # may be negative
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
    return result_of(board, submission.digest, runs, versions)


def result_of(
    board: BoardDocument, submission: str, runs: Sequence[RunScore], versions: dict[str, str]
) -> Result:
    """The result of scored runs: θ, intervals and flags.

    Args:
      board: the suite, and the numbers of runs and bootstrap draws.
      submission: its id.
      runs: all runs that were started, at least one of each class.
      versions: of packages.
    """
    by_class = {
        member.name: [run for run in runs if run.class_name == member.name]
        for member in board.suite.classes
    }
    scores = _scores(by_class, board.draws, submission)
    return Result(
        submission=submission,
        suite=board.suite.digest,
        protocol=board.protocol.digest,
        status="scored",
        scores=scores,
        classes=tuple(_class_score(name, members) for name, members in by_class.items()),
        runs=tuple(runs),
        enough_runs=all(len(members) >= board.runs_to_rank for members in by_class.values()),
        oracle_like=_oracle_like(scores),
        versions=versions,
    )


def _score_runs(
    board: BoardDocument,
    submission: Submission,
    artefact: Callable[[str], bytes],
    progress: Progress | None,
) -> tuple[list[RunScore], dict[str, str]]:
    """The listed runs in order, then the unlisted ones; and the versions of packages."""
    unlisted = never_listed(board, submission)
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
    return runs + unlisted, versions


def never_listed(board: BoardDocument, submission: Submission) -> list[RunScore]:
    """A score of 1 for each run that was started and is not listed.

    Raises:
      Rejection: a code of `check_runs`.
    """
    check_runs(board.suite, submission)
    class_of = {digest: name for digest, (name, _) in board.instances.items()}
    unlisted = Counter(submission.runs_started)
    unlisted.subtract(class_of[run.spec] for run in submission.runs)
    return [
        failed_run(board, member.name, None)
        for member in board.suite.classes
        for _ in range(unlisted[member.name])
    ]


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


def run_metrics(
    normalised_regret: Sequence[float], similarity: Sequence[float] | None, levels: Sequence[float]
) -> dict[str, float]:
    """The metrics of one run by name, as defined in `documents.result`.

    Args:
      normalised_regret: N_m of each region, WD first.
      similarity: mean r̃ of each region, in [0, 1]; None without a policy.
      levels: ε_m, 0 for WD.

    Returns:
      `wd_regret`, `ood_regret`, `ood_decay` and `regret_slope`, dimensionless, and
      `similarity_loss`, in points (hundredths of r̃). Without a policy each is 1 (100 points), and
      not what N_m = 1 everywhere gives: a decay of 0 would reward leaving out runs.
    """
    if similarity is None:
        return {**dict.fromkeys(METRICS, 1.0), "similarity_loss": 100.0}
    N, r = np.asarray(normalised_regret), np.asarray(similarity)
    offset = np.asarray(levels) - np.mean(levels)
    wd, ood = float(N[0]), float(N[1:].mean())
    return {
        "wd_regret": wd,
        "ood_regret": ood,
        "ood_decay": ood - wd,
        "regret_slope": float(offset @ (N - wd) / (offset @ offset)),  # exactly 0 where N is flat
        "similarity_loss": 100.0 * float(r[0] - r[1:].mean()),
    }


def _levels(board: BoardDocument) -> tuple[float, ...]:
    """ε_m of each region's outer face; 0 for WD."""
    return tuple(high for _, high in board.protocol.edges)


def _run_score(
    board: BoardDocument, class_name: str, report: EvaluationReport, digest: str
) -> RunScore:
    regrets = tuple(region.normalised_regret for region in report.regions)
    similarity = tuple(region.similarity for region in report.regions)
    metrics: dict[str, Any] = {**run_metrics(regrets, similarity, _levels(board))}
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


def failed_run(board: BoardDocument, class_name: str, spec: str | None) -> RunScore:
    """A run without a policy: 1 in every region and every metric.

    `spec` is the digest of the instance, None if the run is not listed.
    """
    regrets = (1.0,) * len(board.protocol.edges)
    metrics: dict[str, Any] = {**run_metrics(regrets, None, _levels(board))}
    return RunScore(
        spec=spec,
        class_name=class_name,
        artefact=None,
        evaluation_seed=None,
        normalised_regret=regrets,
        similarity=None,
        **metrics,
    )


def _class_score(name: str, runs: list[RunScore]) -> ClassScore:
    return ClassScore(
        name=name,
        runs=len(runs),
        submitted=sum(run.artefact is not None for run in runs),
        wd_regret=float(iqm([run.wd_regret for run in runs])),
        ood_regret=float(iqm([run.ood_regret for run in runs])),
        normalised_regret=tuple(iqm([run.normalised_regret for run in runs]).tolist()),
    )


def _scores(by_class: dict[str, list[RunScore]], draws: int, seed: str) -> Scores:
    """θ of each metric and each region, with intervals."""
    classes = {
        name: np.array(
            [[*(getattr(run, name) for name in METRICS), *run.normalised_regret] for run in runs]
        )
        for name, runs in by_class.items()
    }
    value = aggregate(classes)
    low, high = stratified_bootstrap(classes, draws, seed)
    # Regret is never negative, so a lower end below 0 carries no information.
    signed = [name in _SIGNED for name in METRICS] + [False] * (len(value) - len(METRICS))
    low = np.where(signed, low, np.maximum(low, 0.0))
    ends = [(None, None)] * len(value) if np.isnan(low).any() else zip(low, high, strict=True)
    estimates = [
        Estimate(value=theta, low=low, high=high)
        for theta, (low, high) in zip(value.tolist(), ends, strict=True)
    ]
    return Scores(
        **dict(zip(METRICS, estimates, strict=False)),
        normalised_regret=tuple(estimates[len(METRICS) :]),
    )


def _oracle_like(scores: Scores) -> bool:
    return scores.ood_regret.value <= ORACLE_OOD or (
        scores.wd_regret.value <= ORACLE_WD and abs(scores.ood_decay.value) <= FLAT
    )


def _versions(report: EvaluationReport) -> dict[str, str]:
    return {
        **{name: version for name, version in report.versions.items() if name not in _UNUSED},
        "onnxruntime": metadata.version("onnxruntime"),
    }
