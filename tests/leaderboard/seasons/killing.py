"""Many entrants step tickets while their server is killed again and again."""

from __future__ import annotations

import hashlib
import threading
import time
from dataclasses import dataclass, field

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
from tests.leaderboard.serving import serving_process


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


def step_through_kills(board, tickets, requests, kills):
    """Let entrants step at once while the server is killed, evenly over their requests.

    Their answers must be those of a replay of their own actions, and so must be the journals. The
    budget must be at least `requests` times `LANES`. Returns the seconds that it took.
    """
    start = time.monotonic()
    with listen("127.0.0.1", 0) as listener:
        url = url_of(listener)
    port, threads, entrants = url.rpartition(":")[2], [], []
    for kill in range(1, kills + 2):
        with serving_process(board.path, port=port, secrets=[board.secret]):
            if not threads:
                keys = enumerate(SigningKey.generate() for _ in range(tickets))
                entrants = [Entrant(board.ticket(url, key, number)) for number, key in keys]
                threads = begun(entrants, url, requests)
            due = tickets * requests * kill // (kills + 1)
            while sum(each.requests for each in entrants) < due and any(
                thread.is_alive() for thread in threads
            ):
                time.sleep(0.002)
    for thread, each in zip(threads, entrants, strict=True):
        thread.join()
        check(board, each, requests)
    return time.monotonic() - start


def begun(entrants, url, requests):
    """The threads in which entrants play."""
    together = threading.Barrier(len(entrants), timeout=600)
    arguments = url, requests, together
    threads = [threading.Thread(target=each.play, args=arguments, daemon=True) for each in entrants]
    for thread in threads:
        thread.start()
    return threads


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
