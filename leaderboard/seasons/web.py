"""Sealed seasons: their pages, and `SeasonRoutes` over HTTP, as `sme_registry.seasons.wire` says.

    GET  /api/seasons                                           the board's seasons
    GET  /api/seasons/{id}                                      one season, its state and its reveal
    GET  /api/seasons/{id}/ranking?metric=wd_regret             its methods with results
    GET  /api/seasons/{id}/files?start=0                        a thousand of its public files
    GET  /api/seasons/{id}/files/{path}?start=0                 8 MiB of one
    POST /api/seasons/{id}/entries                              201 an offline entry, 200 known

What is below `/api/seasons/{id}/tickets` is in `wire`; a ticket, and answers, are 201, or 200 if
the same were sent before.

Steps of an instance that is ready are taken in the event loop; what goes on from a snapshot or
waits for the disk runs in threads.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from anyio import CapacityLimiter, to_thread
from markupsafe import Markup
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from leaderboard.documents.signed import MAX_BYTES, Signed
from leaderboard.errors import Rejection
from leaderboard.scoring.ranking import REASONS
from leaderboard.scoring.worker import Job
from leaderboard.seasons.instance import Instance
from leaderboard.seasons.scoring import by_key, counting, enter, ranking_facts, season_rankings
from leaderboard.seasons.season import Entry, TicketRequest
from leaderboard.seasons.store import SealedRow, SeasonRow, SeasonStore
from leaderboard.seasons.tickets import (
    ScoreTicket,
    Sessions,
    attending,
    refuse_other_sender,
    start_ticket,
)
from leaderboard.store import Store
from leaderboard.web import tables
from leaderboard.web.pages import Pages, Section
from leaderboard.web.server import HTTP_CODES, RequestError, metric_of, read_body
from leaderboard.web.tables import setting_text
from sme_registry import seasons
from sme_registry.io import open_regular, to_json

_SEASON = "/api/seasons/{season}"
_TICKET = _SEASON + "/tickets/{ticket}"
_INSTANCE = _TICKET + "/instances/{instance}"
_WORKERS = 4  # threads that go on from snapshots and write answers
_LARGEST = 2**31
_FILES = 1000  # in a list
_CHUNK = 2**23  # of a file
_CURVE_POINTS = 40  # drawn
_T = TypeVar("_T")


def _files(pages: Pages) -> dict[str, Callable[[], str]]:
    store = pages.store
    assert isinstance(store, SeasonStore)
    rows = store.seasons()
    if not rows:
        return {}
    title = "Sealed seasons"
    listed = functools.partial(
        pages.render, "seasons.html", here="seasons.html", title=title, rows=rows
    )
    files = {f"seasons/{row.id}.html": functools.partial(_page, pages, store, row) for row in rows}
    return {**files, "seasons.html": listed}


SECTION = Section(("seasons.html", "Seasons"), Path(__file__).parent, _files)
"""A list of the seasons, and the page of each, before, during and after it."""


def _page(pages: Pages, store: SeasonStore, row: SeasonRow) -> str:
    season = row.terms
    rankings = season_rankings(store, season, "wd_regret")
    # The scorer of the reference rows has scored the entries, too.
    if pages.preparing and any(rankings.values()):
        return pages.preparation("../")
    return pages.render(
        "season.html",
        here="",
        root="../",
        title=season.title,
        reasons=REASONS,
        row=row,
        season=season,
        online=season.track == "sealed-online",
        settings=[setting_text(member.setting) for member in season.classes],
        entrants=_entrants(store, row, {each.id for each in counting(store, season)}),
        rankings=rankings,
        keys=by_key(store, season),
        master=store.revealed_master(row.digest).raw.hex() if row.reveal else "",
    )


def _entrants(store: SeasonStore, row: SeasonRow, counted: set[str]) -> list[dict[str, Any]]:
    """The entries or tickets of a season, for their table."""
    rows = store.entrants(row.digest)
    stepped = [_stepped(store, each) for each in rows]
    drawn = iter(tables.sparklines([curve for _, curve in stepped if curve], "From the first step"))
    return [
        {
            "row": each,
            "counts": each.id in counted,  # else, a later one of its method replaces it
            "online_regret": regret,
            "curve": next(drawn) if curve else Markup(""),
        }
        for each, (regret, curve) in zip(rows, stepped, strict=True)
    ]


@functools.lru_cache(4096)  # results may have megabytes, and never change
def _stepped(store: SeasonStore, row: SealedRow) -> tuple[float | None, list[float]]:
    """Of a ticket that has ended, the mean online regret, and the mean curve over the budget."""
    result = store.sealed_result(row)
    if result is None or not result.stepping:
        return None, []
    share = np.linspace(0.0, 1.0, _CURVE_POINTS)
    curves = [each.learning_curve for each in result.stepping]
    values = [np.interp(share, np.linspace(0.0, 1.0, len(curve)), curve) for curve in curves]
    regret = np.mean([each.normalised_online_regret for each in result.stepping])
    return float(regret), np.mean(values, axis=0).tolist()


class SeasonRoutes:
    """The handlers of a server, which steps the seasons whose masters are in `secrets`."""

    section = SECTION

    def __init__(
        self, store: Store, secrets: Iterable[str | os.PathLike[str]], address: str
    ) -> None:
        assert isinstance(store, SeasonStore)
        self._store, self._address = store, address
        self._secrets = tuple(map(Path, secrets))
        self._sessions = {
            each.season.id: each
            for path in self._secrets
            for each in Sessions.of_master(store, path)
        }
        self._threads = CapacityLimiter(_WORKERS)
        self._requests = CapacityLimiter(1)
        self._entries = CapacityLimiter(1)
        self._lists = CapacityLimiter(1)  # rankings and files: long ones keep no step waiting

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
            return {**self._view(row), "document": row.terms.to_dict(), "master": master}

        return JSONResponse(await self._in_thread(view))

    async def get_ranking(self, request: Request) -> Response:
        name = request.path_params["season"]
        metric = metric_of(request)

        def ranked() -> bytes:
            row = self._store.season_row(name)
            facts = ranking_facts(self._store, row.terms, metric)
            return to_json({**self._view(row), "metric": metric, "ranking": facts}).encode()

        return Response(await _run(ranked, self._lists), media_type="application/json")

    async def get_files(self, request: Request) -> Response:
        start = _query(request, "start", "0")

        def files() -> list[dict[str, Any]]:
            folder, parts = self._public_parts(request)
            paths = [path for part in parts for path in sorted((folder / part).rglob("[!.]*"))]
            return [
                {"path": path.relative_to(folder).as_posix(), "size": path.stat().st_size}
                for path in paths
                if path.is_file()
            ]

        listed = await _run(files, self._lists)
        end = start + _FILES
        more = end if end < len(listed) else None
        return JSONResponse({"files": listed[start:end], "next": more})

    async def get_file(self, request: Request) -> Response:
        start, path = _query(request, "start", "0"), request.path_params["path"]

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
        row = self._store.season_row(request.path_params["season"])
        revealed = ["tickets"] if row.reveal else []
        return self._store.season_folder(row.digest), ["published", *revealed]

    def _view(self, row: SeasonRow) -> dict[str, Any]:
        return {
            "id": row.id,
            "digest": row.digest,
            "title": row.terms.title,
            "track": row.terms.track,
            "opens": row.terms.opens,
            "closes": row.terms.closes,
            "revealed": row.revealed or None,
            "served": row.id in self._sessions,
        }

    async def post_ticket(self, request: Request) -> Response:
        sessions = self._served(request)
        text = await read_body(request, MAX_BYTES, "ticket")
        header = request.headers.get("Authorization")

        def start() -> tuple[seasons.Ticket, bool]:
            signed = Signed[TicketRequest].read(text)
            refuse_other_sender(self._store, signed, header, self._address)
            refuse_other_season(signed, sessions.digest)
            number, new = start_ticket(self._store, signed, self._address)
            return sessions.ticket(number).document, new

        ticket, new = await _run(start, self._requests)
        return JSONResponse(ticket.to_dict(), 201 if new else 200)

    async def post_entry(self, request: Request) -> Response:
        name = request.path_params["season"]
        text = await read_body(request, MAX_BYTES, "entry")

        # Garbage without a valid signature never waits with entries, whose check is longer.
        signed = await _run(lambda: Signed[Entry].read(text), self._requests)

        def admit() -> bool:
            refuse_other_season(signed, self._store.season_row(name).digest)
            return enter(self._store, signed, address=self._address)

        new = await _run(admit, self._entries)
        return JSONResponse({"id": signed.id}, 201 if new else 200)

    async def get_ticket(self, request: Request) -> Response:
        sessions, number, token = self._ticket(request)
        status = await self._in_thread(lambda: sessions.open(number, token).status)
        return JSONResponse(status.to_dict())

    async def end(self, request: Request) -> Response:
        (sessions, number, token), signature = self._ticket(request), _signature(request)
        await self._in_thread(lambda: sessions.open(number, token).end(signature))
        return Response()

    async def start(self, request: Request) -> Response:
        lanes = _query(request, "lanes")
        return _octets(await self._used(request, lambda instance: instance.start(lanes)))

    async def finish(self, request: Request) -> Response:
        await self._used(request, lambda instance: instance.finish(_signature(request)))
        return Response()

    async def challenge(self, request: Request) -> Response:
        return _octets(await self._used(request, Instance.challenge))

    async def answer(self, request: Request) -> Response:
        most = await self._used(request, lambda instance: instance.answer_bytes)
        data = await read_body(request, most, "answers")
        new = await self._used(request, lambda instance: instance.answer(data, _signature(request)))
        return Response(status_code=201 if new else 200)

    async def step(self, request: Request) -> Response:
        (sessions, number, token), instance = self._ticket(request), _instance(request)
        body = await read_body(request, sessions.step_bytes, "steps")
        signature = _signature(request)

        def step() -> bytes:
            return sessions.use(number, token, instance, lambda it: it.step(body, signature))

        if sessions.is_ready(number, instance):
            return _octets(step())
        return _octets(await self._in_thread(step))

    async def _used(self, request: Request, use: Callable[[Instance], _T]) -> _T:
        """What a thread does with the instance that a request is for, whose ticket runs."""
        (sessions, number, token), instance = self._ticket(request), _instance(request)
        return await self._in_thread(lambda: sessions.use(number, token, instance, use))

    def _served(self, request: Request) -> Sessions:
        season = request.path_params["season"]
        found = self._sessions.get(season)
        if found is not None:
            return found
        self._store.season_of_track(season, "sealed-online")
        raise RequestError(
            "season_not_served", f"season={season}: {HTTP_CODES['season_not_served']}."
        )

    def _ticket(self, request: Request) -> tuple[Sessions, int, str]:
        """The tickets of a season, the number of one, and the password that came with it."""
        number = _path_number(request, "ticket")
        token = request.headers.get("Authorization", "").removeprefix("Bearer ")
        return self._served(request), number, token

    async def _in_thread(self, work: Callable[[], _T]) -> _T:
        return await _run(work, self._threads)


async def _run(work: Callable[[], _T], limiter: CapacityLimiter) -> _T:
    return await to_thread.run_sync(work, limiter=limiter)


def _query(request: Request, name: str, default: str = "") -> int:
    """A number of the query."""
    text = request.query_params.get(name, default)
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise RequestError("bad_request", f"{name}={text!r:.80}: must be a number. Correct it.")
    return int(text)


def _path_number(request: Request, name: str) -> int:
    """A number of the path; of more than nine digits, one that no ticket or instance has."""
    text: str = request.path_params[name]
    if not (text.isascii() and text.isdigit()):
        raise RequestError("not_found", f"{HTTP_CODES['not_found']}.")
    return int(text) if len(text) < 10 else _LARGEST


def _instance(request: Request) -> int:
    return _path_number(request, "instance")


def _signature(request: Request) -> str:
    return request.query_params.get("signature", "")


def _octets(data: bytes) -> Response:
    return Response(data, media_type="application/octet-stream")


def refuse_other_season(signed: Signed[Entry] | Signed[TicketRequest], season: str) -> None:
    """Reject what was sent to another season than the one of this digest, for which it is."""
    if signed.content.season != season:
        raise Rejection(
            "season_unknown",
            f"season={signed.content.season}: the {signed.content.FIELD} was sent to the season "
            f"{season}. Send it to its own.",
        )
