"""The board over HTTP: the pages of `site`, and a small API.

    GET  /…                        the pages, at the paths that `site` writes them to
    PUT  /api/objects/<hex>        an artefact, streamed; signed for, see `intake`
    GET  /api/objects/<hex>        its bytes, so that anyone can recompute; HEAD: is it there?
    POST /api/submissions          202 taken, 200 known already
    GET  /api/submissions/<hex>    status and result, whose scores the reference rows may withhold
    POST /api/withdrawals          200
    GET  /api/board?metric=wd_regret  the ranking
    GET  /api/log?start=0          a hundred entries of the signed log
    GET  /healthz                  whether the server lives

A refusal is {"code", "message"}: the code of a `Rejection`, or of `HTTP_CODES`. The server holds
no session and sets no cookie; everything that changes something is signed.
"""

from __future__ import annotations

import contextlib
import hashlib
import html
import logging
import multiprocessing
import os
import re
import signal
import socket
import tempfile
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeVar, get_args

import anyio
from anyio import CapacityLimiter, to_thread

from leaderboard import exports, intake
from leaderboard.documents.board import hex_of
from leaderboard.documents.submission import MAX_BYTES, SignedSubmission
from leaderboard.errors import BoardError, NotPublishable, Rejection
from leaderboard.public_view import public_view
from leaderboard.scoring import ranking
from leaderboard.scoring.worker import run_scorers
from leaderboard.store import Store
from leaderboard.web.site import Pages, content_type
from sme_registry.errors import MissingDependencyError, SMEError
from sme_registry.terminal.interrupts import block_interrupts, unblock_interrupts

try:
    from fastapi import FastAPI, Request
    from starlette.datastructures import MutableHeaders
    from starlette.exceptions import HTTPException
    from starlette.requests import ClientDisconnect
    from starlette.responses import JSONResponse, Response
    from starlette.types import ASGIApp, Message, Receive, Scope, Send
except ImportError:
    raise MissingDependencyError(
        "fastapi: not installed, and needed to serve a board. "
        "Run `pip install 'sme-registry[leaderboard]'`."
    ) from None

HTTP_CODES = {
    "not_found": "nothing is at this address",
    "method_not_allowed": "this address takes another method",
    "broken_off": "the request ended before its body did",
    "too_slow": "the body did not come within the time",
    "not_publishable": "a reference row is missing, waiting or off",
    "bad_request": "the request is none that the server understands",
    "internal": "the server failed; the fault is in its log",
}

_STATUS = {
    "not_json": 400,
    "unsafe_name": 400,
    "bad_signature": 403,
    "stale_time": 403,
    "unknown_submission": 404,
    "not_found": 404,
    "method_not_allowed": 405,
    "too_slow": 408,
    "withdrawn": 410,
    "too_large": 413,
    "quota": 429,
    "internal": 500,
    "not_publishable": 503,
}  # of any other Rejection 422, of any other code 400

_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}

METRICS: tuple[ranking.Metric, ...] = get_args(ranking.Metric)
UPLOAD_SECONDS = 300.0
_DOCUMENT_SECONDS = 30.0
_PIECE = 2**18  # bytes written or read at once
_PAGES_KEPT = 256
_LOG_ENTRIES = 100
_CONNECTIONS = 1000
_HEX = re.compile(r"[0-9a-f]{64}")
_ENCODED = re.compile(rb"%(2f|5c|00)|\\", re.IGNORECASE)

_log = logging.getLogger("leaderboard.web.app")
_T = TypeVar("_T")


class Refusal(Exception):
    """An answer other than what was asked for: a code, a message, and a status."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message


def create_app(
    path: str | os.PathLike[str],
    *,
    score_workers: int = 0,
    upload_seconds: float = UPLOAD_SECONDS,
    pages_kept: int = _PAGES_KEPT,
) -> FastAPI:
    """The ASGI application of a board.

    Args:
      path: the board's folder.
      score_workers: scorer processes that run as long as the application does.
      upload_seconds: the longest that an upload may take.
      pages_kept: rendered pages to keep until the log grows; 0 renders each anew.

    Raises:
      BoardError: the folder holds no board.
      MissingDependencyError: FastAPI is not installed.
    """
    store = Store.open(os.fspath(path))
    served = _Served(store, upload_seconds, pages_kept)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        with _scorers(os.fspath(path), score_workers), store:
            yield

    app = FastAPI(
        title=store.document.title,
        lifespan=lifespan,
        docs_url=None,  # its pages load scripts from elsewhere
        redoc_url=None,
        openapi_url=None,
        exception_handlers={
            Rejection: _refused,
            Refusal: _refused,
            HTTPException: _http_error,
            SMEError: _failed,
        },
    )
    app.add_middleware(_Guard)
    app.add_api_route("/healthz", served.health)
    app.add_api_route("/api/objects/{digits}", served.put_object, methods=["PUT"])
    app.add_api_route("/api/objects/{digits}", served.get_object, methods=["GET", "HEAD"])
    app.add_api_route("/api/submissions", served.post_submission, methods=["POST"])
    app.add_api_route("/api/submissions/{digits}", served.get_submission)
    app.add_api_route("/api/withdrawals", served.post_withdrawal, methods=["POST"])
    app.add_api_route("/api/board", served.get_board)
    app.add_api_route("/api/log", served.get_log)
    app.add_api_route("/{name:path}", served.get_page, methods=["GET", "HEAD"])
    return app


class _Served:
    """What the routes do. Whatever may block runs in a thread, and none of them waits for a peer.

    An upload in flight is an unnamed file, so that it is gone however it ends, and the quota
    counts it at once. Checking submissions is one thread's work: it is mostly Python, and one
    after the other no two can pass a quota that has room for one.
    """

    def __init__(self, store: Store, upload_seconds: float, pages_kept: int) -> None:
        self._store = store
        self._upload_seconds = upload_seconds
        self._admissions = CapacityLimiter(1)
        self._quota = CapacityLimiter(1)
        self._pending: dict[str, int] = {}
        self._rendering = CapacityLimiter(1)
        self._pages = _Cache(store, pages_kept)

    async def health(self) -> Response:
        return JSONResponse({"status": "ok"})

    async def put_object(self, request: Request, digits: str) -> Response:
        digest = _digest(digits)
        limit = self._store.document.limits.artefact_bytes
        size = _declared_length(request, limit)
        try:
            key = intake.uploader(request.headers.get("Authorization"), digest)
            async with self._reserved(key, size):
                with await _in_thread(_unnamed_file, self._store.folder.path) as spool:
                    async for piece in _pieces(request, size, self._upload_seconds):
                        await _in_thread(spool.write, piece)
                    new = await _in_thread(self._keep, spool, digest, key)
        except Rejection:
            if size <= limit:
                await _drain(request, limit, self._upload_seconds)
            raise
        return JSONResponse({"digest": digest}, 201 if new else 200)

    def _keep(self, spool: IO[bytes], digest: str, key: str) -> bool:
        spool.seek(0)  # the store hashes what it takes, and takes nothing of another digest
        return self._store.put_object(digest, iter(lambda: spool.read(_PIECE), b""), by=key)

    @contextlib.asynccontextmanager
    async def _reserved(self, key: str, size: int) -> AsyncIterator[None]:
        """Room for an upload in the quotas; two at once cannot have the same room."""
        async with self._quota:
            await _in_thread(
                lambda: intake.check_upload(
                    self._store,
                    key,
                    size,
                    pending=sum(self._pending.values()),
                    pending_of_key=self._pending.get(key, 0),
                )
            )
            self._pending[key] = self._pending.get(key, 0) + size
        try:
            yield
        finally:
            self._pending[key] -= size
            if not self._pending[key]:
                del self._pending[key]

    async def get_object(self, request: Request, digits: str) -> Response:
        digest = _digest(digits)
        if not await _in_thread(self._store.objects.has, digest):
            raise Refusal("not_found", f"object={digest}: is not on this board.")
        headers = {
            "Cache-Control": "public, max-age=31536000, immutable",
            "Content-Disposition": f'attachment; filename="{digits}.onnx"',
        }
        if request.method == "HEAD":
            return Response(headers=headers, media_type="application/octet-stream")
        data = await _in_thread(self._store.objects.read, digest)
        return Response(data, headers=headers, media_type="application/octet-stream")

    async def post_submission(self, request: Request) -> Response:
        text = await _document(request, "submission")

        def admit() -> tuple[str, bool]:
            signed = SignedSubmission.read(text)
            return signed.id, intake.admit(self._store, signed)

        id, new = await to_thread.run_sync(admit, limiter=self._admissions)
        url = f"/api/submissions/{hex_of(id)}"
        return JSONResponse({"id": id, "url": url}, 202 if new else 200, headers={"Location": url})

    async def get_submission(self, digits: str) -> Response:
        return JSONResponse(await _in_thread(self._submission, _digest(digits)))

    def _submission(self, id: str) -> dict[str, Any]:
        entry = self._store.entry(id)
        if entry is None:
            raise Rejection(
                "unknown_submission", f"submission={id}: is not on this board. Check the id."
            )
        return public_view(self._store, entry).to_dict()

    async def post_withdrawal(self, request: Request) -> Response:
        text = await _document(request, "withdrawal")

        def withdraw() -> str:
            return intake.withdraw(self._store, intake.read_withdrawal(text))

        id = await to_thread.run_sync(withdraw, limiter=self._admissions)
        return JSONResponse({"id": id, "status": "withdrawn"})

    async def get_board(self, request: Request) -> Response:
        given = request.query_params.get("metric", "wd_regret")
        metric = next((name for name in METRICS if name == given), None)
        if metric is None:
            raise Refusal(
                "bad_request", f"metric={given!r:.80}: must be one of {', '.join(METRICS)}."
            )

        def render(pages: Pages) -> bytes:
            rows = ranking.ranking(pages.entries, metric)
            text = exports.to_json(rows, metric, pages.document, pages.store.head[:2])
            return text.encode()

        return await self._rendered(request, f"api/board/{metric}", "application/json", render)

    async def get_log(self, request: Request) -> Response:
        given = request.query_params.get("start", "0")
        if not re.fullmatch(r"\d{1,8}", given, re.ASCII):
            raise Refusal("bad_request", f"start={given!r:.80}: must be in [0, 99999999].")
        start = int(given)
        entries = await _in_thread(self._store.log, start, _LOG_ENTRIES)
        return JSONResponse(
            {
                "entries": [entry.to_dict() for entry in entries],
                "next": start + len(entries) if len(entries) == _LOG_ENTRIES else None,
            }
        )

    async def get_page(self, request: Request, name: str) -> Response:
        if not name:
            name = "index.html"
        elif "." not in name:
            name = f"{name}.html"

        def render(pages: Pages) -> bytes:
            content = pages.read(name)
            if content is None:
                raise Refusal("not_found", f"{HTTP_CODES['not_found']}.")
            return content

        try:
            media_type = content_type(name)
        except KeyError:
            raise Refusal("not_found", f"{HTTP_CODES['not_found']}.") from None
        return await self._rendered(request, name, media_type, render)

    async def _rendered(
        self, request: Request, name: str, media_type: str, render: Callable[[Pages], bytes]
    ) -> Response:
        """What `render` gives, made once for each state of the board; 304 where it is known."""
        file = await to_thread.run_sync(self._pages.get, name, render, limiter=self._rendering)
        headers = {"ETag": file.tag, "Cache-Control": "no-cache"}
        known = request.headers.get("If-None-Match", "").replace("W/", "")
        if file.tag in (tag.strip() for tag in known.split(",")):
            return Response(status_code=304, headers=headers)
        return Response(file.content, headers=headers, media_type=media_type)


@dataclass(frozen=True)
class _File:
    content: bytes
    tag: str


class _Cache:
    """Rendered files of the latest state of the board, told apart by the log's head.

    Used by one thread at a time: rendering is Python's work, and so many who ask at once for
    what is not there wait for one of them.
    """

    def __init__(self, store: Store, kept: int) -> None:
        self._store = store
        self._kept = kept
        self._head: object = None
        self._pages = Pages(store)
        self._files: OrderedDict[str, _File] = OrderedDict()

    def get(self, name: str, render: Callable[[Pages], bytes]) -> _File:
        """The file of this name, rendered if it is not kept."""
        head = self._store.head
        if head != self._head or not self._kept:
            self._head, self._pages = head, Pages(self._store)
            self._files.clear()
        file = self._files.get(name)
        if file is None:
            content = render(self._pages)
            file = _File(content, f'"{hashlib.sha256(content).hexdigest()[:32]}"')
            self._files[name] = file
            if len(self._files) > self._kept:
                self._files.popitem(last=False)
        else:
            self._files.move_to_end(name)
        return file


class _Guard:
    """Headers on every answer, odd paths refused, and no fault of ours told to a stranger."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = False

        async def guarded(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers[name] = value
                headers.setdefault("Cache-Control", "no-store")
                if message["status"] >= 400 and scope["method"] not in ("GET", "HEAD"):
                    headers["Connection"] = "close"  # there may be more of its body on the way
            await send(message)

        request = Request(scope)
        if not _is_plain(scope):
            answer = _answer(
                request,
                "unsafe_name",
                "path: '..', encoded slashes and backslashes are not allowed. Correct the address.",
            )
            await answer(scope, receive, guarded)
            return
        try:
            await self._app(scope, receive, guarded)
        except Exception:
            _log.exception("%s %s failed", scope["method"], scope["path"])
            if started:
                raise
            answer = _answer(request, "internal", f"{HTTP_CODES['internal']}.")
            await answer(scope, receive, guarded)


def _is_plain(scope: Scope) -> bool:
    raw = scope.get("raw_path") or b""
    segments = scope["path"].split("/")
    return (
        not _ENCODED.search(raw) and not {".", ".."} & set(segments) and scope["path"].isprintable()
    )


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, Rejection | Refusal)
    return _answer(request, error.code, error.message)


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = {404: "not_found", 405: "method_not_allowed"}.get(error.status_code, "bad_request")
    return _answer(request, code, f"{HTTP_CODES[code]}.", headers=error.headers)


async def _failed(request: Request, error: Exception) -> Response:
    if isinstance(error, NotPublishable):
        return _answer(request, "not_publishable", str(error))
    raise error  # a broken or full board: `_Guard` logs it, and tells nothing


def _answer(request: Request, code: str, message: str, headers: Any = None) -> Response:
    """A refusal: JSON, or a page where a browser asks for one."""
    status = _STATUS.get(code, 400 if code in HTTP_CODES else 422)
    wants_page = "text/html" in request.headers.get("Accept", "")
    if wants_page and not request.url.path.startswith("/api/"):
        return Response(
            _ERROR_PAGE.format(
                status=status,
                code=html.escape(code),
                message=html.escape(message),
                root="../" * (request.url.path.count("/") - 1) or "./",
            ),
            status,
            headers=headers,
            media_type="text/html",
        )
    return JSONResponse({"code": code, "message": message}, status, headers=headers)


_ERROR_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{status}</title>
<link rel="stylesheet" href="{root}static/board.css">
</head>
<body>
<main id="main" class="frame">
<h1>{status}</h1>
<p><code>{code}</code>: {message}</p>
<p><a href="{root}">To the board</a></p>
</main>
</body>
</html>
"""


def _digest(digits: str) -> str:
    if not _HEX.fullmatch(digits):
        raise Rejection(
            "unsafe_name",
            f"path={digits!r:.90}: must be 64 lower-case hex digits. Give the digest without "
            "'sha256:'.",
        )
    return f"sha256:{digits}"


async def _in_thread(function: Callable[..., _T], *args: Any) -> _T:
    return await to_thread.run_sync(function, *args)


def _unnamed_file(folder: Path) -> IO[bytes]:
    """A file without a name in the board's file system: gone when it is closed, or we die."""
    return tempfile.TemporaryFile(dir=folder)


def _declared_length(request: Request, limit: int) -> int:
    """The body's length as the header says, or the most that it may be."""
    given = request.headers.get("Content-Length")
    if given is None:
        return limit
    return int(given)  # the HTTP parser takes digits only, and holds the body to them


async def _drain(request: Request, limit: int, seconds: float) -> None:
    """Let a client finish its body: one that is cut off while it sends may never read why."""
    with contextlib.suppress(Rejection, Refusal, RuntimeError):  # read to its end already
        async for _ in _pieces(request, limit, seconds):
            pass


async def _document(request: Request, name: str) -> bytes:
    """A small body, whole.

    Raises:
      Rejection: `too_large`.
      Refusal: `too_slow` or `broken_off`.
    """
    text = bytearray()
    async for piece in _pieces(request, MAX_BYTES, _DOCUMENT_SECONDS, name):
        text += piece
    return bytes(text)


async def _pieces(
    request: Request, limit: int, seconds: float, name: str = "object"
) -> AsyncIterator[bytes]:
    """A body as it comes, up to a size and a time.

    Raises:
      Rejection: `too_large`.
      Refusal: `too_slow` or `broken_off`.
    """
    size = 0
    deadline = anyio.current_time() + seconds
    stream = request.stream()
    while True:
        try:
            with anyio.fail_after(deadline - anyio.current_time()):
                piece = await anext(stream, b"")
        except TimeoutError:
            raise Refusal(
                "too_slow", f"{name}: did not come within {seconds:g} seconds. Send it again."
            ) from None
        except ClientDisconnect:
            raise Refusal("broken_off", f"{name}: {HTTP_CODES['broken_off']}.") from None
        if not piece:
            return
        size += len(piece)
        if size > limit:
            raise Rejection(
                "too_large", f"{name}: must be at most {limit:,} bytes. Send a smaller one."
            )
        yield piece


def serve(
    path: str | os.PathLike[str],
    host: str = "127.0.0.1",
    port: int = 8000,
    workers: int = 1,
    announce: Callable[[str], None] = print,
) -> None:
    """Serve a board, with scorers beside it, until Ctrl-C or SIGTERM; both end it cleanly.

    Args:
      path: the board's folder.
      host: where to listen; a server that speaks HTTPS belongs before any but the loopback.
      port: 0 for any that is free.
      workers: scorer processes; 0 for none.
      announce: called with the board's URL once it listens.

    Raises:
      BoardError: the folder holds no board, or nothing can listen there.
      MissingDependencyError: uvicorn is not installed.
    """
    try:
        import uvicorn
    except ImportError:
        raise MissingDependencyError(
            "uvicorn: not installed, and needed to serve a board. "
            "Run `pip install 'sme-registry[leaderboard]'`."
        ) from None
    app = create_app(path, score_workers=workers)
    config = uvicorn.Config(
        app,
        http="h11",
        ws="none",
        log_level="warning",
        server_header=False,
        limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=5,
    )
    with _listening(host, port) as listener:
        announce(_url(listener))
        with _interrupted_by_sigterm(), contextlib.suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listener])


def _listening(host: str, port: int) -> socket.socket:
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(_CONNECTIONS)
        except BaseException:
            listener.close()
            raise
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BoardError(
            f"host={host!r}, port={port}: cannot listen here: {reason}. Give another --port."
        ) from None
    return listener


def _url(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


@contextlib.contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    """SIGTERM is Ctrl-C. Uvicorn sends itself what it caught once it has shut down."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _scorers(path: str, workers: int) -> Iterator[None]:
    """Scorer processes, as long as the block runs, under a process that minds them."""
    if not workers:
        yield
        return
    # Not forked: the server has threads. Not in a thread: Ctrl-C is what ends `run_scorers`.
    process = multiprocessing.get_context("spawn").Process(
        target=_mind_scorers, args=(path, workers), name="scorers"
    )
    with block_interrupts():
        process.start()
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid or 0, signal.SIGTERM)
        process.join(20)
        if process.is_alive():
            process.kill()
            process.join()


def _mind_scorers(path: str, workers: int) -> None:
    def end(*_: object) -> None:
        # A terminal's Ctrl-C reaches this process as well as the server, which passes it on.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    threading.Thread(target=_end_with_parent, name="end with the server", daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        try:
            unblock_interrupts()
            run_scorers(path, workers, until_empty=False)
        except SMEError as error:
            _log.error("no more scoring here: %s", error)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
