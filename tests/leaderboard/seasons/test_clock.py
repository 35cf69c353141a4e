"""What a wrong clock of the machine does to a served board, and to what it has written."""

import contextlib
import time

import httpx
import pytest

from leaderboard.scoring.worker import Work, beside, run_scorer
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.tickets import ScoreTicket
from leaderboard.seasons.web import SeasonRoutes
from leaderboard.store.log import to_bytes
from tests.leaderboard.clocks import set_clocks
from tests.leaderboard.conftest import put_submission, signed_withdrawal
from tests.leaderboard.seasons.playing import online_board
from tests.leaderboard.seasons.sealing import signed_request
from tests.leaderboard.serving import serving
from tests.leaderboard.test_cli import fails, good

MONTH = 24.0 * 30


@pytest.fixture
def board(home, monkeypatch):
    monkeypatch.setattr(SeasonRoutes, "job", None)
    return online_board(home)


@contextlib.contextmanager
def served(board):
    """A server and a scorer, by threads of this process, whose clocks are set."""
    work = Work(submissions=False, job=ScoreTicket((board.secret,)), board=SeasonStore)

    def score(stop):
        run_scorer(board.path, work=work, until_empty=False, stop=stop.is_set)

    with beside("scorer", score), serving(board.path, season_secrets=[board.secret]) as url:
        httpx.get(f"{url}/healthz", trust_env=False)  # it has started
        yield url


def events(board, seconds=0.0, until=""):
    """The events of the log after so many seconds, or when one of them has come."""
    deadline = time.perf_counter() + seconds
    while True:
        with SeasonStore.open(board.path, read_only=True) as store:
            found = [entry.event for entry in store.log()]
        if until in found or time.perf_counter() > deadline:
            return found
        time.sleep(0.1)


def withdraw(url, store, key, signed):
    body = to_bytes(signed_withdrawal(store, signed.id, key, address=url))
    return httpx.post(f"{url}/api/withdrawals", content=body, trust_env=False).status_code


def test_a_clock_set_back_before_a_deadline_dates_nothing(board, key, monkeypatch):
    with served(board) as url:
        board.ticket(url, key)
        set_clocks(monkeypatch, forward=-3, passed=25)  # an hour after its deadline by the uptime
        assert "ended" not in events(board, 3, "ended")
        health = httpx.get(f"{url}/healthz", trust_env=False).json()
        assert health == {"status": "ok", "scoring": "fault"}
        set_clocks(monkeypatch, passed=25)
        assert "ended" in events(board, 20, "ended")
    secret = ("--secret", board.secret)
    good("season", "reveal", "board", board.season.id, *secret)
    good("verify", "board")


def test_a_clock_set_a_month_ahead_closes_no_season(board, key, monkeypatch):
    with SeasonStore.open(board.path) as store:
        signed = put_submission(store, key)
        with served(board) as url:
            set_clocks(monkeypatch, forward=MONTH)
            assert withdraw(url, store, key, signed) == 503
            set_clocks(monkeypatch)
            assert withdraw(url, store, key, signed) == 200
            assert board.ticket(url, key).ticket == 1


def test_entries_of_a_machine_that_started_with_a_wrong_clock_are_corrected(
    board, key, monkeypatch
):
    with SeasonStore.open(board.path) as store:
        signed = put_submission(store, key)
        set_clocks(monkeypatch, forward=MONTH)
        with served(board) as url:
            assert withdraw(url, store, key, signed) == 200
    set_clocks(monkeypatch)
    message = fails(2, "admin", "clock", "board")
    assert "is behind the log's last entry" in message
    assert "entries 3 and later" in good("admin", "clock", "board", "--correct")
    assert "no entry" in good("admin", "clock", "board", "--correct")
    with served(board) as url:
        assert board.ticket(url, key).ticket == 1
    assert events(board)[2:] == ["received", "withdrawn", "clock", "ticket"]
    good("verify", "board")
    with SeasonStore.open(board.path, read_only=True) as store:
        assert max(entry.time for entry in store.log(4)) < store.log(3, 1)[0].time


def test_a_clock_that_has_jumped_while_serving_is_right_when_the_organiser_says_so(
    board, key, monkeypatch
):
    with served(board) as url:
        set_clocks(monkeypatch, forward=0.07)
        assert board.ticket(url, key).ticket == 1  # less than five minutes are no jump
    set_clocks(monkeypatch, forward=0.1)
    for _ in range(2):  # a restart of the server alone makes it not right
        with served(board) as url:
            assert board.send(url, board.request(key, 1), key).status_code == 503
    with served(board) as url:
        good("admin", "clock", "board")
        assert board.ticket(url, key, 1).ticket == 2


def test_a_running_ticket_has_the_deadline_of_its_corrected_start(board, key, monkeypatch):
    set_clocks(monkeypatch, forward=5)
    with served(board) as url:
        board.ticket(url, key)
        set_clocks(monkeypatch)
        assert "entries 2 and later" in good("admin", "clock", "board", "--correct")
        set_clocks(monkeypatch, passed=25)
        assert "ended" in events(board, 20, "ended")


def test_a_ticket_that_a_wrong_clock_has_ended_stays_ended_and_its_season_verifies(
    board, key, monkeypatch
):
    with SeasonStore.open(board.path) as store:
        store.add(signed_request(store, board.season, key))
    set_clocks(monkeypatch, forward=MONTH)
    with served(board):
        assert "ended" in events(board, 20, "ended")
    set_clocks(monkeypatch)
    assert "entries 3 and later" in good("admin", "clock", "board", "--correct")
    set_clocks(monkeypatch, passed=25)
    good("season", "reveal", "board", board.season.id, "--secret", board.secret)
    good("verify", "board")
