"""`create_app`: a board over HTTP, with its pages and a small API.

    GET  /…                              the pages, at the paths of `pages`
    PUT  /api/objects/<hex>              upload an artefact; signed, see `admission.uploads`
    GET  /api/objects/<hex>              its bytes, once it is scored, so that anyone can rescore it
    POST /api/submissions                202 accepted, 200 already known
    GET  /api/submissions/<hex>          status and result; reference rows may withhold scores
    POST /api/withdrawals                200
    GET  /api/board?metric=wd_regret     the ranking
    GET  /api/log?start=0                a hundred entries of the signed log
         /api/seasons/…                  sealed seasons, see `seasons.web`
    GET  /healthz                        200 while the server runs; scoring: ok, waiting or fault

An error is {"code", "message"}: the code of a `Rejection`, or one of `server.HTTP_CODES`. The
server keeps no sessions and sets no cookies; every request that changes the board is signed.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from importlib.util import find_spec
from typing import Any

import anyio
from anyio import CapacityLimiter, to_thread
from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from leaderboard import admission
from leaderboard.documents.board import hex_of
from leaderboard.documents.result import RANKED
from leaderboard.documents.signed import MAX_BYTES, Signed
from leaderboard.documents.submission import Submission, Withdrawal
from leaderboard.errors import BoardError, Rejection, ScoringFault
from leaderboard.gate.isolation import Isolation, available_isolation
from leaderboard.scoring.worker import Work, background_scorers
from leaderboard.store import Store, unknown_submission
from leaderboard.store.log import Head
from leaderboard.web import server
from leaderboard.web.client import public_view
from leaderboard.web.pages import Pages, Section, content_type
from leaderboard.web.server import HTTP_CODES, RequestError
from sme_registry.errors import SMEError
from sme_registry.io import server_address

_Board: type[Store] = Store
if find_spec("leaderboard.seasons") is not None:  # without them, a board has the open track only
    from leaderboard.seasons.store import SeasonStore
    from leaderboard.seasons.web import SeasonRoutes

    _Board = SeasonStore

_Render = Callable[[Pages, str], bytes]
_PAGES_KEPT = 256
_HEALTH_SECONDS = 5.0
_LOG_ENTRIES = 100
_OBJECTS = 8  # uploads and downloads in memory at the same time


def create_app(
    path: str | os.PathLike[str],
    url: str,
    *,
    score_workers: int = 0,
    isolation: Isolation = "bwrap",
    season_secrets: Iterable[str | os.PathLike[str]] = (),
) -> FastAPI:
    """The ASGI application of the board in a folder.

    Its pages show `url`, and whatever is sent must be signed for it: it is never taken from a
    request, whose Host header anyone can choose. `score_workers` processes score as long as it
    runs. `isolation` is that of policies: "process" if nobody else can submit. `season_secrets` are
    the masters of the online seasons that it steps.
    """
    _refuse_missing(isolation)
    store = _Board.open(os.fspath(path))
    address = server_address(url, insecure=True).url
    tracks = [SeasonRoutes(store, season_secrets, address)] if _Board is not Store else []
    pages = _PageCache(store, address, [track.section for track in tracks])
    routes = _Routes(store, pages, isolation, address)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        with store, contextlib.ExitStack() as stack:
            store.note_clock()
            job = next((track.job for track in tracks), None)
            work = Work(job=job, isolation=isolation, board=_Board)
            stack.enter_context(background_scorers(store.folder.path, score_workers, work))
            for track in tracks:
                stack.enter_context(track.open())
            yield

    app = FastAPI(
        title=store.document.title,
        lifespan=lifespan,
        docs_url=None,  # its pages load scripts from other servers
        redoc_url=None,
        openapi_url=None,
        exception_handlers={
            Rejection: server.on_rejection,
            RequestError: server.on_rejection,
            HTTPException: server.on_http_error,
            SMEError: server.on_board_error,
        },
    )
    app.add_middleware(server.SecurityHeaders)
    for track in tracks:
        app.router.routes.extend(track.routes)
    app.add_api_route("/healthz", routes.health)
    app.add_api_route("/api/objects/{digits}", routes.put_object, methods=["PUT"])
    app.add_api_route("/api/objects/{digits}", routes.get_object, methods=["GET", "HEAD"])
    app.add_api_route("/api/submissions", routes.post_submission, methods=["POST"])
    app.add_api_route("/api/submissions/{digits}", routes.get_submission)
    app.add_api_route("/api/withdrawals", routes.post_withdrawal, methods=["POST"])
    app.add_api_route("/api/board", routes.get_board)
    app.add_api_route("/api/log", routes.get_log)
    app.add_api_route("/{name:path}", routes.get_page, methods=["GET", "HEAD"])
    return app


def _refuse_missing(isolation: Isolation) -> None:
    advice = "Only if nobody else can submit to this board, serve it with --unsafe-no-sandbox."
    try:
        missing = isolation == "bwrap" and available_isolation() != "bwrap"
    except ScoringFault as error:
        raise BoardError(f"{error} {advice}") from None
    if missing:
        raise BoardError(
            "bubblewrap is not installed, without which submitted policies could read your files "
            f"and use your network. Install it: apt install bubblewrap. {advice}"
        )


class _Routes:
    """The handlers of the routes. Calls that may block run in threads.

    One thread checks submissions, because checking is bound by Python, and so no two submissions
    can share the last free place of a quota; neither can two uploads.
    """

    def __init__(self, store: Store, pages: _PageCache, isolation: Isolation, address: str) -> None:
        self._store, self._isolation, self._address = store, isolation, address
        self._documents = CapacityLimiter(1)
        self._admissions = CapacityLimiter(1)
        self._objects = CapacityLimiter(_OBJECTS)
        self._uploads = CapacityLimiter(1)
        self._rendering = CapacityLimiter(1)
        self._health = CapacityLimiter(1)
        self._pages = pages

    async def health(self) -> Response:
        scoring = "fault"  # also if the board cannot be read in time
        with anyio.move_on_after(_HEALTH_SECONDS):
            scoring = await to_thread.run_sync(
                self._scoring, limiter=self._health, abandon_on_cancel=True
            )
        return JSONResponse({"status": "ok", "scoring": scoring})

    def _scoring(self) -> str:
        """Whether scoring works: "ok", "waiting" for its turn, or "fault"."""
        queue = self._store.queue
        try:
            faulty = queue.count("faults") or not self._store.time  # which the clock may not allow
            return "fault" if faulty else "waiting" if queue.count("waiting") else "ok"
        except SMEError:
            return "fault"

    async def put_object(self, request: Request, digits: str) -> Response:
        digest = _digest(digits)
        header = request.headers.get("Authorization")
        key = admission.uploader(self._store.document, header, digest, self._address)

        def put(data: bytes) -> bool:
            admission.check_upload(self._store, key, len(data))
            return self._store.put_object(digest, data, by=key)

        async with self._objects:
            limit = self._store.document.limits.artefact_bytes
            data = await server.read_body(request, limit, "object")
            new = await to_thread.run_sync(put, data, limiter=self._uploads)
        return JSONResponse({"digest": digest}, 201 if new else 200)

    async def get_object(self, digits: str) -> Response:
        digest = _digest(digits)

        def read() -> bytes:
            if not (self._store.is_public(digest) and self._store.objects.has(digest)):
                raise RequestError("not_found", f"object={digest}: {HTTP_CODES['not_found']}.")
            return self._store.objects.read(digest)

        headers = {
            "Cache-Control": "public, max-age=31536000, immutable",
            "Content-Disposition": f'attachment; filename="{digits}.onnx"',
        }
        data = await to_thread.run_sync(read, limiter=self._objects)
        return Response(data, headers=headers, media_type="application/octet-stream")

    async def post_submission(self, request: Request) -> Response:
        text = await server.read_body(request, MAX_BYTES, "submission")

        # Garbage without a valid signature never waits with submissions, whose check is longer.
        signed = await to_thread.run_sync(Signed[Submission].read, text, limiter=self._documents)

        def admit() -> bool:
            return admission.admit(
                self._store, signed, isolation=self._isolation, address=self._address
            )

        new = await to_thread.run_sync(admit, limiter=self._admissions)
        id = signed.id
        url = f"/api/submissions/{hex_of(id)}"
        return JSONResponse({"id": id, "url": url}, 202 if new else 200, headers={"Location": url})

    async def get_submission(self, request: Request, digits: str) -> Response:
        return await self._cached(request, _view, _digest(digits), "application/json")

    async def post_withdrawal(self, request: Request) -> Response:
        text = await server.read_body(request, MAX_BYTES, "withdrawal")

        def withdraw() -> str:
            signed = Signed[Withdrawal].read_unverified(text)
            admission.withdraw(self._store, signed, self._address)
            return signed.content.submission

        id = await to_thread.run_sync(withdraw, limiter=self._documents)
        return JSONResponse({"id": id, "status": "withdrawn"})

    async def get_board(self, request: Request) -> Response:
        name = f"{RANKED[server.metric_of(request)].stem}.json"
        return await self._cached(request, _page, name, "application/json")

    async def get_log(self, request: Request) -> Response:
        text = request.query_params.get("start", "0")
        if not re.fullmatch(r"\d{1,8}", text, re.ASCII):
            raise RequestError("bad_request", f"start={text!r:.80}: must be in [0, 99999999].")
        return await self._cached(request, _log_part, text, "application/json")

    async def get_page(self, request: Request, name: str) -> Response:
        name = name or "index"
        name = name if "." in name else f"{name}.html"
        try:
            media_type = content_type(name)
        except KeyError:
            raise _not_found() from None
        return await self._cached(request, _page, name, media_type)

    async def _cached(
        self, request: Request, render: _Render, name: str, media_type: str
    ) -> Response:
        """A file, rendered once for each state of the board; 304 if the client has it."""
        get = self._pages.get
        content, tag = await to_thread.run_sync(get, render, name, limiter=self._rendering)
        headers = {"ETag": tag, "Cache-Control": "no-cache"}
        known = request.headers.get("If-None-Match", "").replace("W/", "")
        if tag in (tag.strip() for tag in known.split(",")):
            return Response(status_code=304, headers=headers)
        return Response(content, headers=headers, media_type=media_type)


class _PageCache:
    """Rendered files, discarded when the log grows, the queue changes or a scoring fails.

    One thread uses it at a time: rendering is bound by Python, and clients that ask at once for a
    page that is not cached wait for one rendering of it.
    """

    def __init__(self, store: Store, url: str, sections: Sequence[Section]) -> None:
        self._store, self._sections = store, sections
        # A copy without its key accepts no submissions.
        self._address = url if store.folder.key.is_file() else None
        self._state: tuple[Head, int, dict[str, int]] | None = None

    def get(self, render: _Render, name: str) -> tuple[bytes, str]:
        """A file and its tag."""
        queue = self._store.queue
        state = self._store.head, queue.count("faults"), queue.places()
        if state != self._state:
            self._state = state
            pages = Pages(self._store, self._address, sections=self._sections)
            self._rendered = functools.lru_cache(_PAGES_KEPT)(functools.partial(_rendered, pages))
        return self._rendered(render, name)


def _rendered(pages: Pages, render: _Render, name: str) -> tuple[bytes, str]:
    content = render(pages, name)
    return content, f'"{hashlib.sha256(content).hexdigest()[:32]}"'


def _view(pages: Pages, id: str) -> bytes:
    entry = pages.store.entry(id)
    if entry is None:
        raise unknown_submission(id)
    return _json(public_view(pages.store, entry).to_dict())


def _log_part(pages: Pages, start: str) -> bytes:
    first = int(start)
    entries = pages.store.log(first, _LOG_ENTRIES)
    more = len(entries) == _LOG_ENTRIES
    return _json(
        {
            "entries": [entry.to_dict() for entry in entries],
            "next": first + len(entries) if more else None,
        }
    )


def _json(content: Any) -> bytes:
    return bytes(JSONResponse(content).body)


def _page(pages: Pages, name: str) -> bytes:
    content = pages.read(name)
    if content is None:
        raise _not_found()
    return content


def _not_found() -> RequestError:
    return RequestError("not_found", f"{HTTP_CODES['not_found']}.")


def _digest(digits: str) -> str:
    if not re.fullmatch(r"[0-9a-f]{64}", digits):
        raise Rejection(
            "unsafe_name",
            f"path={digits!r:.90}: must be 64 lower-case hex digits. Give the digest without "
            "'sha256:'.",
        )
    return f"sha256:{digits}"
