"""`attending`: what a server does for its seasons beside requests: syncing, ending and scoring.

Every second the journals are synced, and tickets that are over are closed and scored, one after the
other in a process of their own, so that steps go on. Those that nobody has played need no
evaluation, and no process. A ticket that cannot be scored is tried again after all others, first
after a second, then after growing pauses of up to five minutes.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import signal
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

from leaderboard.documents.master import Master
from leaderboard.sealed.scores import score_ticket
from leaderboard.sealed.tickets import Tickets
from leaderboard.store import Store

_SECONDS = 1.0
_AT_ONCE = 100  # tickets: of a process, or unplayed ones of a second
_FIRST_PAUSE, _LONGEST_PAUSE = 1.0, 300.0
_STOP_SECONDS = 10.0
_log = logging.getLogger(__name__)


@contextlib.contextmanager
def attending(tickets: Collection[Tickets]) -> Iterator[None]:
    """Sync, end and score in a thread while the block runs."""
    if not tickets:
        yield
        return
    stop = threading.Event()
    attendants = [Attendant(each) for each in tickets]

    def attend() -> None:
        while not stop.wait(_SECONDS):
            for each in attendants:
                each.attend()

    thread = threading.Thread(target=attend, name="seasons", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        for each in attendants:
            each.stop()


class Attendant:
    """What a server does for one season beside requests."""

    def __init__(self, tickets: Tickets) -> None:
        self._tickets = tickets
        self._process: BaseProcess | None = None
        self._numbers: list[int] = []  # of the tickets that the process scores
        self._at_once = _AT_ONCE
        self._failed: set[int] = set()
        self._pause, self._retry_at = _FIRST_PAUSE, 0.0

    def attend(self) -> None:
        """Sync the journals, and score the next tickets that are over."""
        try:
            self._tickets.sync()
            is_scoring = self._is_scoring()
            played = self._tickets.end_unplayed(self._tickets.over(), _AT_ONCE)
            if is_scoring:
                return
            waiting = [number for number in played if number not in self._failed]
            if waiting:
                self._numbers = waiting[: self._at_once]
                for number in self._numbers:
                    self._tickets.close_ticket(number)
                self._process = self._start()
            elif time.monotonic() >= self._retry_at:
                self._failed.clear()
        except Exception as error:  # the board is locked, or has no memory or files left
            # Nothing but the kind of an error is logged: its text may name what is hidden.
            _log.error("season: cannot be attended to: %s", type(error).__name__)

    def stop(self) -> None:
        """End the scoring; the next server does it."""
        if self._process is not None:
            self._process.terminate()
            self._process.join(_STOP_SECONDS)

    def _start(self) -> BaseProcess:
        # Not forked: this process has threads, connections and locks.
        process = multiprocessing.get_context("spawn").Process(
            target=_score,
            args=(self._tickets.board, self._tickets.digest, self._tickets.secret, self._numbers),
            name="tickets",
        )
        process.start()
        return process

    def _is_scoring(self) -> bool:
        if self._process is None or self._process.is_alive():
            return self._process is not None
        failed = self._process.exitcode != 0
        self._process.close()
        self._process = None
        if failed:  # others first
            _log.error("season: a ticket could not be scored; it is tried again")
            self._failed.update(self._numbers)  # those with a result are not over any more
            self._retry_at = time.monotonic() + self._pause
        self._pause = min(2.0 * self._pause, _LONGEST_PAUSE) if failed else _FIRST_PAUSE
        # The process may have died before it came to the others.
        self._at_once = 1 if failed else _AT_ONCE
        return False


def _score(board: Path, season: str, secret: Path, numbers: Sequence[int]) -> None:
    """Score tickets and log their results, in a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends it
    failed = False
    for number in numbers:
        try:
            with Store.open(board) as store:
                result = score_ticket(store, store.season(season), Master.read(secret), number)
                store.end_ticket(season, number, result)
        except Exception as error:
            _log.error("season: scoring ticket %d failed: %s", number, type(error).__name__)
            failed = True
    raise SystemExit(failed)
