"""A board with a small sealed-online season, and an entrant of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import httpx
import numpy as np
import numpy.typing as npt

from leaderboard.documents.entry import SignedTicketRequest
from leaderboard.documents.keys import SigningKey
from leaderboard.documents.season import Season
from leaderboard.documents.submission import SignedManifest
from leaderboard.intake import upload_header
from leaderboard.store import Store
from leaderboard.web import client
from sme_registry import sealed
from tests.leaderboard.conftest import tiny_board
from tests.leaderboard.sealing import MASTER, signed_request, tiny_season

Floats = npt.NDArray[np.float32]


class Board(NamedTuple):
    """A board's folder, its online season, and the file of the master."""

    path: Path
    season: Season
    secret: Path

    def request(self, key: SigningKey, nonce: int = 0, **fields: Any) -> SignedTicketRequest:
        """A signed request for a ticket."""
        with Store.open(self.path) as store:
            return signed_request(store, self.season, key, nonce, **fields)

    def send(self, url: str, request: SignedManifest, key: SigningKey) -> httpx.Response:
        """What a served board answers to a request for a ticket that a key sends."""
        path = url + sealed.tickets_path(self.season.id)
        headers = {"Authorization": upload_header(key, request.id, board=request.board)}
        return httpx.post(path, content=request.to_bytes(), headers=headers, trust_env=False)

    def ticket(self, url: str, key: SigningKey, nonce: int = 0) -> sealed.Ticket:
        """A new ticket of a served board."""
        return client.request_ticket(url, self.season.id, self.request(key, nonce), key)


def online_board(folder: Path, limits: dict[str, int] | None = None, **fields: Any) -> Board:
    """A board with an open season of one class, 64 steps on each of two instances."""
    season = tiny_season("sealed-online", **fields)
    secret = MASTER.write(folder / "season.master")
    with tiny_board(folder / "board", limits=limits or {}) as store:
        store.announce(season)
    return Board(folder / "board", season, secret)
