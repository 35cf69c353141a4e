"""Scoring again: what is drawn, what is not confirmed, and what proves nothing."""

import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.documents.board import Folder
from leaderboard.documents.result import Result
from leaderboard.scoring.aggregation import levels_of, run_metrics
from leaderboard.scoring.score import evaluation_seed
from leaderboard.scoring.verify import Difference, Note, Row, draw, verify
from leaderboard.store import Objects, Store
from tests.leaderboard.scoring.conftest import (
    REFUSED,
    SENSITIVE,
    STEADY,
    forge,
    ids,
    result_on,
    with_runs,
)


def moved(board, number, by):
    """A result with every regret moved, and the scores that follow from it."""
    result = result_on(board, number)
    (run,) = result.runs
    regret = tuple(each + by for each in run.normalised_regret)
    metrics = run_metrics(regret, run.similarity, levels_of(Folder(board).read().protocol))
    run = run.model_copy(update={"normalised_regret": regret, **metrics})
    return with_runs(board, result, [run])


def again(board, result):
    """What `verify` reports of a result that the board's owner has forged."""
    forge(board, result)
    return verify(board, rescore="all")


def test_the_draw_is_unpredictable_and_its_seed_repeats_it(board, monkeypatch):
    monkeypatch.setattr("leaderboard.scoring.verify.score_submission", lambda *_: 1 / 0)
    monkeypatch.setattr(Objects, "has", lambda *_: False)  # nothing to score
    seeds = {verify(board, rescore=1).rescore_seed for _ in range(3)}
    assert len(seeds) == 3
    assert verify(board).rescore_seed is None
    names = [str(number) for number in range(100)]
    assert draw(names, 5, 1) == draw(names, 5, 1) != draw(names, 5, 2)
    assert draw(names, 5, 1) == sorted(draw(names, 5, 1), key=int)
    assert len(draw(names, 5, 1)) == 5
    assert draw(names, "all", 1) == draw(names, 1000, 1) == names


def test_other_numbers_are_not_confirmed_and_name_the_entry(board):
    assert again(board, moved(board, STEADY, 1e-6)).is_confirmed
    for number in (STEADY, SENSITIVE):
        honest = result_on(board, number)
        (note,) = again(board, moved(board, number, 1e-4)).notes
        assert (note.entry, note.difference.path) == (
            ids(board)[number],
            "runs.0.normalised_regret.0",
        )
        forge(board, honest)
    forge(board, moved(board, STEADY, 1e-4))
    assert verify(board).is_confirmed
    answer = CliRunner().invoke(app, ["verify", str(board), "--rescore", "all"])
    assert (answer.exit_code, "Not confirmed here" in answer.stdout) == (1, True)
    assert ids(board)[STEADY] in answer.stdout.replace("\n", "")


def rejected(result, code, versions=None):
    return Result(
        submission=result.submission,
        suite=result.suite,
        protocol=result.protocol,
        status="rejected",
        code=code,
        message="because",
        versions=result.versions if versions is None else versions,
    )


def test_other_versions_are_noted_and_prove_nothing(board):
    honest = result_on(board, STEADY)
    other = honest.model_copy(update={"versions": {**honest.versions, "onnxruntime": "1.0.0"}})
    report = again(board, other)
    assert report.is_confirmed
    here = honest.versions["onnxruntime"]
    row = Row("results of other versions", 1, 0, f"onnxruntime 1.0.0, here {here}")
    assert row in report.rows


@pytest.mark.parametrize("code", ["run_rounding", "onnx_op"])
def test_a_rejected_policy_that_is_scored_here_is_not_confirmed(board, code):
    result = rejected(result_on(board, STEADY), code, {"sme_registry": "0.0.9"})
    (note,) = again(board, result).notes
    assert note == Note(result.submission, Difference("verdict", code, "scored"))


def test_scores_of_a_policy_that_is_rejected_are_found(board):
    scored, refused = result_on(board, STEADY), result_on(board, REFUSED)
    with Store.open(board, read_only=True) as store:
        (run,) = store.submission(refused.submission).content.runs
    artefact = run.artefact.sha256
    seed = evaluation_seed(Folder(board).read().protocol.digest, run.spec, artefact)
    copy = scored.runs[0].model_copy(update={"artefact": artefact, "evaluation_seed": seed})
    forged = scored.model_copy(update={"submission": refused.submission})
    (note,) = again(board, with_runs(board, forged, [copy])).notes
    assert note.difference == Difference("verdict", "scored", "onnx_interface")
