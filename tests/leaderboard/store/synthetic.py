"""Synthetic results, for tests of storage that need no scoring."""

from leaderboard.documents.result import Result, RunScore
from leaderboard.scoring.ranking import result_of, run_metrics
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
    levels = [high for _, high in document.protocol.edges]
    instances = document.instances
    runs = []
    for number, run in enumerate(store.submission(id).content.runs):
        assert run.artefact is not None
        regret = tuple(level + 0.01 * number + 0.1 * epsilon for epsilon in levels)
        similarity = tuple(1 - 0.25 * each for each in regret)
        runs.append(
            RunScore(
                spec=run.spec,
                class_name=instances[run.spec][0],
                artefact=run.artefact.sha256,
                evaluation_seed=evaluation_seed(
                    document.protocol.digest, run.spec, run.artefact.sha256
                ),
                normalised_regret=regret,
                similarity=similarity,
                **run_metrics(regret, similarity, levels),
            )
        )
    return result_of(document, id, runs, {"synthetic": "1"})
