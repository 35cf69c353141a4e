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
from leaderboard.seasons.entrant import request_ticket, signer_of
from leaderboard.seasons.instance import Instance
from leaderboard.seasons.season import Season, TicketRequest
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.tickets import Sessions, Ticket, start_ticket
from sme_registry.seasons import wire
from sme_registry.seasons.transcript import (
    Chain,
    TicketHeads,
    answers_head,
    challenge_head,
    next_head,
)
from tests.leaderboard.conftest import tiny_board
from tests.leaderboard.seasons.sealing import MASTER, signed_request, tiny_season
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
        with SeasonStore.open(self.path) as store:
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
        ticket = request_ticket(url, self.season.id, request, key)
        ticket.write(self.path.parent / f"{self.season.id}-{ticket.ticket}.json")
        return ticket


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
    with SeasonStore.open(board.path) as store:
        played = Played(board, store)
        try:
            yield played
        finally:
            played.sessions.close()


class Played:
    """An entrant of a board without a server."""

    def __init__(self, board, store):
        self.board, self.store = board, store
        self.key = SigningKey.generate()
        self.sessions = Sessions(store, board.season, MASTER)
        self.take_ticket()

    def take_ticket(self, nonce=0):
        """Start a ticket; what follows is of this one."""
        self.request = self.board.request(self.key, nonce)
        envelope = Signed[TicketRequest].read(self.request.to_bytes())
        self.number, _ = start_ticket(self.store, envelope)
        self.token = self.ticket.document.token
        self.heads = {}  # of each instance, from h_0 on

    def restart(self):
        """Let another server go on, after this one has stopped."""
        self.sessions.close()
        self.sessions = Sessions(self.store, self.board.season, MASTER)

    def kill(self):
        """Let another server go on, without a chance for this one to put anything aside."""
        self.sessions._process_lock.release()
        self.sessions = Sessions(self.store, self.board.season, MASTER)

    @property
    def ticket(self):
        return self.sessions.ticket(self.number)

    @property
    def folder(self):
        """Of the ticket."""
        return self.store.ticket_folder(self.board.season.digest, self.number)

    def chain(self, instance):
        return Chain(request=self.request.id, ticket=self.number, instance=instance)

    def open(self, instance=0):
        return self.sessions.open(self.number, self.token).instance(instance)

    def use(self, instance, use):
        return self.sessions.use(self.number, self.token, instance, use)

    def status(self, instance=0):
        return self.sessions.open(self.number, self.token).status.instances[instance]

    def start(self, lanes=LANES, instance=0):
        data = self.use(instance, lambda it: it.start(lanes))
        if instance not in self.heads:
            self.heads[instance] = [self.chain(instance).first_head(lanes, data)]
        return data

    def send(self, body, instance=0):
        heads, signature = self.heads.get(instance, [b""]), self.signature(instance)
        answer = self.use(instance, lambda it: it.step(body, signature))
        if int.from_bytes(body[:8], "little") == len(heads):
            heads.append(next_head(heads[-1], body, answer))
        return answer

    def step(self, number, value=0.3, instance=0, lanes=LANES):
        return self.send(request(number, value, lanes), instance)

    def finish(self, instance=0):
        if instance not in self.heads:
            self.start(instance=instance)
        self.open(instance).finish(self.signature(instance))

    def answer(self, table, instance=0):
        data = table if isinstance(table, bytes) else wire.pack_table(table)
        heads, states = self.heads.get(instance, [b""]), b""
        with contextlib.suppress(Rejection):  # as long as steps may follow
            states = self.use(instance, Instance.challenge)
        head = answers_head(challenge_head(heads[-1], states), data)
        signature = self.sign(self.chain(instance).at(len(heads) + 1, head))
        return self.use(instance, lambda it: it.answer(data, signature))

    def end(self):
        """Sign the heads of all instances, as the board has them."""
        heads = [each.final_head for each in self.ticket.instances]
        document = TicketHeads(request=self.request.id, ticket=self.number, heads=tuple(heads))
        self.sessions.open(self.number, self.token).end(self.sign(document))

    def signature(self, instance=0):
        """The entrant's, of the transcript of an instance so far."""
        heads = self.heads.get(instance, [b""])
        return self.sign(self.chain(instance).at(len(heads) - 1, heads[-1].ljust(32, b"\0")))

    def sign(self, document):
        signer = signer_of(self.request, self.key)
        assert signer is not None
        return signer.sign(document)

    def score(self):
        """Score the ticket, and log its result; False if it has one."""
        season = self.board.season
        result = scored(self.store, season, self.number)
        is_new = self.store.finish(result)
        for each in self.ticket.instances:
            each.forget()
        return is_new


def scored(store, season, number):
    """The result of a ticket."""
    return Ticket(store, season, MASTER, store.ticket(season.digest, number)).score()


def request(number, value=0.3, lanes=LANES):
    """The body of a request for steps whose actions are all the same."""
    form = wire.StepFormat(lanes, 2, 1)
    return form.pack(number, np.full((lanes, 1), value, np.float32))
