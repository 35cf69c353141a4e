"""Sealed seasons: `SeasonRoutes` over HTTP, whose messages `sme_registry.seasons.wire` defines.

    GET  /api/seasons                                           the board's seasons
    GET  /api/seasons/{id}                                      one season, its state and its reveal
    GET  /api/seasons/{id}/ranking?metric=wd_regret             its methods with results
    GET  /api/seasons/{id}/files?start=0                        a thousand of its public files
    GET  /api/seasons/{id}/files/{path}?start=0                 8 MiB of one
    POST /api/seasons/{id}/entries                              201 an offline entry, 200 known
    POST /api/seasons/{id}/tickets                              201 a ticket, 200 the same again;
                                                                signed, see `admission`
    GET  /api/seasons/{id}/tickets/{n}                          its status
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/start      present observations
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/steps      one step of all lanes
    POST /api/seasons/{id}/tickets/{n}/instances/{i}/finish     take no more steps
    GET  /api/seasons/{id}/tickets/{n}/instances/{i}/challenge  challenge states
    PUT  /api/seasons/{id}/tickets/{n}/instances/{i}/answers    201 stored, 200 the same again
    POST /api/seasons/{id}/tickets/{n}/end                      the ticket's end

Steps of an instance that is ready are taken in the event loop; what goes on from a snapshot or
waits for the disk runs in threads.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from anyio import CapacityLimiter, to_thread
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import Scope

from leaderboard.documents.signed import MAX_BYTES, Signed
from leaderboard.errors import Rejection
from leaderboard.scoring.worker import Job
from leaderboard.seasons.admission import receive_entry, refuse_other_sender, start_ticket
from leaderboard.seasons.entry import Entry, TicketRequest
from leaderboard.seasons.events import SeasonRow
from leaderboard.seasons.instance import Instance
from leaderboard.seasons.pages import SECTION
from leaderboard.seasons.scoring import (
    ranking_facts,
)
from leaderboard.seasons.store import SeasonStore
from leaderboard.seasons.tickets import ScoreTicket, Sessions, attending
from leaderboard.store import Store
from leaderboard.web.http import HTTP_CODES, RequestError, metric_of, read_body
from sme_registry import seasons
from sme_registry.io import open_regular, to_json

_SEASON = "/api/seasons/{season}"
_TICKET = _SEASON + "/tickets/{ticket}"
_INSTANCE = _TICKET + "/instances/{instance}"
_WORKERS = 4  # threads that go on from snapshots and write answers
_LARGEST = 2**31
_FILES = 1000  # in a list
_CHUNK = 2**23  # of a file
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
        assert isinstance(store, SeasonStore)
        self._store, self._address = store, address
        self._sessions = {
            each.season.id: each for path in secrets for each in Sessions.of_master(store, path)
        }
        self._secrets = tuple(each.secret for each in self._sessions.values())
        self._threads = CapacityLimiter(_WORKERS)
        self._requests = CapacityLimiter(1)
        self._entries = CapacityLimiter(1)
        self._rankings = CapacityLimiter(1)
        self._ranked: dict[tuple[str, str, str], bytes] = {}

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """End and score tickets while the block runs; afterwards another server may step them."""
        try:
            with attending(self._sessions.values()):
                yield
        finally:
            for each in self._sessions.values():
                each.close()

    @property
    def job(self) -> Job | None:
        """What scores tickets that are over; None if no season is stepped."""
        return ScoreTicket(self._secrets) if self._secrets else None

    @property
    def routes(self) -> list[Route]:
        """For a Starlette application; steps first, since they come most often."""
        return [
            Route(f"{_INSTANCE}/steps", self.step, methods=["POST"]),
            Route(f"{_INSTANCE}/start", self.start, methods=["POST"]),
            Route(f"{_INSTANCE}/finish", self.finish, methods=["POST"]),
            Route(f"{_INSTANCE}/challenge", self.challenge, methods=["GET"]),
            Route(f"{_INSTANCE}/answers", self.answer, methods=["PUT"]),
            Route("/api/seasons", self.get_seasons, methods=["GET"]),
            Route(_SEASON, self.get_season, methods=["GET"]),
            Route(f"{_SEASON}/ranking", self.get_ranking, methods=["GET"]),
            Route(f"{_SEASON}/files", self.get_files, methods=["GET"]),
            Route(f"{_SEASON}/files/{{path:path}}", self.get_file, methods=["GET"]),
            Route(f"{_SEASON}/entries", self.post_entry, methods=["POST"]),
            Route(f"{_SEASON}/tickets", self.post_ticket, methods=["POST"]),
            Route(_TICKET, self.get_ticket, methods=["GET"]),
            Route(f"{_TICKET}/end", self.end, methods=["POST"]),
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
        metric = metric_of(request)

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

    async def get_files(self, request: Request) -> Response:
        start = _start(request)

        def files() -> list[dict[str, Any]]:
            folder, parts = self._public_parts(request)
            paths = [path for part in parts for path in sorted((folder / part).rglob("[!.]*"))]
            return [
                {"path": path.relative_to(folder).as_posix(), "size": path.stat().st_size}
                for path in paths
                if path.is_file()
            ]

        listed = await self._in_thread(files)
        end = start + _FILES
        more = end if end < len(listed) else None
        return JSONResponse({"files": listed[start:end], "next": more})

    async def get_file(self, request: Request) -> Response:
        start, path = _start(request), request.path_params["path"]

        def read() -> bytes:
            folder, parts = self._public_parts(request)
            if path.split("/")[0] not in parts or "/." in path:
                raise RequestError("not_found", f"{HTTP_CODES['not_found']}.")
            try:
                with open_regular(folder / path) as stream:
                    stream.seek(start)
                    return stream.read(_CHUNK)
            except OSError:
                raise RequestError("not_found", f"{HTTP_CODES['not_found']}.") from None

        return _octets(await self._in_thread(read))

    def _public_parts(self, request: Request) -> tuple[Path, list[str]]:
        """The folder of a season, and those in it that are public."""
        row = self._store.season_row(request.path_params["season"])
        revealed = ["tickets"] if row.reveal else []
        return self._store.season_folder(row.digest).path, ["published", *revealed]

    def _view(self, row: SeasonRow) -> dict[str, Any]:
        return {
            "id": row.id,
            "digest": row.digest,
            "title": row.title,
            "track": row.track,
            "opens": row.opens,
            "closes": row.closes,
            "revealed": row.revealed or None,
            "served": row.id in self._sessions,
        }

    async def post_ticket(self, request: Request) -> Response:
        sessions = self.sessions_of(request.path_params["season"])
        text = await read_body(request, MAX_BYTES, "ticket")
        header = request.headers.get("Authorization")

        def start() -> tuple[seasons.Ticket, bool]:
            signed = Signed[TicketRequest].read(text)
            refuse_other_sender(self._store, signed, header, self._address)
            number, new = start_ticket(self._store, signed, sessions.digest, address=self._address)
            return sessions.ticket(number).document, new

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
        sessions = self.sessions_of(request.path_params["season"])
        number, token = _small(request.scope, "ticket"), _token(request.scope)
        status = await self._in_thread(lambda: sessions.status(number, token))
        return JSONResponse(status.to_dict())

    async def start(self, request: Request) -> Response:
        text = request.query_params.get("lanes", "")
        if not (text.isascii() and text.isdigit() and len(text) < 10):
            raise RequestError("bad_request", f"lanes={text!r:.80}: must be a number. Correct it.")
        lanes = int(text)

        def start(instance: Instance) -> bytes:
            return instance.start(lanes)

        return _octets(await self._used(request, start))

    async def finish(self, request: Request) -> Response:
        await self._used(request, lambda instance: instance.finish(_signature(request)))
        return Response()

    async def challenge(self, request: Request) -> Response:
        return _octets(await self._used(request, Instance.challenge))

    async def answer(self, request: Request) -> Response:
        sessions, where = self.place(request.scope)
        instance = await self._in_thread(lambda: sessions.open(*where))
        data = await read_body(request, instance.answer_bytes, "answers")
        new = await self._in_thread(lambda: instance.answer(data, _signature(request)))
        return Response(status_code=201 if new else 200)

    async def step(self, request: Request) -> Response:
        sessions, where = self.place(request.scope)
        body = await read_body(request, sessions.step_bytes, "steps")
        signature = _signature(request)

        def step() -> bytes:
            instance = sessions.open(*where)
            answer = instance.step(body, signature)
            sessions.hold(instance)
            return answer

        is_ready = sessions.is_ready(where.ticket, where.instance)
        return _octets(step() if is_ready else await self._in_thread(step))

    async def end(self, request: Request) -> Response:
        sessions = self.sessions_of(request.path_params["season"])
        number, token = _small(request.scope, "ticket"), _token(request.scope)
        await self._in_thread(lambda: sessions.end(number, token, _signature(request)))
        return Response()

    def sessions_of(self, season: str) -> Sessions:
        found = self._sessions.get(season)
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

    def place(self, scope: Scope) -> tuple[Sessions, _Where]:
        """The tickets and the instance that a request is for."""
        parameters = scope["path_params"]
        where = _Where(_small(scope, "ticket"), _token(scope), _small(scope, "instance"))
        return self.sessions_of(parameters["season"]), where

    async def _used(self, request: Request, use: Callable[[Instance], _T]) -> _T:
        """What a thread does with the instance that a request is for, whose ticket runs."""
        sessions, where = self.place(request.scope)

        def work() -> _T:
            instance = sessions.open(*where)
            result = use(instance)
            sessions.hold(instance)
            return result

        return await self._in_thread(work)

    async def _in_thread(self, work: Callable[[], _T]) -> _T:
        return await _run(work, self._threads)


async def _run(work: Callable[[], _T], limiter: CapacityLimiter) -> _T:
    return await to_thread.run_sync(work, limiter=limiter)


def _start(request: Request) -> int:
    text = request.query_params.get("start", "0")
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise RequestError("bad_request", f"start={text!r:.80}: must be a number.")
    return int(text)


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


def _signature(request: Request) -> str:
    return request.query_params.get("signature", "")


def _octets(data: bytes) -> Response:
    return Response(data, media_type="application/octet-stream")
