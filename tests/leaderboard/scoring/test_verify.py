"""`verify` names the first altered row, whatever was altered."""

import contextlib
import json
import sqlite3
from pathlib import Path

import pytest

from leaderboard.documents.board import Folder, hex_of
from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.ranking import ranking, refuse_unpublishable
from leaderboard.scoring.verify import VerifyReport, close, verify
from leaderboard.store import LogEntry, Store
from sme_registry.errors import OptionError
from sme_registry.io import to_json
from tests.leaderboard.conftest import tiny_submission
from tests.leaderboard.scoring.conftest import (
    FAILED,
    STEADY,
    WAITING,
    forge,
    ids,
    resign,
    result_on,
    with_runs,
)

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "board"
LAST = 10


def where(board, path):
    return path.relative_to(board).as_posix()


def first_altered(board, **arguments):
    with pytest.raises(TamperedError) as tampered:
        verify(board, **arguments)
    assert tampered.value.where in str(tampered.value)
    return tampered.value.where


def changed(path, change):
    """A document after a change, in the board's form."""
    plain = json.loads(path.read_text())
    change(plain)
    return to_json(plain).encode()


def alter(path, change):
    path.write_bytes(changed(path, change))


def assert_named(board, path, *versions):
    """`verify` names this file while it has any of these bytes, or is missing for None."""
    data = path.read_bytes()
    for version in versions:
        if version is None:
            path.unlink()
        else:
            assert version != data
            path.write_bytes(version)
        assert first_altered(board) == where(board, path)
        path.write_bytes(data)


def assert_swap_named(board, one, other):
    first, second = one.read_bytes(), other.read_bytes()
    one.write_bytes(second)
    other.write_bytes(first)
    assert first_altered(board) == where(board, one)
    one.write_bytes(first)
    other.write_bytes(second)


def test_an_unaltered_board_is_verified_and_counted(board):
    before = {path: path.read_bytes() for path in board.rglob("*") if path.is_file()}
    seen = []
    report = verify(
        board, rescore=9, seed=7, progress=lambda done, total: seen.append((done, total))
    )
    with Store.open(board, read_only=True) as store:
        head = store.head
    assert report == VerifyReport(
        entries=11,
        log_sequence=LAST,
        log_digest=head.digest,
        submissions=5,
        withdrawals=1,
        results=4,
        objects=7,
        unlogged=0,
        rows=19,
        rescored=4,
        rescore_seed=7,
        tolerance=1e-5,
        notes=(),
    )
    assert [done for done, _ in seen] == list(range(1, len(seen) + 1))
    assert all(done <= total for done, total in seen)
    after = {path: path.read_bytes() for path in board.rglob("*") if path.is_file()}
    assert {path: data for path, data in after.items() if "-" not in path.name} == before

    Folder(board).key.unlink()
    Folder(board).index.unlink()
    assert verify(board).rows == 0
    assert not Folder(board).index.exists()


def test_a_kept_digest_reveals_a_log_cut_at_its_end(board):
    """As where a board was cloned without its index: the rest of the log is in order."""
    kept = verify(board).log_digest
    folder = Folder(board)
    first = LogEntry.from_dict(json.loads(folder.log_entry(0).read_text()))
    last = LogEntry.from_dict(json.loads(folder.log_entry(LAST).read_text()))
    for digest in (kept, hex_of(kept), first.digest):
        assert verify(board, contains=digest).entries == 11
    folder.log_entry(LAST).unlink()
    folder.submission(last.subject).unlink()
    folder.index.unlink()
    cut = verify(board)
    assert (cut.log_sequence, cut.results) == (LAST - 1, 4)  # the rest is a valid log
    assert first_altered(board, contains=kept) == "log"
    assert verify(board, contains=first.digest) == cut


def test_a_kept_digest_reveals_a_rewritten_log(board):
    kept = verify(board).log_digest
    folder = Folder(board)
    alter(folder.log_entry(LAST), lambda plain: plain.update({"time": "2126-11-21T09:30:00Z"}))
    resign(board, folder.signing_key())
    assert verify(board).entries == 11
    assert first_altered(board, contains=kept) == "log"


def test_invalid_options_and_a_missing_board_are_not_tampering(tmp_path):
    for text in ("", "3f2a", "sha256:" + "x" * 64):
        with pytest.raises(OptionError, match="contains="):
            verify(tmp_path, contains=text)
    with pytest.raises(BoardError, match="contains no board"):
        verify(tmp_path)
    with pytest.raises(OptionError, match="rescore=-1"):
        verify(tmp_path, rescore=-1)
    with pytest.raises(OptionError, match="seed=-1"):
        verify(tmp_path, rescore=1, seed=-1)


def test_another_board_document_or_key_is_named(board):
    path = board / "board.json"
    for field, value in [
        ("title", "Another"),
        ("draws", 200),
        ("key", "ab" * 32),
        ("protocol_name", "other-v1"),
    ]:
        assert_named(
            board, path, changed(path, lambda plain, new={field: value}: plain.update(new))
        )
    (board / "board.key").unlink()
    SigningKey.generate().write(board / "board.key")
    assert first_altered(board) == "board.key"


# The first entry, one of each event, and the last.
@pytest.mark.parametrize("sequence", [0, 1, 7, 9, LAST])
def test_an_altered_log_entry_is_named(board, sequence):
    path = Folder(board).log_entry(sequence)
    plain, data = json.loads(path.read_text()), path.read_bytes()
    digest = "sha256:" + "1" * 64
    fields = {
        "time": "2001-01-01T00:00:00Z",
        "subject": digest,
        "previous": digest,
        "event": "withdrawn" if plain["event"] == "result" else "result",
        "signature": "0" * 128,
    }
    for field, value in fields.items():
        assert_named(board, path, to_json({**plain, field: value}).encode())
    assert_named(board, path, None, b"", data[:-9], b"\xff\x00", data + b" ")

    path.write_bytes(to_json({**plain, "document": digest}).encode())
    assert first_altered(board) == ("board.json" if sequence == 0 else where(board, path))
    path.unlink()
    Folder(board).index.unlink()
    if sequence < LAST:
        assert first_altered(board) == where(board, path)
    else:  # a submission whose entry is cut off looks like one that was being received
        assert verify(board).unlogged == 1


def test_swapped_and_inserted_log_entries_are_named(board):
    entry = Folder(board).log_entry
    assert_swap_named(board, entry(4), entry(5))
    for number, file in [(9, "00000011.json"), (9, "00000013.json"), (9, "notes.txt")]:
        path = board / "log" / file
        path.write_bytes(entry(number).read_bytes())
        expected = "log/notes.txt" if file == "notes.txt" else "log/00000011.json"
        assert first_altered(board) == expected
        path.unlink()
    resign(board, SigningKey.generate(), 3)
    assert first_altered(board) == "log/00000003.json"


def test_an_altered_submission_is_named(board):
    paths = [Folder(board).submission(id) for id in ids(board)]
    for path in (paths[STEADY], paths[FAILED], paths[WAITING]):
        assert_named(
            board,
            path,
            None,
            path.read_bytes().replace(b"  ", b"   "),
            changed(path, lambda plain: plain.update(signature="0" * 128)),
            changed(path, lambda plain: plain["submission"]["method"].update(name="Better")),
        )
    assert_swap_named(board, *paths[:2])
    # What the board's own key cannot do: sign for a submitter.
    alter(paths[WAITING], lambda plain: plain.update(signature="0" * 128))
    resign(board, Folder(board).signing_key(), LAST)
    assert first_altered(board) == where(board, paths[WAITING])


def test_an_altered_withdrawal_or_result_is_named(board):
    folder, known = Folder(board), ids(board)
    path = folder.withdrawal(known[FAILED])
    assert_named(
        board, path, None, changed(path, lambda plain: plain["withdrawal"].update(reason="another"))
    )
    rejection = {"status": "rejected", "code": "onnx_op", "scores": None}
    for path in (folder.result(known[STEADY]), folder.result(known[FAILED])):
        assert_named(
            board,
            path,
            None,
            changed(path, lambda plain: plain["scores"]["wd_regret"].update(value=0.0)),
            changed(path, lambda plain: plain["runs"][0].update(wd_regret=0.0)),
            changed(path, lambda plain: plain.update(rejection)),
        )
    assert_swap_named(board, *(folder.result(id) for id in known[:2]))


def test_a_file_that_the_log_does_not_name_is_named_or_counted(board):
    folder, known = Folder(board), ids(board)
    with Store.open(board, read_only=True) as store:
        signed, _ = tiny_submission(store, SigningKey.generate(), 5)
    path = folder.submission(signed.id)
    path.write_bytes(signed.to_bytes())
    assert verify(board).unlogged == 1  # it was about to be logged
    alter(path, lambda plain: plain["submission"]["method"].update(name="Better"))
    assert first_altered(board) == where(board, path)
    path.unlink()
    result = folder.result(known[STEADY]).read_bytes()
    for path in (folder.result(known[WAITING]), board / "results" / "note.json"):
        path.write_bytes(result)
        assert first_altered(board) == where(board, path)
        path.unlink()


def test_an_altered_artefact_is_named(board):
    path = sorted(board.glob("objects/*/*"))[1]
    assert_named(board, path, None, path.read_bytes()[:-1] + b"!")
    path = path.with_name("0" * 62)
    path.write_bytes(b"no such hash")
    assert first_altered(board) == where(board, path)


@pytest.mark.parametrize(
    ("change", "row"),
    [
        ("UPDATE entry SET scores = replace(scores, '.', '.0') WHERE id = '{id}'", "entry {id}"),
        ("DELETE FROM entry WHERE id = '{id}'", "entry {id}"),
        ("INSERT INTO object VALUES ('sha256:0', 1, '', '')", "object sha256:0"),
        ("UPDATE head SET sequence = 4", "head 0"),
    ],
)
def test_an_edited_index_is_named_with_its_first_altered_row(board, change, row):
    id = ids(board)[FAILED]
    with contextlib.closing(sqlite3.connect(Folder(board).index)) as connection:
        connection.execute(change.format(id=id))
        connection.commit()
    assert first_altered(board) == f"index.sqlite: {row.format(id=id)}"


def test_a_forged_and_signed_result_is_detected(board):
    """Chain, signatures and digests are all right: the numbers are not."""
    honest = result_on(board, FAILED)
    run, failed = honest.runs
    unlisted = failed.model_copy(update={"spec": run.spec})
    lies = {
        "another policy": [run.model_copy(update={"artefact": "sha256:" + "1" * 64}), failed],
        "other states": [run.model_copy(update={"evaluation_seed": 1}), failed],
        "a run's metric": [run.model_copy(update={"wd_regret": 0.0}), failed],
        "another order": [failed, run],
        "the failed run left out": [run],
        "the failed run scored 0": [
            run,
            failed.model_copy(update={"normalised_regret": (0.0,) * 6}),
        ],
        "the failed run with the constant's decay": [
            run,
            failed.model_copy(update={"ood_decay": 0.0}),
        ],
    }
    forged = {name: with_runs(board, honest, runs) for name, runs in lies.items()}
    forged["a score"] = honest.model_copy(
        update={"scores": honest.scores.model_copy(update={"wd_regret": honest.scores.ood_regret})}
    )
    for name, spared in {
        "the unlisted run left out": [],
        "the unlisted run scored 0": [
            unlisted.model_copy(update={"normalised_regret": (0.0,) * 6, "wd_regret": 0.0})
        ],
        "the unlisted run with the constant's decay": [
            unlisted.model_copy(update={"ood_decay": 0.0})
        ],
    }.items():
        forged[name] = with_runs(board, honest, honest.runs, unlisted=spared)
    for name, result in forged.items():
        path = forge(board, result)
        assert first_altered(board) == where(board, path), name
    forge(board, honest)
    assert verify(board).results == 4


def test_a_result_of_an_earlier_version_that_gives_single_runs_an_interval_is_accepted():
    single = {"value": 0.5, "low": None, "high": None}
    assert close(single, {"value": 0.5, "low": 0.5, "high": 0.5}, 1e-12)
    assert not close(single, {"value": 0.5, "low": 0.4, "high": 0.6}, 1e-12)
    assert not close(single, {"value": 0.6, "low": 0.6, "high": 0.6}, 1e-12)


# The board of the examples


def test_the_example_board_is_small_and_verifies_down_to_its_policies():
    report = verify(EXAMPLE, rescore=1)
    assert (report.submissions, report.results, report.unlogged) == (4, 4, 0)
    assert not (EXAMPLE / "board.key").exists()
    assert sum(path.stat().st_size for path in EXAMPLE.rglob("*") if path.is_file()) < 300_000


def test_two_methods_are_ranked_with_ten_runs():
    with Store.open(EXAMPLE, read_only=True) as store:
        entries = store.entries()
        refuse_unpublishable(entries)
        ranked = [row for row in ranking(entries, "ood_regret") if row.first is not None]
        assert [row.entry.method for row in ranked] == ["Hill climbing", "Random search"]
        for row in ranked:
            result = store.result(row.entry.id)
            assert [member.runs for member in result.classes] == [10]
            assert 0.0 < result.scores.ood_regret.low <= result.scores.ood_regret.high < 1.5
