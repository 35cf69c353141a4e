"""A ticket from its start to its result, over HTTP, with the client that entrants use."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from leaderboard.documents.keys import SigningKey
from leaderboard.scoring.sealed import instances
from leaderboard.store import Store
from sme_registry import sealed
from tests.leaderboard.sealed.playing import online_board
from tests.leaderboard.sealing import MASTER
from tests.leaderboard.serving import serving


def played(url: str, ticket: sealed.Ticket, number: int, steps: int) -> list[sealed.Steps]:
    """Random steps on an instance, then the constant ½ as answers."""
    instance = sealed.Instance(url, ticket, number, lanes=4)
    instance.begin()
    random = np.random.default_rng(number)
    taken = [instance.step(random.random((4, 1), dtype=np.float32)) for _ in range(steps)]
    states = instance.challenge()
    instance.send_answers(np.full((len(states), 1), 0.5, np.float32))
    instance.close()
    return taken


def test_a_ticket_is_played_scored_and_logged(tmp_path: Path) -> None:
    board = online_board(tmp_path)
    key = SigningKey.generate()
    with serving(board.path, season_secrets=[board.secret]) as url:
        ticket = board.ticket(url, key)
        assert ticket == board.ticket(url, key)
        played(url, ticket, 0, 16)
        played(url, ticket, 1, 5)
        with Store.open(board.path) as store:
            deadline = time.monotonic() + 60
            while (row := store.ticket(board.season.digest, 1)).result is None:
                assert time.monotonic() < deadline
                time.sleep(0.1)
            result = store.sealed_result(row)
    assert result is not None
    assert [run.wd_regret for run in result.runs] == [1.0, 1.0]
    assert [each.steps for each in result.stepping] == [64, 20]
    with Store.open(board.path) as store:
        nonce = store.request_of(row).ticket.nonce
    hidden = list(instances(board.season, MASTER, "1", nonce))
    assert len({each.spec.seed for each in hidden}) == 2
