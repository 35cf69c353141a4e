"""Sealed seasons: `SeasonRoutes` over HTTP, whose messages `sme_registry.seasons.wire` defines.

    GET  /api/seasons                                           the board's seasons
    GET  /api/seasons/{id}                                      one season, its state and its reveal
    GET  /api/seasons/{id}/ranking?metric=wd_regret             its methods with results
    POST /api/seasons/{id}/entries                              201 an offline entry, 200 known
    POST /api/seasons/{id}/tickets                              201 a ticket, 200 the same again;
                                                                signed, see `admission`
    GET  /api/seasons/{id}/tickets/{n}                          its status
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/start      present observations
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/steps      one step of all lanes
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/finish     take no more steps
    GET  /api/seasons/{id}/tickets/{n}/instances/{i}/challenge  challenge states
    GET  /api/seasons/{id}/tickets/{n}/instances/{i}/journal    digest of the steps
    PUT  /api/seasons/{id}/tickets/{n}/instances/{i}/answers    201 stored, 200 the same again

Steps of an instance that is ready are taken in the event loop; what replays a journal or waits for
the disk runs in threads.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

from anyio import CapacityLimiter, to_thread
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import Scope

from leaderboard.documents.result import RANKED_METRICS
from leaderboard.documents.signed import MAX_BYTES, Signed
from leaderboard.errors import Rejection
from leaderboard.seasons.admission import receive_entry, refuse_other_sender, start_ticket
from leaderboard.seasons.entry import Entry, TicketRequest
from leaderboard.seasons.pages import SECTION
from leaderboard.seasons.ranking import (
    ranking_facts,
)
from leaderboard.seasons.tickets import Tickets, attending
from leaderboard.store import SeasonRow, Store
from leaderboard.web.http import HTTP_CODES, RequestError, read_body
from sme_registry import seasons
from sme_registry.io import to_json
from sme_registry.seasons import wire

_SEASON = "/api/seasons/{season}"
_TICKET = _SEASON + "/tickets/{ticket}"
_INSTANCE = _TICKET + "/instances/{instance}"
_WORKERS = 4  # threads that replay journals and write answers
_LARGEST = 2**31
_CURVE_POINTS = 40
_RANKINGS_KEPT = 16
_T = TypeVar("_T")


class SeasonRoutes:
    """The handlers of a server at an address.

    `secrets` are paths of the masters of the seasons that it steps.
    """

    section = SECTION

    def __init__(
        self, store: Store, secrets: Iterable[str | os.PathLike[str]], address: str
    ) -> None:
        self._store, self._address = store, address
        self._tickets = {
            each.season.id: each for path in secrets for each in Tickets.of_master(store, path)
        }
        self._threads = CapacityLimiter(_WORKERS)
        self._challenges = CapacityLimiter(1)
        self._requests = CapacityLimiter(1)
        self._entries = CapacityLimiter(1)
        self._rankings = CapacityLimiter(1)
        self._ranked: dict[tuple[str, str, str], bytes] = {}

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """End and score tickets while the block runs; afterwards another server may step them."""
        try:
            with attending(self._tickets.values()):
                yield
        finally:
            for each in self._tickets.values():
                each.close()

    @property
    def routes(self) -> list[Route]:
        """For a Starlette application; steps first, since they come most often."""
        return [
            Route(f"{_INSTANCE}/steps", self.step, methods=["POST"]),
            Route(f"{_INSTANCE}/start", self.start, methods=["POST"]),
            Route(f"{_INSTANCE}/finish", self.finish, methods=["POST"]),
            Route(f"{_INSTANCE}/challenge", self.challenge, methods=["GET"]),
            Route(f"{_INSTANCE}/journal", self.journal, methods=["GET"]),
            Route(f"{_INSTANCE}/answers", self.answer, methods=["PUT"]),
            Route("/api/seasons", self.get_seasons, methods=["GET"]),
            Route(_SEASON, self.get_season, methods=["GET"]),
            Route(f"{_SEASON}/ranking", self.get_ranking, methods=["GET"]),
            Route(f"{_SEASON}/entries", self.post_entry, methods=["POST"]),
            Route(f"{_SEASON}/tickets", self.post_ticket, methods=["POST"]),
            Route(_TICKET, self.get_ticket, methods=["GET"]),
        ]

    async def get_seasons(self, request: Request) -> Response:
        rows = await self._in_thread(self._store.seasons)
        return JSONResponse({"seasons": [self._view(row) for row in rows]})

    async def get_season(self, request: Request) -> Response:
        name = request.path_params["season"]

        def view() -> dict[str, Any]:
            row = self._store.season_row(name)
            master = self._store.revealed_master(row.digest).raw.hex() if row.reveal else None
            document = self._store.season(row.digest).to_dict()
            return {**self._view(row), "document": document, "master": master}

        return JSONResponse(await self._in_thread(view))

    async def get_ranking(self, request: Request) -> Response:
        name = request.path_params["season"]
        text = request.query_params.get("metric", RANKED_METRICS[0])
        metric = next((each for each in RANKED_METRICS if each == text), None)
        if metric is None:
            names = ", ".join(RANKED_METRICS)
            raise RequestError("bad_request", f"metric={text!r:.80}: must be one of {names}.")

        def rank() -> bytes:
            row = self._store.season_row(name)
            facts = ranking_facts(self._store, self._store.season(row.digest), metric)
            return to_json({**self._view(row), "metric": metric, "ranking": facts}).encode()

        def ranked() -> bytes:
            key = name, metric, self._store.head.digest
            if key not in self._ranked:
                if len(self._ranked) >= _RANKINGS_KEPT:
                    self._ranked.clear()
                self._ranked[key] = rank()
            return self._ranked[key]

        return Response(await _run(ranked, self._rankings), media_type="application/json")

    def _view(self, row: SeasonRow) -> dict[str, Any]:
        return {
            "id": row.id,
            "digest": row.digest,
            "title": row.title,
            "track": row.track,
            "opens": row.opens,
            "closes": row.closes,
            "revealed": row.revealed or None,
            "served": row.id in self._tickets,
        }

    async def post_ticket(self, request: Request) -> Response:
        tickets = self.tickets_of(request.path_params["season"])
        text = await read_body(request, MAX_BYTES, "ticket")
        header = request.headers.get("Authorization")

        def start() -> tuple[seasons.Ticket, bool]:
            signed = Signed[TicketRequest].read(text)
            refuse_other_sender(self._store, signed, header, self._address)
            number, new = start_ticket(self._store, signed, tickets.digest, address=self._address)
            return tickets.ticket(number).document, new

        ticket, new = await _run(start, self._requests)
        return JSONResponse(ticket.to_dict(), 201 if new else 200)

    async def post_entry(self, request: Request) -> Response:
        name = request.path_params["season"]
        text = await read_body(request, MAX_BYTES, "entry")

        # Garbage without a valid signature never waits with entries, whose check is longer.
        signed = await _run(lambda: Signed[Entry].read(text), self._requests)

        def enter() -> bool:
            season = self._store.season_row(name).digest
            return receive_entry(self._store, signed, season, self._address)

        new = await _run(enter, self._entries)
        return JSONResponse({"id": signed.id}, 201 if new else 200)

    async def get_ticket(self, request: Request) -> Response:
        tickets = self.tickets_of(request.path_params["season"])
        number, token = _small(request.scope, "ticket"), _token(request.scope)
        status = await self._in_thread(lambda: tickets.status(number, token))
        return JSONResponse(status.to_dict())

    async def start(self, request: Request) -> Response:
        text = request.query_params.get("lanes", "")
        if not (text.isascii() and text.isdigit() and len(text) < 10):
            raise RequestError("bad_request", f"lanes={text!r:.80}: must be a number. Correct it.")
        tickets, where = self.place(request.scope)
        lanes = int(text)
        return _octets(await self._in_thread(lambda: tickets.start(*where, lanes)))

    async def finish(self, request: Request) -> Response:
        tickets, where = self.place(request.scope)
        await self._in_thread(lambda: tickets.finish(*where))
        return Response()

    async def challenge(self, request: Request) -> Response:
        tickets, where = self.place(request.scope)
        await self._in_thread(lambda: tickets.refuse_challenge(*where))
        return _octets(await _run(lambda: tickets.challenge(*where), self._challenges))

    async def journal(self, request: Request) -> Response:
        tickets, where = self.place(request.scope)
        digest = await _run(lambda: tickets.journal_digest(*where), self._challenges)
        return JSONResponse(wire.JournalDigest(journal=digest).to_dict())

    async def answer(self, request: Request) -> Response:
        tickets, where = self.place(request.scope)
        limit = await self._in_thread(lambda: tickets.answer_bytes(*where))
        data = await read_body(request, limit, "answers")
        signature = request.query_params.get("signature", "")
        new = await self._in_thread(lambda: tickets.answer(*where, data, signature))
        return Response(status_code=201 if new else 200)

    async def step(self, request: Request) -> Response:
        tickets, where = self.place(request.scope)
        body = await read_body(request, tickets.step_bytes, "steps")
        steps = tickets.quick_step(*where, body)
        if steps is None:
            steps = await self._in_thread(lambda: tickets.step(*where, body))
        return _octets(steps)

    def tickets_of(self, season: str) -> Tickets:
        found = self._tickets.get(season)
        if found is not None:
            return found
        row = self._store.season_row(season)
        if row.track != "sealed-online":
            raise Rejection(
                "season_track",
                f"season={row.id}: its track is {row.track}: it takes entries, and has no tickets.",
            )
        raise RequestError(
            "season_not_served", f"season={season}: {HTTP_CODES['season_not_served']}."
        )

    def place(self, scope: Scope) -> tuple[Tickets, _Where]:
        """The tickets and the instance that a request is for."""
        parameters = scope["path_params"]
        where = _Where(_small(scope, "ticket"), _token(scope), _small(scope, "instance"))
        return self.tickets_of(parameters["season"]), where

    async def _in_thread(self, work: Callable[[], _T]) -> _T:
        return await _run(work, self._threads)


async def _run(work: Callable[[], _T], limiter: CapacityLimiter) -> _T:
    return await to_thread.run_sync(work, limiter=limiter)


class _Where(NamedTuple):
    """An instance of a ticket, and the password that a request sent for it."""

    ticket: int
    token: str
    instance: int


def _small(scope: Scope, name: str) -> int:
    """A number of the path; of more than nine digits, one that no ticket or instance has."""
    text: str = scope["path_params"][name]
    if not (text.isascii() and text.isdigit()):
        raise RequestError("not_found", f"{HTTP_CODES['not_found']}.")
    return int(text) if len(text) < 10 else _LARGEST


def _token(scope: Scope) -> str:
    """The password in the header `Authorization`; empty without one."""
    return Headers(scope=scope).get("Authorization", "").removeprefix("Bearer ")


def _octets(data: bytes) -> Response:
    return Response(data, media_type="application/octet-stream")
