"""A revealed online season is replayed from its journals: what was altered is named."""

import shutil
import struct
import zlib

import numpy as np
import pytest

from leaderboard.errors import TamperedError
from leaderboard.seasons.journal import Journal
from leaderboard.seasons.publication import files_of_seasons
from leaderboard.seasons.scoring import season_rankings
from leaderboard.seasons.season import Reveal
from leaderboard.seasons.store import SeasonStore
from leaderboard.store.log import Clock, digest_of
from leaderboard.web.client import fetch
from sme_registry.seasons import wire
from tests.leaderboard.clocks import AFTERWARDS, move_clock
from tests.leaderboard.seasons.playing import LANES, ROWS, online_board, playing, request, scored
from tests.leaderboard.seasons.sealing import MASTER, moment, replayed, signed_request
from tests.leaderboard.serving import serving


@pytest.fixture(scope="module")
def revealed(tmp_path_factory):
    """Two tickets, whose actions are all of one level. Nobody changes it."""
    board = online_board(tmp_path_factory.mktemp("revealed"))
    with playing(board) as played:
        for number, level in ((1, 0.5), (2, 0.25)):
            if played.number < number:
                played.take_ticket(number)
            for instance in range(2):
                played.start(instance=instance)
                for count in range(1, 9):
                    played.step(count, level, instance)
                played.finish(instance)
                played.answer(np.full((ROWS, 1), level), instance)
            played.end()
            played.score()
        with pytest.MonkeyPatch.context() as patch:
            move_clock(patch)
            played.store.reveal(Reveal(season=board.season.digest, master=MASTER.raw.hex()))
    return board


def test_a_season_of_tickets_is_replayed_and_every_one_of_them_counts(revealed):
    with SeasonStore.open(revealed.path, read_only=True) as store:
        counts = {"signatures of entrants": (2, 0), "results, scored again": (2, 0)}
        assert replayed(store) == (counts, [])
        [row] = season_rankings(store, revealed.season, "wd_regret")["generic"]
        results = [store.sealed_result(each) for each in store.entrants(revealed.season.digest)]
    ends = [result.signed for result in results]
    assert len(set(ends)) == 2
    assert None not in ends
    values = [result.scores.wd_regret.value for result in results if result is not None]
    assert len(set(values)) == 2
    assert row.value.value == pytest.approx(np.mean(values))
    assert row.entry.runs == 4
    assert row.entry.steps == 4 * 32
    assert row.value.interval is not None


def test_a_fetched_season_of_tickets_is_replayed_without_its_server(revealed, tmp_path):
    board = shutil.copytree(revealed.path, tmp_path / "board")
    with serving(board) as url:
        fetch(url, tmp_path / "copy", board=SeasonStore, parts=[files_of_seasons])
    shutil.rmtree(board)
    with SeasonStore.open(tmp_path / "copy", read_only=True) as store:
        counts, notes = replayed(store)
    assert (counts["results, scored again"], notes) == ((2, 0), [])


def test_altered_journals_and_answers_are_found(revealed, tmp_path):
    shutil.copytree(revealed.path, tmp_path / "board")
    with SeasonStore.open(tmp_path / "board", read_only=True) as store:
        folder = store.ticket_folder(revealed.season.digest, 1)
        files = sorted(folder.iterdir())
        # A journal, challenge states, answers and their signature of each instance; and the end.
        assert len(files) == 9
        for path in files:
            if path.suffix == ".challenge":  # which follow from the master
                continue
            whole = path.read_bytes()
            middle = len(whole) // 2
            altered = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
            path.write_bytes(altered)
            with pytest.raises(TamperedError):
                replayed(store)
            assert path.read_bytes() == altered
            path.write_bytes(whole)
        assert replayed(store)[1] == []
        answers, journal = folder / "0.npy", folder / "0.journal"
        unreadable = wire.pack_table(np.full((ROWS, 1), np.nan))
        for path, content in (
            (answers, answers.read_bytes()[:-4]), (answers, bytes(2**20)), (answers, unreadable),
            (answers, None), (journal, None),
        ):  # fmt: skip
            whole = path.read_bytes()
            path.unlink()
            if content is None:
                path.symlink_to(tmp_path / "elsewhere")
                (tmp_path / "elsewhere").write_bytes(whole)
            else:
                path.write_bytes(content)
            with pytest.raises(TamperedError):
                replayed(store)
            path.unlink()
            path.write_bytes(whole)
        assert replayed(store)[1] == []


@pytest.mark.parametrize(("lanes", "channels"), [(0, 1), (257, 1), (2**32 - 1,) * 2, (LANES, 2)])
def test_a_journal_s_sizes_are_checked_before_they_are_used(revealed, tmp_path, lanes, channels):
    shutil.copytree(revealed.path, tmp_path / "board")
    with SeasonStore.open(tmp_path / "board", read_only=True) as store:
        path = next(store.folder.seasons.rglob("*.journal"))
        header = struct.pack("<16sII", b"sme-journal/1\n\0\0", lanes, channels)
        path.write_bytes(header + zlib.crc32(header).to_bytes(4, "little"))
        with pytest.raises(TamperedError, match="is of other lanes or action channels"):
            replayed(store)


def replace_answers(folder):
    (folder / "0.npy").write_bytes(wire.pack_table(np.full((ROWS, 1), 0.75)))


def replace_journal(folder):
    (folder / "0.journal").unlink()
    journal = Journal.create(folder / "0.journal", LANES, 1)
    journal.append(np.full((LANES, 1), 0.75, "<f4").tobytes())
    journal.end()


def replace_signature(folder):
    text = (folder / "0.json").read_text()
    (folder / "0.json").write_text(text.replace('"hashes": 3', '"hashes": 1'))


@pytest.mark.parametrize("replace", [replace_answers, replace_journal, replace_signature])
def test_what_an_organiser_replaces_before_the_result_is_found(tmp_path, monkeypatch, replace):
    with playing(online_board(tmp_path)) as played:
        played.start()
        played.step(1, 0.5)
        played.finish()
        played.answer(np.full((ROWS, 1), 0.5))
        move_clock(monkeypatch)
        season = played.board.season
        result = scored(played.store, season, 1)
        replace(played.folder)
        with pytest.raises(TamperedError, match="is not the entrant's"):
            played.score()
        played.store.finish(result)
        played.store.reveal(Reveal(season=season.digest, master=MASTER.raw.hex()))
        with pytest.raises(TamperedError, match=r"tickets/1/0\.json: is not the entrant's"):
            replayed(played.store)


def test_what_the_entrant_has_not_signed_counts_for_nothing(tmp_path, monkeypatch):
    """An organiser adds steps and answers to instances that were never answered."""
    with playing(online_board(tmp_path)) as played:
        store, season = played.store, played.board.season
        for instance in (0, 1):
            played.start(instance=instance)
            played.step(1, 0.5, instance)
        played.finish(1)
        before = scored(store, season, 1)
        assert [each.steps for each in before.stepping] == [0, LANES]
        for instance in (0, 1):
            journal = Journal.open(played.folder / f"{instance}.journal", 1)
            journal.ended = False  # as the organiser's own program may do
            for number in range(2, 12):
                journal.append(request(number, 0.9)[8:])
            (played.folder / f"{instance}.npz").unlink(missing_ok=True)
            answers = wire.pack_table(np.full((ROWS, 1), 0.5))
            (played.folder / f"{instance}.npy").write_bytes(answers)
        played.restart()
        assert scored(store, season, 1) == before
        move_clock(monkeypatch)
        assert played.score()
        store.reveal(Reveal(season=season.digest, master=MASTER.raw.hex()))
        assert replayed(store)[1] == []
        assert store.sealed_result(store.ticket(season.digest, 1)) == before


@pytest.mark.parametrize(
    ("part", "changes", "path"),
    [
        ("runs", {"normalised_regret": (0.5,) * 6}, "runs.0.wd_regret"),
        ("runs", {"similarity_loss": 0.0}, "runs.0.similarity_loss"),
        ("scores", {}, "scores.wd_regret.value"),
        ("runs", {"artefact": "sha256:" + "a" * 64}, "runs.0.artefact"),
        ("stepping", {"normalised_online_regret": 0.0}, "stepping.0.normalised_online_regret"),
        ("stepping", {"learning_curve": (*(1.0,) * 15, 0.0)}, "stepping.0.learning_curve.0"),
        ("stepping", {"steps": 1}, "stepping.0.steps"),
        ("stepping", {"signed": "sha256:" + "a" * 64}, "stepping.0.signed"),
    ],
)
def test_a_result_that_does_not_follow_is_found(revealed, monkeypatch, part, changes, path):
    """One that contradicts itself was altered; other numbers are not confirmed."""
    with SeasonStore.open(revealed.path, read_only=True) as store:
        stored = store.sealed_result

        def lie(row):
            result = stored(row)
            assert result is not None
            if part == "scores":
                value = result.scores.wd_regret.model_copy(update={"value": 0.4})
                scores = result.scores.model_copy(update={"wd_regret": value})
                return result.model_copy(update={"scores": scores})
            first, *others = getattr(result, part)
            return result.model_copy(update={part: (first.model_copy(update=changes), *others)})

        monkeypatch.setattr(store, "sealed_result", lie)
        try:
            found = {note.difference.path for note in replayed(store)[1]}
        except TamperedError as error:
            found = {error.where.split(": ")[-1]}
        assert path in found


def logged(monkeypatch, time, store, *record):
    """Log something that a board must refuse, at a time, as an organiser's own board may do."""
    monkeypatch.setattr(Clock, "received", lambda _: time)
    with store.transaction():
        store.record(*record)


def reveal(board):
    """What `Database.record` needs to log the reveal of a season."""
    document = Reveal(season=board.season.digest, master=MASTER.raw.hex())
    return "revealed", board.season.digest, document


def forged(store, time, event, subject, document):
    """Write an entry of the log without asking anyone, as only the board's key can."""
    store.objects.write(document)
    head = store._log.read(len(list(store.folder.log.iterdir())) - 1).head
    key, digest = store.signing_key(), digest_of(document)
    store._log.write(store._log.entry(key, head, event, subject, digest, time))


@pytest.mark.parametrize(
    ("fields", "days", "number", "message"),
    [
        ({"opens": moment(0.5)}, 0.1, 1, "opens at"),
        ({}, 2, 1, "closed at"),
        ({}, 0.1, 3, "has started 2 of 2 tickets"),
        ({"tickets": 1}, 0.1, 2, "all of its 1 tickets were started"),
    ],
)
def test_no_log_has_forbidden_tickets(tmp_path, key, fields, days, number, message):
    board = online_board(tmp_path, **fields)
    with SeasonStore.open(board.path) as store:
        for count in range(1, number + 1):
            request = signed_request(store, board.season, key, count)
            forged(store, moment(days), "ticket", request.id, request)
    with pytest.raises(TamperedError, match=message) as found:
        SeasonStore.open(board.path, read_only=True)
    assert found.value.where == f"log/{number + 1:08d}.json"


def test_no_log_has_an_early_reveal_or_goes_back_in_time(tmp_path):
    for days, message in ((0.1, "closes at"), (-1, "is dated before the entry before it")):
        (tmp_path / str(days)).mkdir()
        board = online_board(tmp_path / str(days))
        with SeasonStore.open(board.path) as store:
            forged(store, moment(days), *reveal(board))
        with pytest.raises(TamperedError, match=message):
            SeasonStore.open(board.path, read_only=True)


def test_a_ticket_that_ended_early_without_all_answers_is_found(tmp_path, monkeypatch, key):
    board = online_board(tmp_path)
    with SeasonStore.open(board.path) as store:
        store.add(signed_request(store, board.season, key))
        store.finish(scored(store, board.season, 1))
        logged(monkeypatch, AFTERWARDS, store, *reveal(board))
        with pytest.raises(TamperedError, match="without all answers: must not be before"):
            replayed(store)


def test_a_ticket_that_ended_early_without_the_entrant_s_end_is_found(tmp_path, monkeypatch):
    with playing(online_board(tmp_path)) as played:
        for instance in (0, 1):
            played.finish(instance)
            played.answer(np.full((ROWS, 1), 0.5), instance)
        played.score()
        logged(monkeypatch, AFTERWARDS, played.store, *reveal(played.board))
        with pytest.raises(TamperedError, match="without the entrant's end: must not be before"):
            replayed(played.store)
