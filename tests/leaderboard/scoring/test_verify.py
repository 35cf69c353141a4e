"""`verify` names the first altered row, whatever was altered."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from leaderboard.documents.board import Folder, hex_of
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.result import Result
from leaderboard.documents.submission import SignedSubmission
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.aggregation import never_listed, result_of
from leaderboard.scoring.metrics import run_metrics
from leaderboard.scoring.verify import VerifyReport, close, verify
from leaderboard.scoring.worker import run_scorer
from leaderboard.store import LogEntry, Store, digest_of
from sme_registry.errors import OptionError
from sme_registry.io import to_json
from tests.leaderboard.conftest import (
    put_submission,
    signed_withdrawal,
    tiny_board,
    tiny_submission,
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A board: 0 and 1 scored, 2 scored and withdrawn, 3 waiting. Its log has nine entries."""
    path = tmp_path_factory.mktemp("verify") / "board"
    key = SigningKey.generate()
    with tiny_board(path, instances=2) as store:
        signed = [put_submission(store, key, number) for number in range(3)]
        run_scorer(path)
        store.withdraw(signed_withdrawal(store, signed[2].id, key))
        put_submission(store, key, 3)
        assert store.head.sequence == 8
    return path


@pytest.fixture
def board(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "board")


def ids(board: Path) -> list[str]:
    with Store.open(board, read_only=True) as store:
        return [row.id for row in store.entries()]


def where(board: Path, path: Path) -> str:
    return path.relative_to(board).as_posix()


def alter(path: Path, change: Callable[[Any], Any]) -> None:
    """Change a document and write it in the board's form."""
    plain = json.loads(path.read_text())
    change(plain)
    path.write_text(to_json(plain))


def first_altered(board: Path, **arguments: Any) -> str:
    with pytest.raises(TamperedError) as tampered:
        verify(board, **arguments)
    assert tampered.value.where in str(tampered.value)
    return tampered.value.where


def resign(board: Path, key: SigningKey, start: int = 1) -> None:
    """Write the log again from an entry on, chain and signatures right, documents as they are."""
    folder = Folder(board)
    previous = LogEntry.from_dict(json.loads(folder.log_entry(start - 1).read_text()))
    for path in sorted(folder.log.glob("*.json"))[start:]:
        entry = LogEntry.from_dict(json.loads(path.read_text()))
        document: dict[str, Any] = {}
        if entry.event == "result":
            result = Result.from_dict(json.loads(folder.result(entry.subject).read_text()))
            document = {"document": digest_of(result)}
        if entry.event == "received":
            text = folder.submission(entry.subject).read_text()
            document = {"document": digest_of(SignedSubmission.from_dict(json.loads(text)))}
        entry = entry.model_copy(update={"previous": previous.digest, **document})
        signature = key.sign("log", entry.signed_digest)
        previous = entry.model_copy(update={"signature": signature})
        path.write_text(to_json(previous.to_dict()))
    folder.index.unlink(missing_ok=True)


def test_an_unaltered_board_is_verified_and_counted(board):
    seen = []
    report = verify(
        board, rescore=5, seed=7, progress=lambda done, total: seen.append((done, total))
    )
    with Store.open(board, read_only=True) as store:
        head = store.head
    assert report == VerifyReport(
        entries=9,
        log_sequence=8,
        log_digest=head.digest,
        submissions=4,
        withdrawals=1,
        results=3,
        objects=4,
        unlogged=0,
        rows=19,
        rescored=3,
        rescore_seed=7,
        tolerance=1e-5,
        notes=(),
    )
    assert [done for done, _ in seen] == list(range(1, len(seen) + 1))
    assert all(done <= total for done, total in seen)


def test_verify_writes_nothing(board):
    before = {path: path.read_bytes() for path in board.rglob("*") if path.is_file()}
    verify(board)
    after = {path: path.read_bytes() for path in board.rglob("*") if path.is_file()}
    assert {path: data for path, data in after.items() if "-" not in path.name} == before


def test_a_board_without_its_private_key_or_its_index_is_verified_all_the_same(board):
    Folder(board).key.unlink()
    Folder(board).index.unlink()
    assert verify(board).rows == 0
    assert not Folder(board).index.exists()


def test_a_kept_digest_reveals_a_log_cut_at_its_end(board):
    """As where a board was cloned without its index: the rest of the log is in order."""
    kept = verify(board).log_digest
    folder = Folder(board)
    first = LogEntry.from_dict(json.loads(folder.log_entry(0).read_text()))
    last = LogEntry.from_dict(json.loads(folder.log_entry(8).read_text()))
    for digest in (kept, hex_of(kept), first.digest):
        assert verify(board, contains=digest).entries == 9
    folder.log_entry(8).unlink()
    folder.submission(last.subject).unlink()
    folder.index.unlink()
    cut = verify(board)
    assert (cut.log_sequence, cut.results) == (7, 3)  # the rest is a valid log
    assert first_altered(board, contains=kept) == "log"
    assert verify(board, contains=first.digest) == cut


def test_a_kept_digest_reveals_a_rewritten_log(board):
    kept = verify(board).log_digest
    folder = Folder(board)
    alter(folder.log_entry(8), lambda plain: plain.update({"time": "2126-11-21T09:30:00Z"}))
    resign(board, folder.signing_key())
    assert verify(board).entries == 9
    assert first_altered(board, contains=kept) == "log"


def test_an_invalid_digest_is_rejected(board):
    for text in ("", "3f2a", "sha256:" + "x" * 64):
        with pytest.raises(OptionError, match="contains="):
            verify(board, contains=text)


def test_a_missing_board_is_not_tampering(tmp_path):
    with pytest.raises(BoardError, match="contains no board"):
        verify(tmp_path)
    with pytest.raises(OptionError, match="rescore=-1"):
        verify(tmp_path, rescore=-1)
    with pytest.raises(OptionError, match="seed=-1"):
        verify(tmp_path, rescore=1, seed=-1)


@pytest.mark.parametrize(
    ("field", "value"),
    [("title", "Another"), ("draws", 200), ("key", "ab" * 32), ("protocol_name", "other-v1")],
)
def test_an_altered_board_document_is_named(board, field, value):
    alter(board / "board.json", lambda plain: plain.update({field: value}))
    assert first_altered(board) == "board.json"


def test_another_private_key_is_named(board):
    (board / "board.key").unlink()
    SigningKey.generate().write(board / "board.key")
    assert first_altered(board) == "board.key"


@pytest.mark.parametrize("sequence", range(9))
@pytest.mark.parametrize("field", ["time", "subject", "document", "previous", "event", "signature"])
def test_an_altered_log_entry_is_named(board, sequence, field):
    others = {
        "time": "2001-01-01T00:00:00Z",
        "event": "result",
        "signature": "0" * 128,
    }
    path = Folder(board).log_entry(sequence)
    value = others.get(field, "sha256:" + "1" * 64)
    if json.loads(path.read_text())[field] == value:
        value = "withdrawn"
    alter(path, lambda plain: plain.update({field: value}))
    expected = "board.json" if (sequence, field) == (0, "document") else where(board, path)
    assert first_altered(board) == expected


@pytest.mark.parametrize("sequence", range(9))
@pytest.mark.parametrize("harm", ["deleted", "emptied", "cut", "noise", "spaces"])
def test_a_missing_or_reformatted_log_entry_is_named(board, sequence, harm):
    path = Folder(board).log_entry(sequence)
    data = path.read_bytes()
    changed = {"emptied": b"", "cut": data[:-9], "noise": b"\xff\x00", "spaces": data + b" "}
    if harm == "deleted":
        path.unlink()
    else:
        path.write_bytes(changed[harm])
    assert first_altered(board) == where(board, path)


@pytest.mark.parametrize("sequence", range(1, 9))
def test_a_deleted_log_entry_is_named_without_the_index_too(board, sequence):
    Folder(board).index.unlink()
    path = Folder(board).log_entry(sequence)
    path.unlink()
    if sequence < 8:
        assert first_altered(board) == where(board, path)
    else:  # a submission whose entry is cut off looks like one that was being received
        assert verify(board).unlogged == 1


def test_swapped_log_entries_are_named(board):
    one, other = Folder(board).log_entry(4), Folder(board).log_entry(5)
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)
    assert first_altered(board) == where(board, one)


def test_an_inserted_log_entry_is_named(board):
    last = Folder(board).log_entry(8)
    Folder(board).log_entry(9).write_bytes(last.read_bytes())
    assert first_altered(board) == "log/00000009.json"
    Folder(board).log_entry(9).unlink()
    Folder(board).log_entry(11).write_bytes(last.read_bytes())
    assert first_altered(board) == "log/00000009.json"
    Folder(board).log_entry(11).unlink()
    (board / "log" / "notes.txt").write_text("mine")
    assert first_altered(board) == "log/notes.txt"


def test_a_log_signed_again_with_another_key_is_named(board):
    resign(board, SigningKey.generate(), 3)
    assert first_altered(board) == "log/00000003.json"


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("harm", ["deleted", "method", "signature", "spaces"])
def test_an_altered_submission_is_named(board, number, harm):
    path = Folder(board).submission(ids(board)[number])
    if harm == "deleted":
        path.unlink()
    elif harm == "spaces":
        path.write_bytes(path.read_bytes().replace(b"  ", b"   "))
    elif harm == "signature":
        alter(path, lambda plain: plain.update(signature="0" * 128))
    else:
        alter(path, lambda plain: plain["submission"]["method"].update(name="Better"))
    assert first_altered(board) == where(board, path)


def test_swapped_submissions_are_named(board):
    one, other = (Folder(board).submission(id) for id in ids(board)[:2])
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)
    assert first_altered(board) == where(board, one)


def test_a_submission_that_the_board_signed_for_another_is_named(board):
    """What the board's own key cannot do: sign for a submitter."""
    path = Folder(board).submission(ids(board)[3])
    alter(path, lambda plain: plain.update(signature="0" * 128))
    resign(board, Folder(board).signing_key(), 8)
    assert first_altered(board) == where(board, path)


def test_an_altered_withdrawal_is_named(board):
    path = Folder(board).withdrawal(ids(board)[2])
    alter(path, lambda plain: plain["withdrawal"].update(reason="another"))
    assert first_altered(board) == where(board, path)
    path.unlink()
    assert first_altered(board) == where(board, path)


@pytest.mark.parametrize("number", [0, 2])
@pytest.mark.parametrize("harm", ["deleted", "score", "regret", "status"])
def test_an_altered_result_is_named(board, number, harm):
    path = Folder(board).result(ids(board)[number])
    if harm == "deleted":
        path.unlink()
    elif harm == "score":
        alter(path, lambda plain: plain["scores"]["wd_regret"].update(value=0.0))
    elif harm == "regret":
        alter(path, lambda plain: plain["runs"][0].update(wd_regret=0.0))
    else:
        alter(path, lambda plain: plain.update(status="rejected", code="onnx_op", scores=None))
    assert first_altered(board) == where(board, path)


def test_swapped_results_are_named(board):
    one, other = (Folder(board).result(id) for id in ids(board)[:2])
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)
    assert first_altered(board) == where(board, one)


def test_an_unlogged_result_is_named(board):
    scored, waiting = ids(board)[0], ids(board)[3]
    path = Folder(board).result(waiting)
    path.write_bytes(Folder(board).result(scored).read_bytes())
    assert first_altered(board) == where(board, path)


def test_a_foreign_file_is_named(board):
    (board / "results" / "note.json").write_text("{}")
    assert first_altered(board) == "results/note.json"


def test_a_submission_not_yet_logged_is_counted(board):
    with Store.open(board, read_only=True) as store:
        signed, _ = tiny_submission(store, SigningKey.generate(), 5)
    Folder(board).submission(signed.id).write_bytes(signed.to_bytes())
    assert verify(board).unlogged == 1
    path = Folder(board).submission(signed.id)
    alter(path, lambda plain: plain["submission"]["method"].update(name="Better"))
    assert first_altered(board) == where(board, path)


@pytest.mark.parametrize("harm", ["deleted", "altered", "extra"])
def test_an_altered_artefact_is_named(board, harm):
    path = sorted(board.glob("objects/*/*"))[1]
    if harm == "deleted":
        path.unlink()
    elif harm == "altered":
        path.write_bytes(path.read_bytes()[:-1] + b"!")
    else:
        path = path.with_name("0" * 62)
        path.write_bytes(b"no such hash")
    assert first_altered(board) == where(board, path)


@pytest.mark.parametrize(
    ("change", "row"),
    [
        ("UPDATE entry SET code = 'onnx_op' WHERE method = 'Linear 1'", "entry"),
        ("UPDATE entry SET scores = replace(scores, '.', '.0') WHERE method = 'Linear 1'", "entry"),
        ("UPDATE entry SET status = 'scored' WHERE method = 'Linear 1'", None),
        ("UPDATE entry SET method = 'Mine' WHERE method = 'Linear 1'", "entry"),
        ("DELETE FROM entry WHERE method = 'Linear 1'", "entry"),
        ("UPDATE object SET size = 1", "object"),
        ("UPDATE head SET time = '2001-01-01T00:00:00Z'", "head"),
        ("UPDATE head SET sequence = 3", "head"),
        ("INSERT INTO lease VALUES ('x', 'y', 1, 0, 0, '', '', 0.0, 0.0)", None),
    ],
)
def test_an_edited_index_is_named_with_its_first_altered_row(board, change, row):
    one = ids(board)[1]
    with contextlib.closing(sqlite3.connect(Folder(board).index)) as connection:
        first = connection.execute("SELECT min(digest) FROM object").fetchone()[0]
        connection.execute(change)
        connection.commit()
    if "lease" in change or "status" in change:
        verify(board)  # nothing that is derived has changed
    else:
        key = {"entry": one, "object": first, "head": "0"}[row]
        assert first_altered(board) == f"index.sqlite: {row} {key}"


def test_an_inserted_index_row_is_named(board):
    with contextlib.closing(sqlite3.connect(Folder(board).index)) as connection:
        connection.execute("INSERT INTO object VALUES ('sha256:0', 1, '', '')")
        connection.commit()
    assert first_altered(board) == "index.sqlite: object sha256:0"


def test_a_broken_index_is_named_and_reindexing_repairs_it(board):
    Folder(board).index.write_bytes(b"SQLite format 3\0" + bytes(5000))
    assert first_altered(board) == "index.sqlite"
    with Store.open(board) as store:
        store.reindex()
    assert verify(board).rows == 19


@pytest.mark.parametrize("lie", ["runs", "scores", "seed", "run's metrics"])
def test_a_forged_and_signed_result_is_detected(board, lie):
    """Chain, signatures and digests are all right: the numbers are not."""
    folder = Folder(board)
    id = ids(board)[1]
    path = folder.result(id)
    result = Result.from_dict(json.loads(path.read_text()))
    run = result.runs[0]
    if lie == "scores":
        alter(path, lambda plain: plain["scores"]["wd_regret"].update(value=0.0, low=0.0, high=0.0))
    else:
        better = {
            "runs": {"artefact": "sha256:" + "1" * 64},
            "seed": {"evaluation_seed": 1},
            "run's metrics": {"wd_regret": 0.0},
        }[lie]
        runs = (run.model_copy(update=better), *result.runs[1:])
        recomputed = result_of(folder.read(), id, runs, result.versions)
        path.write_text(to_json(recomputed.to_dict()))
    resign(board, folder.signing_key())
    assert first_altered(board) == where(board, path)


@pytest.mark.parametrize("lie", ["leaves it out", "scores it 0", "gives it the constant's decay"])
@pytest.mark.parametrize("kind", ["failed", "not listed"])
def test_a_failed_run_left_out_of_a_result_is_detected(tmp_path, kind, lie):
    board = tmp_path / "board"
    key = SigningKey.generate()
    with tiny_board(board) as store:
        plain = tiny_submission(store, key)[0].submission.to_dict()
        failed = {**plain["runs"][0], "seed": 7, "artefact": None}
        runs = [*plain["runs"], failed] if kind == "failed" else plain["runs"]
        signed = put_submission(store, key, runs=runs, runs_started={"Tiny": 2})
    run_scorer(board)
    assert verify(board).results == 1
    folder = Folder(board)
    path = folder.result(signed.id)
    result = Result.from_dict(json.loads(path.read_text()))
    first = result.runs[0]
    (without,) = never_listed(folder.read(), signed.submission) or result.runs[1:]
    spared = {
        "leaves it out": [],
        "scores it 0": [without.model_copy(update={"normalised_regret": (0.0,) * 6})],
        "gives it the constant's decay": [without.model_copy(update={"ood_decay": 0.0})],
    }[lie]
    runs = [first, *spared] if kind == "failed" else [first]
    unlisted = [] if kind == "failed" else spared
    recomputed = result_of(folder.read(), signed.id, runs, result.versions, unlisted=unlisted)
    path.write_text(to_json(recomputed.to_dict()))
    resign(board, folder.signing_key())
    assert first_altered(board) == where(board, path)


def test_rescoring_detects_forged_runs(board):
    folder = Folder(board)
    id = ids(board)[1]
    path = folder.result(id)
    result = Result.from_dict(json.loads(path.read_text()))
    levels = [high for _, high in folder.read().protocol.edges]

    def falsified(run):
        regret = tuple(0.999 * value for value in run.normalised_regret)
        metrics = run_metrics(regret, run.similarity, levels)
        return run.model_copy(update={"normalised_regret": regret, **metrics})

    recomputed = result_of(
        folder.read(), id, [falsified(run) for run in result.runs], result.versions
    )
    path.write_text(to_json(recomputed.to_dict()))
    resign(board, folder.signing_key())
    assert verify(board).rescored == 0
    assert first_altered(board, rescore="all") == where(board, path)


def test_a_result_of_an_earlier_version_that_gives_single_runs_an_interval_is_accepted() -> None:
    single = {"value": 0.5, "low": None, "high": None}
    assert close(single, {"value": 0.5, "low": 0.5, "high": 0.5}, 1e-12)
    assert not close(single, {"value": 0.5, "low": 0.4, "high": 0.6}, 1e-12)
    assert not close(single, {"value": 0.6, "low": 0.6, "high": 0.6}, 1e-12)
