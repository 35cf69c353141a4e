"""A revealed online season is replayed from its journals: what was altered is named."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from leaderboard.documents.keys import SigningKey
from leaderboard.documents.season import Reveal
from leaderboard.errors import TamperedError
from leaderboard.scoring.season import season_rankings
from leaderboard.scoring.verify import verify
from leaderboard.sealed import verify_season
from leaderboard.sealed.scores import score_ticket
from leaderboard.store import Store
from sme_registry import sealed
from tests.leaderboard.sealed.playing import Board, online_board
from tests.leaderboard.sealing import AFTERWARDS, MASTER
from tests.leaderboard.serving import serving


def play(board: Board, key: SigningKey, level: float) -> None:
    """A ticket whose actions are all of one level; it has ended and waits for its result."""
    with serving(board.path, season_secrets=[board.secret]) as url:
        ticket = board.ticket(url, key, nonce=int(100 * level))
        for number in range(2):
            instance = sealed.Instance(url, ticket, number, lanes=4)
            instance.begin()
            for _ in range(8):
                instance.step(np.full((4, 1), level, np.float32))
            answers = np.full((len(instance.challenge()), 1), level, np.float32)
            instance.send_answers(answers)
            instance.close()
        with Store.open(board.path) as store:
            deadline = time.monotonic() + 60
            while store.ticket(board.season.digest, ticket.ticket).result is None:
                assert time.monotonic() < deadline
                time.sleep(0.1)


@pytest.fixture
def revealed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: SigningKey) -> Any:
    board = online_board(tmp_path)
    play(board, key, 0.5)
    play(board, key, 0.25)
    for module in ("sealed", "log"):
        monkeypatch.setattr(f"leaderboard.store.{module}.now", lambda: AFTERWARDS)
    with Store.open(board.path) as store:
        store.reveal(Reveal(season=board.season.digest, master=MASTER.raw.hex()))
    return board


def test_a_season_of_tickets_is_replayed_and_every_one_of_them_counts(revealed: Board) -> None:
    with Store.open(revealed.path, read_only=True) as store:
        report = verify_season(store, revealed.season.id)
        assert (report.entries, report.results) == (2, 2)
        assert verify(revealed.path).sealed == 2
        [row] = season_rankings(store, revealed.season, "wd_regret")["generic"]
        results = [store.sealed_result(each) for each in store.entrants(revealed.season.digest)]
    values = [result.scores.wd_regret.value for result in results if result is not None]
    assert len(set(values)) == 2
    assert row.value.value == pytest.approx(np.mean(values))
    assert row.entry.runs == 4
    assert row.entry.steps == 4 * 32
    assert row.value.interval is not None


def test_altered_journals_and_answers_are_found(revealed: Board) -> None:
    with Store.open(revealed.path, read_only=True) as store:
        folder = store.season_folder(revealed.season.digest).ticket(1)
        files = [path for path in sorted(folder.iterdir()) if path.suffix != ".json"]
        assert len(files) >= 4  # a journal and answers of each instance
        for path in files:
            whole = path.read_bytes()
            middle = len(whole) // 2
            altered = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
            path.write_bytes(altered)
            with pytest.raises(TamperedError):
                verify_season(store, revealed.season.id)
            assert path.read_bytes() == altered
            path.write_bytes(whole)
        assert verify_season(store, revealed.season.id).results == 2


def test_a_learning_curve_that_no_journal_has_is_found(
    revealed: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flattered(*arguments: Any) -> Any:
        result = score_ticket(*arguments)
        first = result.stepping[0].model_copy(update={"normalised_online_regret": 0.0})
        return result.model_copy(update={"stepping": (first, *result.stepping[1:])})

    monkeypatch.setattr("leaderboard.sealed.replay.score_ticket", flattered)
    with (
        Store.open(revealed.path, read_only=True) as store,
        pytest.raises(TamperedError, match=r"stepping\.0: replayed from its journal"),
    ):
        verify_season(store, revealed.season.id)
