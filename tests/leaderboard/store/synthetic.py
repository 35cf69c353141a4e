"""Synthetic results, for tests of storage that need no scoring."""

from leaderboard.documents.result import Result, RunScore
from leaderboard.scoring.ranking import levels_of, result_of, run_metrics
from leaderboard.scoring.score import evaluation_seed


def synthetic_result(store, id, *, code="", level=0.5):
    """A result that fits a submission: rejected with `code`, or of regret `level` or so."""
    document = store.document
    if code:
        return Result(
            submission=id,
            suite=document.suite.digest,
            protocol=document.protocol.digest,
            status="rejected",
            code=code,
            message="synthetic",
        )
    protocol, instances, runs = document.protocol, document.instances, []
    for number, run in enumerate(store.submission(id).content.runs):
        digest = run.artefact.sha256
        regret = [level + 0.01 * number + 0.1 * epsilon for epsilon in levels_of(protocol)]
        seed = evaluation_seed(protocol.digest, run.spec, digest)
        runs.append(scored_run(protocol, instances[run.spec][0], run.spec, digest, regret, seed))
    return result_of(document, id, runs, {"synthetic": "1"})


def scored_run(protocol, class_name, spec, artefact, regret, seed=0):
    """A run with this regret in each region, WD first."""
    similarity = tuple(1.0 - 0.25 * each for each in regret)
    return RunScore(
        spec=spec,
        class_name=class_name,
        artefact=artefact,
        evaluation_seed=seed,
        normalised_regret=tuple(regret),
        similarity=similarity,
        **run_metrics(regret, similarity, levels_of(protocol)),
    )
