"""Rescoring: what is drawn, what is tampering, and what is only a note."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from leaderboard.cli.app import app
from leaderboard.documents.board import Folder
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.result import Result
from leaderboard.documents.submission import Run
from leaderboard.errors import TamperedError
from leaderboard.scoring.aggregation import result_of
from leaderboard.scoring.metrics import levels_of, run_metrics
from leaderboard.scoring.rescore import RESCORED, RescoreNote, _other_verdict, draw
from leaderboard.scoring.score import evaluation_seed
from leaderboard.scoring.verify import verify
from leaderboard.scoring.worker import run_scorer
from leaderboard.store import Store
from sme_registry.io import to_json
from tests.leaderboard.artefact import models
from tests.leaderboard.conftest import linear_onnx, put_policy, tiny_board
from tests.leaderboard.scoring.test_verify import resign

STEADY, SENSITIVE, REFUSED = range(3)
LARGE = 200.0


def sensitive_onnx() -> bytes:
    """A policy that adds and subtracts a number so large that the actions lose their last bits."""
    model = models.model(
        [
            models.node("MatMul", "o W", "y"),
            models.node("Add", "y large", "shifted"),
            models.node("Sub", "shifted large", "a"),
        ],
        [
            models.tensor("W", np.full((4, 1), 0.1, np.float32)),
            models.tensor("large", np.float32(LARGE)),
        ],
        inputs=[models.value("o", "B", 4)],
        outputs=[models.value("a", "B", 1)],
    )
    return bytes(model.SerializeToString(deterministic=True))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A board with an ordinary policy, one that is sensitive to rounding, and a rejection."""
    path = tmp_path_factory.mktemp("rescore") / "board"
    key = SigningKey.generate()
    with tiny_board(path) as store:
        for number, data in enumerate(
            [linear_onnx(0), sensitive_onnx(), linear_onnx(0, observation_dim=9)]
        ):
            put_policy(store, key, data, number)
        run_scorer(path)
        assert [row.status for row in store.entries()] == ["scored", "scored", "rejected"]
    return path


@pytest.fixture
def board(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "board")


def altered(board: Path, number: int, change: Callable[[Result], Result]) -> str:
    """Alter a result and sign the log again, as the board's owner can; the submission's id."""
    folder = Folder(board)
    with Store.open(board, read_only=True) as store:
        id = store.entries()[number].id
    path = folder.result(id)
    result = change(Result.from_dict(json.loads(path.read_text())))
    path.write_text(to_json(result.to_dict()))
    resign(board, folder.signing_key())
    return id


def moved(board: Path, by: float) -> Callable[[Result], Result]:
    """A change of every regret, with the scores that follow from it."""
    document = Folder(board).read()

    def change(result: Result) -> Result:
        run = result.runs[0]
        regret = tuple(each + by for each in run.normalised_regret)
        metrics: dict[str, Any] = run_metrics(regret, run.similarity, levels_of(document.protocol))
        run = run.model_copy(update={"normalised_regret": regret, **metrics})
        return result_of(
            document, result.submission, [run], result.versions, isolation=result.isolation
        )

    return change


def test_all_results_are_scored_again_and_an_honest_board_has_no_notes(board: Path) -> None:
    report = verify(board, rescore="all")
    assert (report.rescored, report.results, report.notes) == (3, 3, ())
    assert report.tolerance == RESCORED


def test_the_draw_is_unpredictable_and_its_seed_repeats_it(board: Path) -> None:
    seeds = {verify(board, rescore=1).rescore_seed for _ in range(3)}
    assert len(seeds) == 3
    assert verify(board).rescore_seed is None

    ids = [str(number) for number in range(100)]
    assert draw(ids, 5, 1) == draw(ids, 5, 1) != draw(ids, 5, 2)
    assert draw(ids, 5, 1) == sorted(draw(ids, 5, 1), key=int)
    assert draw(ids, "all", 1) == draw(ids, 1000, 1) == ids


def test_a_small_forgery_of_an_ordinary_policy_is_found(board: Path) -> None:
    altered(board, STEADY, moved(board, 1e-4))
    with pytest.raises(TamperedError, match=r"differs by [\d.]+e-05: must be at most 1.\de-05"):
        verify(board, rescore="all")


def test_what_rounding_explains_is_a_note_and_more_is_tampering(board: Path) -> None:
    id = altered(board, SENSITIVE, moved(board, 1e-4))
    (note,) = verify(board, rescore="all").notes
    assert (note.submission, note.kind, note.where) == (id, "rounding", "runs.0")

    altered(board, SENSITIVE, moved(board, 1e-2))
    with pytest.raises(TamperedError, match="scored again, it differs by"):
        verify(board, rescore="all")


def test_other_versions_are_noted(board: Path) -> None:
    id = altered(
        board,
        STEADY,
        lambda result: result.model_copy(
            update={"versions": {**result.versions, "onnxruntime": "1.0.0"}}
        ),
    )
    (note,) = verify(board, rescore="all").notes
    assert note == RescoreNote(id, "versions", "onnxruntime", "1.0.0", note.here)


def rejected(code: str, versions: dict[str, str] | None = None) -> Callable[[Result], Result]:
    return lambda result: Result(
        submission=result.submission,
        suite=result.suite,
        protocol=result.protocol,
        status="rejected",
        code=code,
        message="because",
        versions=result.versions if versions is None else versions,
    )


def test_a_board_that_rejects_a_policy_without_a_fault_is_found(board: Path) -> None:
    altered(board, STEADY, rejected("onnx_op"))
    assert verify(board).results == 3
    with pytest.raises(TamperedError, match="it is scored, not onnx_op"):
        verify(board, rescore="all")


@pytest.mark.parametrize(
    "change", [rejected("run_rounding"), rejected("onnx_op", {"sme_registry": "0.0.9"})]
)
def test_a_rejection_by_chance_or_by_other_versions_is_noted(
    board: Path, change: Callable[[Result], Result]
) -> None:
    id = altered(board, STEADY, change)
    notes = verify(board, rescore="all").notes
    assert [note.here for note in notes if note.kind == "verdict"] == ["scored"]
    assert {note.submission for note in notes} == {id}
    answer = CliRunner().invoke(app, ["verify", str(board), "--rescore", "all"])
    assert (answer.exit_code, "Not confirmed" in answer.stdout) == (1, True)


def test_scores_of_a_policy_that_is_rejected_are_found(board: Path) -> None:
    with Store.open(board, read_only=True) as store:
        scored = store.result(store.entries()[STEADY].id)
        (run,) = store.submission(store.entries()[REFUSED].id).submission.runs
    assert scored is not None
    altered(
        board,
        REFUSED,
        lambda result: forged(board, scored, result.submission, run),
    )
    with pytest.raises(TamperedError, match="it is onnx_interface, not scored"):
        verify(board, rescore="all")


@pytest.mark.parametrize("code", ["run_failed", "onnx_refused"])
def test_a_policy_that_fails_here_was_not_scored_by_the_same_versions(
    board: Path, code: str
) -> None:
    with Store.open(board, read_only=True) as store:
        scored = store.result(store.entries()[STEADY].id)
    assert scored is not None
    again = rejected(code)(scored)
    assert _other_verdict(scored, again, other_versions=True).here == code
    with pytest.raises(TamperedError, match=f"it is {code}, not scored"):
        _other_verdict(scored, again, other_versions=False)


def forged(board: Path, scored: Result, id: str, run: Run) -> Result:
    """Another submission's scores as those of this run."""
    assert run.artefact is not None
    document, artefact = Folder(board).read(), run.artefact.sha256
    seed = evaluation_seed(document.protocol.digest, run.spec, artefact)
    copy = scored.runs[0].model_copy(update={"artefact": artefact, "evaluation_seed": seed})
    return result_of(document, id, [copy], scored.versions, isolation=scored.isolation)
