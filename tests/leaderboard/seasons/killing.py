"""Many entrants step tickets while their server is killed again and again."""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from leaderboard.documents.signed import SigningKey
from leaderboard.seasons.journal import Journal, Play
from leaderboard.seasons.season import Master
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.tickets import Ticket
from leaderboard.web.server import listen, url_of
from sme_registry import seasons
from sme_registry.seasons.transcript import Chain, Transcript
from sme_registry.seasons.wire import StepFormat
from tests.leaderboard.seasons.playing import LANES

_SERVE = """
import sys
from pathlib import Path
from leaderboard.cli.admin import serve
board, secret, port = sys.argv[1:]
serve(Path(board), port=int(port), workers=0, season_secret=[Path(secret)])
"""


@dataclass
class Entrant:
    """One entrant's ticket, and what its server answered."""

    ticket: seasons.Ticket
    requests: int = 0
    seen: hashlib._Hash = field(default_factory=hashlib.sha256)
    error: BaseException | None = None

    def play(self, url, requests, together):
        """Begin, and when all others have begun take random steps until so many are answered."""
        try:
            instance = seasons.Instance(url, self.ticket, 0, lanes=LANES)
            self.seen.update(instance.begin().tobytes())
            together.wait()
            for actions in actions_of(self.ticket.ticket, requests):
                for part in instance.step(actions):
                    self.seen.update(part.tobytes())
                self.requests += 1
            instance.close()
        except BaseException as error:
            self.error = error


def actions_of(ticket, requests):
    """The actions of an entrant, `[L, A]` each."""
    random = np.random.default_rng(ticket)
    for _ in range(requests):
        yield random.random((LANES, 1), dtype=np.float32)


@contextlib.contextmanager
def killable(board):
    """A server on one port; yields its URL and what kills it."""
    with listen("127.0.0.1", 0) as listener:
        url = url_of(listener)
    server = KillableServer(board, url)
    try:
        yield url, server
    finally:
        server.kill()


class KillableServer:
    """A server in a process, which starts again on its port after each kill."""

    def __init__(self, board, url):
        self._command = [
            *(sys.executable, "-c", _SERVE, str(board.path), str(board.secret)),
            url.rpartition(":")[2],
        ]
        self.start()

    def start(self):
        root = str(Path(__file__).parents[3])
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": root}, text=True
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline(), "the server did not start"

    @property
    def pid(self):
        """Of the present process."""
        return self._process.pid

    def kill(self):
        """End it as a loss of its process would."""
        self._process.send_signal(signal.SIGKILL)
        self._process.communicate()


def step_through_kills(board, tickets, requests, kills):
    """Let entrants step at once while the server is killed, evenly over their requests.

    Their answers must be those of a replay of their own actions, and so must be the journals. The
    budget must be at least `requests` times `LANES`. Returns the seconds that it took.
    """
    begun = time.monotonic()
    with killable(board) as (url, server):
        entrants = [
            Entrant(board.ticket(url, SigningKey.generate(), number)) for number in range(tickets)
        ]
        together = threading.Barrier(tickets, timeout=600)
        threads = [
            threading.Thread(target=each.play, args=(url, requests, together), daemon=True)
            for each in entrants
        ]
        for thread in threads:
            thread.start()
        for kill in range(1, kills + 1):
            due = tickets * requests * kill // (kills + 1)
            while sum(each.requests for each in entrants) < due and any(
                thread.is_alive() for thread in threads
            ):
                time.sleep(0.002)
            server.kill()
            server.start()
        for thread in threads:
            thread.join()
    for each in entrants:
        check(board, each, requests)
    return time.monotonic() - begun


def check(board, entrant, requests):
    """Compare an entrant's answers and journal with a replay of the actions it sent."""
    if entrant.error is not None:
        raise entrant.error
    assert entrant.requests == requests
    number = entrant.ticket.ticket
    with SeasonStore.open(board.path, read_only=True) as store:
        row = store.ticket(board.season.digest, number)
        ticket = Ticket(store, board.season, Master.read(board.secret), row)
        folder = store.ticket_folder(board.season.digest, number)
    hidden, form, expected = ticket.hidden(0), StepFormat(LANES, 2, 1), hashlib.sha256()
    chain = Chain(request=ticket.id, ticket=number, instance=0)
    play = Play(hidden.spec, hidden.starts, chain, LANES, 10**9)
    expected.update(play.started[8:])
    journal = Journal.open(folder / "0.journal", 1)
    assert journal.requests == requests
    sent = actions_of(number, requests)
    for count, (actions, body) in enumerate(zip(sent, journal.bodies(), strict=True), start=1):
        assert body == form.pack(count, actions)
        for part in form.unpack_steps(play.take(body)):
            expected.update(part.tobytes())
    assert entrant.seen.digest() == expected.digest()
    assert Transcript(entrant.ticket.path, chain, 1).head(requests) == play.head
