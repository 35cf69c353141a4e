"""A board with a small sealed-online season, and an entrant of it."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import NamedTuple

import httpx
import numpy as np

from leaderboard.admission import upload_header
from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.errors import Rejection
from leaderboard.seasons.admission import start_ticket
from leaderboard.seasons.entrant import request_ticket
from leaderboard.seasons.entry import TicketRequest, signer_of
from leaderboard.seasons.scores import score_ticket
from leaderboard.seasons.season import Season
from leaderboard.seasons.tickets import Tickets
from leaderboard.store import Store
from sme_registry.io import sha256_of
from sme_registry.seasons import wire
from tests.leaderboard.conftest import tiny_board
from tests.leaderboard.seasons.sealing import MASTER, NOTHING, signed_request, tiny_season
from tests.leaderboard.serving import receiver

LANES = 4
ROWS = 6 * 50
"""Challenge states of an instance."""


class Board(NamedTuple):
    """A board's folder, its online season, and the file of the master."""

    path: Path
    season: Season
    secret: Path

    def request(self, key, nonce=0, **fields):
        """A signed request for a ticket."""
        with Store.open(self.path) as store:
            return signed_request(store, self.season, key, nonce, **fields)

    def send(self, url, request, key):
        """What a served board answers to a request for a ticket that a key sends."""
        path = url + wire.tickets_path(self.season.id)
        if request.content.signer == key.public:
            request = request.content.signed(key, Receiver(request.board, url))
        headers = {"Authorization": upload_header(key, request.id, request.receiver)}
        return httpx.post(path, content=request.to_bytes(), headers=headers, trust_env=False)

    def ticket(self, url, key, nonce=0, address=None):
        """A new ticket of a served board, whose address may not be where it is reached."""
        request = self.request(key, nonce).for_receiver(receiver(url, address), key)
        return request_ticket(url, self.season.id, request, key)


def online_board(folder, limits=None, **fields):
    """A board with an open season of one class, 64 steps on each of two instances."""
    season = tiny_season("sealed-online", **fields)
    secret = MASTER.write(folder / "season.master")
    with tiny_board(folder / "board", limits=limits or {}) as store:
        store.announce(season)
    return Board(folder / "board", season, secret)


@contextlib.contextmanager
def playing(board):
    """A ticket of a board, whose season is stepped in this process."""
    with Store.open(board.path) as store:
        played = Played(board, store)
        try:
            yield played
        finally:
            played.tickets.close()


class Played:
    """An entrant of a board without a server."""

    def __init__(self, board, store):
        self.board, self.store = board, store
        self.key = SigningKey.generate()
        self.tickets = Tickets(store, board.secret)
        self.take_ticket()

    def take_ticket(self, nonce=0):
        """Start a ticket; what follows is of this one."""
        self.request = self.board.request(self.key, nonce)
        envelope = Signed[TicketRequest].read(self.request.to_bytes())
        self.number, _ = start_ticket(self.store, envelope, self.board.season.digest)
        self.token = self.tickets.ticket(self.number).document.token

    def restart(self):
        """As after a kill: nothing but the files is left."""
        self.tickets.close()
        self.tickets = Tickets(self.store, self.board.secret)

    @property
    def folder(self):
        """Of the ticket."""
        return self.store.season_folder(self.board.season.digest).ticket(self.number)

    def status(self, instance=0):
        return self.tickets.status(self.number, self.token).instances[instance]

    def start(self, lanes=LANES, instance=0):
        return self.tickets.start(self.number, self.token, instance, lanes)

    def send(self, body, instance=0):
        return self.tickets.step(self.number, self.token, instance, body)

    def step(self, number, value=0.3, instance=0, lanes=LANES):
        return self.send(request(number, value, lanes), instance)

    def finish(self, instance=0):
        self.tickets.finish(self.number, self.token, instance)

    def answer(self, table, instance=0):
        data = table if isinstance(table, bytes) else wire.pack_table(table)
        journal = NOTHING
        with contextlib.suppress(Rejection):  # as long as steps may follow
            journal = self.tickets.journal_digest(self.number, self.token, instance)
        signature = self.signature(data, journal, instance)
        return self.tickets.answer(self.number, self.token, instance, data, signature)

    def signature(self, data, journal, instance=0):
        """The entrant's, of these answers and this digest of the steps."""
        signer = signer_of(self.request, self.key)
        assert signer is not None
        statement = wire.Statement(
            request=self.request.id,
            ticket=self.number,
            instance=instance,
            answers=sha256_of(data),
            journal=journal,
        )
        return signer.sign(statement)

    def score(self):
        """Score the ticket, and log its result; False if it has one."""
        season = self.board.season
        result = score_ticket(self.store, season, MASTER, self.number)
        return self.store.end_ticket(season.digest, self.number, result)


def request(number, value=0.3, lanes=LANES):
    """The body of a request for steps whose actions are all the same."""
    form = wire.StepFormat(lanes, 2, 1)
    return form.pack(number, np.full((lanes, 1), value, np.float32))
