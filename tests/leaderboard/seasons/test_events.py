"""Seasons on a board: the order of things, what the clock forbids, and an index that follows."""

import pytest

from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.scoring.verify import verify
from leaderboard.seasons.season import Reveal
from leaderboard.seasons.store import SeasonStore
from leaderboard.store.log import Clock
from tests.leaderboard.clocks import AFTERWARDS, move_clock
from tests.leaderboard.conftest import derived, put_submission, tiny_board
from tests.leaderboard.seasons.sealing import (
    MASTER,
    failed_result,
    moment,
    replayed,
    signed_entry,
    signed_request,
    tiny_season,
)
from tests.leaderboard.store.crashing import crashes_before

ONLINE, OFFLINE = "sealed-online", "sealed-offline"
ANSWER = {"sha256": "sha256:" + "a" * 64, "size": 512}


def reveal(season):
    return Reveal(season=season.digest, master=MASTER.raw.hex())


def play(store, key, move):
    """Both kinds of season, from their announcement to their results."""
    offline, online = tiny_season(OFFLINE), tiny_season(ONLINE)
    entry = signed_entry(store, offline, key, [ANSWER, None])
    request = signed_request(store, online, key)
    put_submission(store, key)
    assert store.announce(offline)
    assert store.announce(online)
    assert store.add(entry) == (1, True)
    assert store.add(request) == (1, True)
    assert store.finish(failed_result(online, request.id))
    move()
    for season in (offline, online):
        assert store.reveal(reveal(season))
    assert store.finish(failed_result(offline, entry.id))
    return offline, online


def test_a_season_is_played_from_its_announcement_to_its_results_and_reindexed(store, key, later):
    offline, online = play(store, key, later)
    assert [row.id for row in store.seasons()] == [OFFLINE, ONLINE]
    assert store.season(OFFLINE) == store.season(offline.digest) == offline
    events = [entry.event for entry in store.log()]
    assert events == [
        *("opened", "received", "season", "season", "entry", "ticket", "ended"),
        *("revealed", "revealed", "ranked"),
    ]
    for season in (offline, online):
        [row] = store.entrants(season.digest)
        assert (row.number, row.status) == (1, "scored")
        assert store.sealed_result(row) == failed_result(season, row.id)
        assert store.revealed_master(season.id) == MASTER
    grown = derived(store)
    store.reindex()
    assert derived(store) == grown
    with SeasonStore.open(store.folder.path, read_only=True) as reader:
        assert derived(reader) == grown
    report = verify(store.folder.path, board=SeasonStore)
    assert report.missing == [ANSWER["sha256"]]  # which the board lost


@pytest.mark.parametrize("track", [OFFLINE, ONLINE])
def test_the_clock_decides_and_no_earlier_clock_reopens(store, key, track, monkeypatch):
    def attempt(season):
        if track == OFFLINE:
            return store.add(signed_entry(store, season, key, [None, None]))
        return store.add(signed_request(store, season, key))

    coming = tiny_season(track, id="coming", opens=moment(0.5))
    other = tiny_season(ONLINE if track == OFFLINE else OFFLINE)
    season = tiny_season(track)
    for each in (coming, other, season):
        store.announce(each)
    with pytest.raises(Rejection, match="season_not_open"):
        attempt(coming)
    with pytest.raises(Rejection, match="season_track"):
        attempt(other)
    move_clock(monkeypatch)
    with pytest.raises(Rejection, match="season_closed"):
        attempt(season)
    store.announce(tiny_season(track, id="later", opens=AFTERWARDS, closes=moment(9)))
    monkeypatch.undo()
    with pytest.raises(BoardError, match="is behind the log's last entry"):
        attempt(season)


def test_a_reveal_follows_the_tickets_and_nothing_the_reveal(store, key, later):
    season = tiny_season(ONLINE)
    store.announce(season)
    request = signed_request(store, season, key)
    store.add(request)
    later()
    with pytest.raises(Rejection, match="1 tickets run, the first of them number 1"):
        store.reveal(reveal(season))
    store.finish(failed_result(season, request.id))
    assert store.reveal(reveal(season))
    assert not store.reveal(reveal(season))
    with pytest.raises(Rejection, match="season_revealed"):
        store.add(signed_request(store, season, key, 2))
    with pytest.raises(Rejection, match="season_revealed"):
        store.admit(season.id, key.public, "A Lab")


def test_no_reveal_tells_the_tasks_of_another_season_that_is_not_over(store, key, later):
    short, long = tiny_season(), tiny_season(id="long", closes=moment(9))
    store.announce(short)
    store.announce(long)
    later()
    with pytest.raises(Rejection, match="season_not_closed: season=long: closes at"):
        store.reveal(reveal(short))
    assert store.season_row(short.id).reveal is None


def test_what_is_allowed_and_what_is_logged_are_of_the_same_moment(store, key, later, monkeypatch):
    """The close may pass while an entry's file is being written."""
    season = tiny_season()
    store.announce(season)
    real = Clock.received
    monkeypatch.setattr(Clock, "received", lambda clock: (real(clock), later())[0])
    store.add(signed_entry(store, season, key, [None, None]))
    [row] = store.entrants(season.digest)
    assert row.received < season.closes


@pytest.mark.parametrize("track", [OFFLINE, ONLINE])
def test_what_the_board_forged_or_was_signed_for_another_is_named(store, tmp_path, key, track):
    season = tiny_season(track)
    entered = signed_entry(store, season, key, [None, None])
    signed = entered if track == OFFLINE else signed_request(store, season, key)
    with tiny_board(tmp_path / "other") as other:
        forged = {store: signed.model_copy(update={"signature": "0" * 128}), other: signed}
        for board, each in forged.items():
            board.announce(season)
            board.add(each)
            with pytest.raises(TamperedError, match="does not match the entrant's key"):
                replayed(board)


def test_an_id_is_one_seasons_and_a_season_ahead(store):
    season = tiny_season()
    assert store.announce(season)
    assert not store.announce(season)
    with pytest.raises(BoardError, match="another season of this board has it"):
        store.announce(tiny_season(title="Another"))
    with pytest.raises(BoardError, match="must be after the board's time"):
        store.announce(tiny_season(id="past", opens=moment(-3), closes=moment(-2)))


def test_what_processes_that_die_write_of_seasons_is_logged_or_not(tmp_path, key, later):
    season = tiny_season()
    with tiny_board(tmp_path / "board") as store:
        store.announce(season)
        entry = signed_entry(store, season, key, [None, None])

    online = tiny_season(ONLINE)
    with SeasonStore.open(tmp_path / "board") as store:
        store.announce(online)
        request, other = (signed_request(store, online, key, nonce) for nonce in (0, 1))

    def after_every_death(work):
        def run():
            with SeasonStore.open(tmp_path / "board") as opened:
                work(opened)

        call = 0
        while crashes_before(call, run):
            call += 1
        assert call > 3
        return SeasonStore.open(tmp_path / "board", read_only=True)

    with after_every_death(lambda store: store.add(entry)) as store:
        assert [row.id for row in store.entrants(season.digest)] == [entry.id]
    with after_every_death(lambda store: store.add(request)) as store:
        assert [row.number for row in store.entrants(online.digest)] == [1]
    with SeasonStore.open(tmp_path / "board") as store:
        assert store.add(other) == (2, True)
        assert store.add(request) == (1, False)
        for each in (request, other):
            store.finish(failed_result(online, each.id))
    later()
    with after_every_death(lambda store: store.reveal(reveal(season))) as store:
        assert store.revealed_master(season.id) == MASTER
    with after_every_death(lambda store: store.finish(failed_result(season, entry.id))) as store:
        assert [row.status for row in store.entrants(season.digest)] == ["scored"]
    verify(tmp_path / "board", board=SeasonStore)
