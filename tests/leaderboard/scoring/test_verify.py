"""`verify` names what was altered, scores again and says what it could not check."""

import json
import shutil

import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.documents.board import Folder, hex_of
from leaderboard.documents.result import Result
from leaderboard.documents.signed import SigningKey
from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.ranking import levels_of, ranking, refuse_unpublishable, run_metrics
from leaderboard.scoring.score import evaluation_seed
from leaderboard.scoring.verify import Difference, Note, Row, difference, draw, verify
from leaderboard.seasons.store import SeasonStore
from leaderboard.store import Store
from leaderboard.store.log import LogEntry, Objects
from sme_registry.errors import OptionError
from sme_registry.io import to_json
from tests.leaderboard.conftest import EXAMPLE, SEASONS, document_path
from tests.leaderboard.scoring.conftest import (
    FAILED,
    REFUSED,
    SENSITIVE,
    STEADY,
    WAITING,
    forge,
    ids,
    resign,
    result_on,
    with_runs,
)

LAST = 10


def where(board, path):
    return path.relative_to(board).as_posix()


def first_altered(folder, **arguments):
    with pytest.raises(TamperedError) as tampered:
        verify(folder, **arguments)
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


def table(report):
    return {row.what: (row.checked, row.unchecked) for row in report.rows}


def test_an_unaltered_board_is_verified_and_counted(board):
    before = {path: path.read_bytes() for path in board.rglob("*") if path.is_file()}
    seen = []
    report = verify(board, rescore=9, seed=7, progress=seen.append)
    assert report.is_confirmed
    assert (report.log_sequence, report.rescore_seed) == (LAST, 7)
    assert table(report) == {
        "log entries, and their documents": (11, 0),
        "signatures of submitters": (6, 0),
        "files by their digests": (17, 0),
        "results, from their runs": (4, 0),
        "marks of runs": (0, 3),
        "results, scored again": (4, 0),
    }
    assert set(ids(board)[:4]) <= set(seen)
    after = {path: path.read_bytes() for path in board.rglob("*") if path.is_file()}
    assert {path: data for path, data in after.items() if "-" not in path.name} == before
    Folder(board).key.unlink()
    Folder(board).index.unlink()
    assert table(verify(board))["results, scored again"] == (0, 4)
    assert not Folder(board).index.exists()


def test_a_kept_digest_reveals_a_log_cut_at_its_end(board):
    """As where a board was cloned without its index: the rest of the log is in order."""
    kept = verify(board).log_digest
    folder = Folder(board)
    first = LogEntry.from_dict(json.loads(folder.log_entry(0).read_text()))
    for digest in (kept, hex_of(kept), first.digest):
        assert verify(board, contains=digest).log_sequence == LAST
    folder.log_entry(LAST).unlink()
    cut = verify(board)
    assert cut.log_sequence == LAST - 1  # the rest is a valid log
    assert first_altered(board, contains=kept) == "log"
    assert verify(board, contains=first.digest) == cut


def test_a_kept_digest_reveals_a_rewritten_log(board):
    kept = verify(board).log_digest
    folder = Folder(board)
    alter(folder.log_entry(LAST), lambda plain: plain.update({"time": "2126-11-21T09:30:00Z"}))
    resign(board, folder.signing_key())
    assert verify(board).log_sequence == LAST
    assert first_altered(board, contains=kept) == "log"


def test_invalid_options_and_a_missing_board_are_not_tampering(tmp_path):
    for text in ("", "3f2a", "sha256:" + "x" * 64):
        with pytest.raises(OptionError, match="contains="):
            verify(tmp_path, contains=text)
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
    cut = (None,) if sequence < LAST else ()  # the end of a log leaves no trace
    assert_named(board, path, *cut, b"", data[:-9], b"\xff\x00", data + b" ")

    path.write_bytes(to_json({**plain, "document": digest}).encode())
    assert first_altered(board) == ("board.json" if sequence == 0 else where(board, path))


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


@pytest.mark.parametrize(
    ("number", "kind"),
    [(STEADY, "document"), (WAITING, "document"), (FAILED, "withdrawal"), (REFUSED, "result")],
)
def test_an_altered_document_is_named(board, number, kind):
    path = document_path(board, ids(board)[number], kind)
    data = path.read_bytes()
    assert_named(board, path, None, b"", data.replace(b"  ", b"   "), data[:-9] + b"!" + data[-8:])


def test_a_signature_that_the_board_has_made_up_is_named(board):
    """What the board's own key cannot do: sign for a submitter."""
    waiting, withdrawn = ids(board)[WAITING], ids(board)[FAILED]
    whole = shutil.copytree(board, board.with_name("whole"))
    with Store.open(board, read_only=True) as store:
        signed, withdrawal = store.submission(waiting), store.withdrawal(withdrawn)
    forge(board, signed.model_copy(update={"signature": "0" * 128}), "received", waiting)
    assert first_altered(board) == waiting
    forge(whole, withdrawal.model_copy(update={"signature": "0" * 128}), "withdrawn", withdrawn)
    assert first_altered(whole) == withdrawn


def test_an_altered_policy_file_is_named_and_a_missing_one_is_reported(board):
    with Store.open(board, read_only=True) as store:
        runs = {id: store.submission(id).content.runs[0] for id in ids(board)}
    path = Folder(board).object(runs[ids(board)[STEADY]].artefact.sha256)
    assert_named(board, path, b"", path.read_bytes()[:-1] + b"!")
    path.unlink()
    report = verify(board, rescore="all")
    assert report.missing == [runs[ids(board)[STEADY]].artefact.sha256]
    assert not report.is_confirmed
    assert table(report)["results, scored again"] == (3, 1)
    Folder(board).object(runs[ids(board)[WAITING]].artefact.sha256).unlink()  # not public yet
    assert table(verify(board))["files by their digests"] == (15, 1)
    path.with_name("0" * 62).write_bytes(b"no such hash")
    assert first_altered(board) == where(board, path.with_name("0" * 62))


def test_a_forged_and_signed_result_is_detected(board):
    """Chain, signatures and digests are all right: the numbers are not."""
    honest = result_on(board, FAILED)
    run, failed = honest.runs
    unlisted = failed.model_copy(update={"spec": run.spec})
    nothing, no_decay = {"normalised_regret": (0.0,) * 6}, {"ood_decay": 0.0}
    lies = [
        ("runs.0.artefact", [run.model_copy(update={"artefact": "sha256:" + "1" * 64}), failed]),
        ("runs.0.evaluation_seed", [run.model_copy(update={"evaluation_seed": 1}), failed]),
        ("runs.0.wd_regret", [run.model_copy(update={"wd_regret": 0.0}), failed]),
        ("runs.0", [failed, run]),
        ("runs", [run]),
        ("runs.1.normalised_regret.0", [run, failed.model_copy(update=nothing)]),
        ("runs.1.ood_decay", [run, failed.model_copy(update=no_decay)]),
    ]
    forged = [(path, with_runs(board, honest, runs)) for path, runs in lies]
    scores = honest.scores.model_copy(update={"wd_regret": honest.scores.ood_regret})
    forged.append(("scores.wd_regret.value", honest.model_copy(update={"scores": scores})))
    short = run.model_copy(update={"normalised_regret": run.normalised_regret[:-1]})
    forged.append(("runs.0", honest.model_copy(update={"runs": (short, failed)})))
    for path, spared in (
        ("scores.wd_regret.value", []),
        ("scores.wd_regret.value", [unlisted.model_copy(update={**nothing, "wd_regret": 0.0})]),
        ("scores.ood_decay.value", [unlisted.model_copy(update=no_decay)]),
    ):
        forged.append((path, with_runs(board, honest, honest.runs, unlisted=spared)))
    for path, result in forged:
        forge(board, result)
        assert first_altered(board) == f"result of {honest.submission}: {path}"
    forge(board, honest)
    assert verify(board).is_confirmed


def test_a_result_of_an_earlier_version_that_gives_single_runs_an_interval_is_accepted():
    single = {"value": 0.5, "low": None, "high": None}
    assert difference({"value": 0.5, "low": 0.5, "high": 0.5}, single, 1e-12) is None
    assert difference({"value": 0.5, "low": 0.4, "high": 0.6}, single, 1e-12)
    assert difference({"value": 0.6, "low": 0.6, "high": 0.6}, single, 1e-12)


def test_a_board_of_rules_2_is_read_where_its_documents_lie_and_accepts_nothing(tmp_path):
    board = shutil.copytree(SEASONS, tmp_path / "board")
    report = verify(board, board=SeasonStore)
    assert (report.log_sequence, len(report.missing), report.notes) == (30, 6, [])
    with SeasonStore.open(board) as store:
        decays = [store.result(row.id).scores.ood_decay.value for row in store.entries()]
        assert decays == pytest.approx([0.0, 0.0], abs=1e-6)  # N̄ − N₀ of π* and of ½
        with pytest.raises(BoardError, match="follows rules 2"):
            store.signing_key()
    for path in (*board.glob("results/*.json"), *board.glob("seasons/*/entries/*.json")):
        data = path.read_bytes()
        path.write_bytes(data.replace(b": ", b":  ", 1))
        assert first_altered(board, board=SeasonStore).startswith("document sha256:")
        path.write_bytes(data)


# Scored again: what is drawn, what is not confirmed, and what proves nothing


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


# The board of the examples


def test_the_example_board_is_small_and_verifies_down_to_its_policies():
    report = verify(EXAMPLE, rescore=1)
    assert report.is_confirmed
    assert table(report)["results, scored again"] == (1, 3)
    assert Folder(EXAMPLE).read().rules == 3
    assert not (EXAMPLE / "board.key").exists()
    assert sum(path.stat().st_size for path in EXAMPLE.rglob("*") if path.is_file()) < 330_000


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
