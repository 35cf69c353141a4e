"""Tickets stepped at once while their server is killed: no step may be lost, or taken twice.

    python -m benchmarks.sealed_kills [tickets] [requests] [kills]

Every answer that each entrant received is compared with a replay of the actions that it sent, and
the journals with these actions. By default 50 tickets, 400 requests each, and 20 kills.
"""

from __future__ import annotations

import logging
import sys
import tempfile
from pathlib import Path

from tests.leaderboard.seasons.killing import LANES, step_through_kills
from tests.leaderboard.seasons.playing import online_board


def main(tickets: int = 50, requests: int = 400, kills: int = 20) -> None:
    member = {"name": "deep", "setting": {"state_dim": 2, "action_dim": 1, "complexity": 5}}
    member |= {"instances": 1, "budget": requests * LANES}
    logging.getLogger("sme_registry.seasons").setLevel(logging.ERROR)  # each lost connection
    with tempfile.TemporaryDirectory() as folder:
        board = online_board(Path(folder), classes=[member])
        seconds = step_through_kills(board, tickets, requests, kills)
    print(
        f"{tickets} tickets, {tickets * requests:,} requests, {kills} kills in {seconds:.0f} s: "
        "every answer and every journal equals its replay"
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
