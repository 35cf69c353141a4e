"""`score_submission`: from a submission and its artefacts to a `Result`.

    run → sandbox → evaluate on the run's own states → N_m → metrics → θ, intervals

Protocol, spec and artefact determine the seed of a run's states:

    seed = first 53 bits of SHA-256(protocol digest, spec digest, artefact digest)

Anyone can recompute it, and each attempt at luckier states needs another policy. Memory holds one
artefact and one batch of states at a time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from importlib import metadata

import numpy as np

from leaderboard.artefact.sandbox import Actions, Observations, Sandbox
from leaderboard.documents.board import BoardDocument
from leaderboard.documents.result import METRICS, ClassScore, Estimate, Result, RunScore, Scores
from leaderboard.documents.submission import Submission, refuse_countless
from leaderboard.errors import Rejection
from leaderboard.scoring.metrics import run_metrics
from sme_registry import SMESpec, evaluate
from sme_registry.errors import PolicyError, SMEError
from sme_registry.evaluation import EvaluationReport
from sme_registry.statistics import aggregate, iqm, stratified_bootstrap

Progress = Callable[[int, int], None]
Instances = dict[str, tuple[str, SMESpec]]

ORACLE_OOD, ORACLE_WD, FLAT = 0.01, 0.02, 0.01
"""Oracle-like: N̄ at most the first, or N₀ at most the second and |N̄ − N₀| at most the third."""

_NOT_NEGATIVE = ("wd_regret", "ood_regret")
# May be loaded in the same process, but no number of a result depends on them.
_UNUSED = ("stable_baselines3", "torch")


def evaluation_seed(protocol_digest: str, spec_digest: str, artefact_digest: str) -> int:
    """The seed of a run's states, in [0, 2⁵³).

    Args:
      protocol_digest: of the board's protocol.
      spec_digest: of the instance.
      artefact_digest: of the policy's file.
    """
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
      versions: of packages, for the result.
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
    instances = board.instances
    unlisted = never_listed(board, submission, instances)
    policies = {(run.spec, run.artefact.sha256) for run in submission.runs if run.artefact}
    states = board.protocol.states_per_region * len(board.protocol.edges)
    scored: dict[tuple[str, str], RunScore] = {}
    versions: dict[str, str] = {}
    runs = []
    for index, run in enumerate(submission.runs):
        class_name, spec = instances[run.spec]
        if run.artefact is None:
            runs.append(failed_run(board, class_name, run.spec))
            continue
        digest = run.artefact.sha256
        if (run.spec, digest) not in scored:
            before = states * len(scored)

            def advanced(done: int, _: int, before: int = before) -> None:
                if progress is not None:
                    progress(before + done, states * len(policies))

            try:
                report = _evaluate(board, spec, artefact(digest), digest, advanced)
            except Rejection as error:
                raise Rejection(
                    error.code,
                    f"runs.{index} (class {class_name}, spec {run.spec}, artefact {digest}): "
                    f"{error.message}",
                ) from None
            scored[run.spec, digest] = _run_score(board, class_name, report, digest)
            versions = versions or _versions(report)
        runs.append(scored[run.spec, digest])
    return runs + unlisted, versions


def never_listed(
    board: BoardDocument, submission: Submission, instances: Instances
) -> list[RunScore]:
    """A score of 1 for each run that was started and is not listed.

    Args:
      board: the suite.
      submission: with the number of runs started.
      instances: of the board.

    Raises:
      Rejection: `unknown_spec`, `missing_run` or `schema`, if `checks` did not accept it.
    """
    listed = dict.fromkeys((member.name for member in board.suite.classes), 0)
    for index, run in enumerate(submission.runs):
        if run.spec not in instances:
            raise Rejection(
                "unknown_spec",
                f"runs.{index}.spec={run.spec}: must be an instance of {board.suite_name}. "
                f"`sme show {board.suite_name}` lists them.",
            )
        listed[instances[run.spec][0]] += 1
    for name, count in listed.items():
        if count == 0:
            raise Rejection(
                "missing_run",
                f"runs: none of class {name!r}: each instance must have one. List failed runs "
                "with artefact null.",
            )
    started = {
        name: max(submission.runs_started.get(name, 0), count) for name, count in listed.items()
    }
    refuse_countless(started)
    return [
        failed_run(board, name, None)
        for name, count in listed.items()
        for _ in range(started[name] - count)
    ]


def _evaluate(
    board: BoardDocument,
    spec: SMESpec,
    data: bytes,
    digest: str,
    progress: Progress,
) -> EvaluationReport:
    """Evaluate a policy in the sandbox on the states of its own seed."""
    seed = evaluation_seed(board.protocol.digest, spec.digest, digest)
    protocol = board.protocol.model_copy(update={"seed": seed})
    with Sandbox(data, spec.state_dim + 2, spec.action_dim) as sandbox:
        evaluated = 0

        def policy(observations: Observations) -> Actions:
            nonlocal evaluated
            # `evaluate` proceeds region by region, so these are the first states of a region.
            if evaluated % protocol.states_per_region == 0:
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


def _levels(board: BoardDocument) -> tuple[float, ...]:
    """ε_m of each region's outer face; 0 for WD."""
    return tuple(high for _, high in board.protocol.edges)


def _run_score(
    board: BoardDocument, class_name: str, report: EvaluationReport, digest: str
) -> RunScore:
    regrets = tuple(region.normalised_regret for region in report.regions)
    similarity = tuple(region.similarity for region in report.regions)
    return RunScore(
        spec=report.spec_digest,
        class_name=class_name,
        artefact=digest,
        evaluation_seed=report.protocol.seed,
        normalised_regret=regrets,
        similarity=similarity,
        **run_metrics(regrets, similarity, _levels(board)),
    )


def failed_run(board: BoardDocument, class_name: str, spec: str | None) -> RunScore:
    """A run without a policy scores 1 in every region and every metric.

    Args:
      board: its protocol has the regions.
      class_name: the class of the run.
      spec: digest of the instance; None if the run is not listed.
    """
    regrets = (1.0,) * len(board.protocol.edges)
    return RunScore(
        spec=spec,
        class_name=class_name,
        artefact=None,
        evaluation_seed=None,
        normalised_regret=regrets,
        similarity=None,
        **run_metrics(regrets, None, _levels(board)),
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
            [
                [*(getattr(run, metric) for metric in METRICS), *run.normalised_regret]
                for run in runs
            ]
        )
        for name, runs in by_class.items()
    }
    value = aggregate(classes)
    low, high = stratified_bootstrap(classes, draws, seed)
    # Regret is never negative, so a lower end below 0 carries no information.
    not_negative = [metric in _NOT_NEGATIVE for metric in METRICS]
    not_negative += [True] * (len(value) - len(METRICS))
    low = np.where(not_negative, np.maximum(low, 0.0), low)
    estimates = [
        Estimate(value=value, low=low, high=high)
        for value, low, high in zip(value.tolist(), low.tolist(), high.tolist(), strict=True)
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
