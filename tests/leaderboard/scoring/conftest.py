"""One scored board for the tests of `verify`, and how its owner could forge it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from leaderboard.documents.board import Folder
from leaderboard.documents.signed import SigningKey
from leaderboard.scoring.ranking import never_listed, result_of
from leaderboard.scoring.worker import run_scorer
from leaderboard.store import Store
from leaderboard.store.log import LogEntry, Objects
from sme_registry.io import to_json
from tests.leaderboard.conftest import (
    linear_onnx,
    put_policy,
    put_submission,
    signed_withdrawal,
    tiny_board,
    tiny_submission,
)
from tests.leaderboard.gate import models

STEADY, FAILED, SENSITIVE, REFUSED, WAITING = range(5)
"""The entries of `board`: its log opens, receives four, has four results, loses `FAILED`, which is
withdrawn, and receives the last. `FAILED` has a run that failed and one that it does not list."""


def sensitive_onnx():
    """A policy that adds and subtracts a number so large that the actions lose their last bits."""
    model = models.model(
        [
            models.node("MatMul", "o W", "y"),
            models.node("Add", "y large", "shifted"),
            models.node("Sub", "shifted large", "a"),
        ],
        [
            models.tensor("W", np.full((4, 1), 0.1, np.float32)),
            models.tensor("large", np.float32(200.0)),
        ],
        inputs=[models.value("o", "B", 4)],
        outputs=[models.value("a", "B", 1)],
    )
    return bytes(model.SerializeToString(deterministic=True))


def make_board(folder):
    path, key = folder / "board", SigningKey.generate()
    with tiny_board(path) as store:
        put_policy(store, key, linear_onnx(0), 0)
        (run,) = tiny_submission(store, key, 1)[0].content.to_dict()["runs"]
        failed = {**run, "seed": 7, "artefact": None}
        withdrawn = put_submission(store, key, 1, runs=[run, failed], runs_started={"Tiny": 3})
        put_policy(store, key, sensitive_onnx(), 2)
        put_policy(store, key, linear_onnx(0, observation_dim=9), 3)
        run_scorer(path)
        assert [row.status for row in store.entries()] == [*["scored"] * 3, "rejected"]
        store.withdraw(signed_withdrawal(store, withdrawn.id, key))
        put_submission(store, key, 4)
        assert store.head.sequence == 10


@pytest.fixture
def board(once, tmp_path):
    """A copy of the scored board."""
    whole = once("leaderboard-scored", make_board)
    return Path(shutil.copytree(whole / "board", tmp_path / "board"))


def ids(board):
    with Store.open(board, read_only=True) as store:
        return [row.id for row in store.entries()]


def result_on(board, number):
    with Store.open(board, read_only=True) as store:
        return store.result(store.entries()[number].id)


def with_runs(board, result, runs, **fields):
    """A result whose scores follow from these runs."""
    with Store.open(board, read_only=True) as store:
        submission = store.submission(result.submission).content
        unlisted = fields.pop("unlisted", never_listed(store.document, submission))
        return result_of(
            *(store.document, result.submission, runs, result.versions),
            unlisted=unlisted,
            isolation=result.isolation,
        )


def forge(board, document, event="result", subject=None):
    """Replace a document and sign the log again, as the board's owner can."""
    folder = Folder(board)
    digest = Objects(folder).write(document)
    subject = document.submission if subject is None else subject
    resign(board, folder.signing_key(), replaced={(event, subject): digest})


def resign(board, key, start=1, replaced=()):
    """Write the log again from an entry on, with other documents; chain and signatures right."""
    folder = Folder(board)
    previous = LogEntry.from_dict(json.loads(folder.log_entry(start - 1).read_text()))
    for path in sorted(folder.log.glob("*.json"))[start:]:
        entry = LogEntry.from_dict(json.loads(path.read_text()))
        digest = dict(replaced).get((entry.event, entry.subject), entry.document)
        entry = entry.model_copy(update={"previous": previous.digest, "document": digest})
        signature = key.sign("log", entry.signed_digest)
        previous = entry.model_copy(update={"signature": signature})
        path.write_text(to_json(previous.to_dict()))
    folder.index.unlink(missing_ok=True)
