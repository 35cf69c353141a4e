"""What all routes share, and a folder of pages instead of a server.

Clients that are silent, slow or too many are the business of the reverse proxy in front of it,
whose configuration is examples/deploy/nginx.conf: it passes on complete requests only. So this
server listens on this machine alone, unless it is told that a proxy is in front.
"""

from __future__ import annotations

import contextlib
import html
import ipaddress
import logging
import re
import signal
import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import uvicorn
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from leaderboard.documents.board import Folder
from leaderboard.documents.result import RANKED, Metric
from leaderboard.errors import BoardError, ClockError, NotPublishable, Rejection
from leaderboard.store import Store
from leaderboard.store.log import write_file
from leaderboard.web.pages import Pages, Section
from sme_registry.errors import OptionError

HTTP_CODES = {
    "not_found": "nothing exists at this address",
    "method_not_allowed": "this address does not accept this method",
    "not_publishable": "a reference row is missing, waiting or off",
    "bad_request": "the request is invalid",
    "season_not_served": "this server does not have the season's secret, and cannot step its tasks",
    "clock_wrong": "the server's clock is wrong, and nothing is written until it is set",
    "internal": "the server failed; its log has the details",
}

STATUSES = {
    code: status
    for status, codes in {
        400: "not_json unsafe_name",
        403: "bad_signature wrong_board stale_time token_wrong not_admitted",
        404: "unknown_submission season_unknown ticket_unknown instance_unknown not_found",
        405: "method_not_allowed",
        409: "start_conflict step_conflict step_ahead budget_spent instance_phase answer_conflict",
        410: "withdrawn ticket_ended",
        413: "too_large",
        429: "quota ticket_limit",
        500: "internal",
        503: "season_not_served clock_wrong not_publishable",
        507: "storage_full",
    }.items()
    for code in codes.split()
}
"""Any other code of a `Rejection` is 422, any other code is 400."""

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
_ENCODED = re.compile(rb"%(2f|5c|00)|\\", re.IGNORECASE)
_log = logging.getLogger(__name__)


class RequestError(Exception):
    """A request that fails for a reason in `HTTP_CODES`."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message


async def read_body(request: Request, limit: int, name: str) -> bytes:
    """A whole body; one of more than `limit` bytes is `too_large`, and no more of it is kept."""
    too_large = Rejection(
        "too_large", f"{name}: must be at most {limit:,} bytes. Send a smaller one."
    )
    if int(request.headers.get("Content-Length", 0)) > limit:  # the HTTP parser admits digits only
        raise too_large
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > limit:
            raise too_large
    return bytes(body)


class SecurityHeaders:
    """ASGI middleware: security headers; refuses unsafe paths, logs internal faults, hides them."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = False

        async def send_with_headers(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                headers = MutableHeaders(scope=message)
                headers.update(_HEADERS)
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        request = Request(scope)
        if not _is_safe(scope):
            answer = error_answer(
                request,
                "unsafe_name",
                "path: '..', encoded slashes and backslashes are not allowed. Correct the address.",
            )
            await answer(scope, receive, send_with_headers)
            return
        try:
            await self._app(scope, receive, send_with_headers)
        except ClientDisconnect:  # nobody is left to answer
            return
        except Exception:
            _log.exception("%s %s failed", scope["method"], scope["path"])
            if started:
                raise
            answer = error_answer(request, "internal", f"{HTTP_CODES['internal']}.")
            await answer(scope, receive, send_with_headers)


def _is_safe(scope: Scope) -> bool:
    raw, path = scope.get("raw_path") or b"", scope["path"]
    return (
        not _ENCODED.search(raw) and not {".", ".."} & set(path.split("/")) and path.isprintable()
    )


async def on_rejection(request: Request, error: Exception) -> Response:
    assert isinstance(error, Rejection | RequestError)
    return error_answer(request, error.code, error.message)


async def on_http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = {404: "not_found", 405: "method_not_allowed"}.get(error.status_code, "bad_request")
    return error_answer(request, code, f"{HTTP_CODES[code]}.", headers=error.headers)


async def on_board_error(request: Request, error: Exception) -> Response:
    """The answer where the board publishes nothing; every other fault is logged and hidden."""
    if isinstance(error, ClockError):
        _log.error("%s", error)
        return error_answer(request, "clock_wrong", f"{HTTP_CODES['clock_wrong']}.")
    if not isinstance(error, NotPublishable):
        raise error
    return error_answer(request, "not_publishable", str(error))


def error_answer(request: Request, code: str, message: str, headers: Any = None) -> Response:
    """An error as JSON, or as a page if a browser asks for one."""
    status = STATUSES.get(code, 400 if code in HTTP_CODES else 422)
    is_api = request.url.path.startswith("/api/")
    if is_api or "text/html" not in request.headers.get("Accept", ""):
        return JSONResponse({"code": code, "message": message}, status, headers=headers)
    page = _ERROR_PAGE.format(
        status=status,
        code=html.escape(code),
        message=html.escape(message),
        root="../" * (request.url.path.count("/") - 1) or "./",
    )
    return Response(page, status, headers=headers, media_type="text/html")


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
<p><a href="{root}">Back to the board</a></p>
</main>
</body>
</html>
"""


def metric_of(request: Request) -> Metric:
    """The metric that a request ranks by; WD regret by default."""
    text = request.query_params.get("metric", "wd_regret")
    for metric in RANKED:
        if metric == text:
            return metric
    raise RequestError("bad_request", f"metric={text!r:.80}: must be one of {', '.join(RANKED)}.")


_CONNECTIONS = 800  # and so fewer open files than the 1,024 that systems usually allow
_HEAD_BYTES = 2**14


def config_of(app: ASGIApp) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        loop="asyncio",
        http="h11",  # always the same parser, whatever else is installed
        ws="none",
        h11_max_incomplete_event_size=_HEAD_BYTES,
        limit_concurrency=_CONNECTIONS,
        log_config=None,  # as all other logs
        log_level="error",  # a client's faults are not the server's
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=5,
    )


def run(app: ASGIApp, listener: socket.socket) -> None:
    """Serve until Ctrl-C or SIGTERM, which both end it cleanly; in the main thread."""
    # Uvicorn shuts down on both signals, then raises the one it received.
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            uvicorn.Server(config_of(app)).run(sockets=[listener])
    finally:
        signal.signal(signal.SIGTERM, previous)


def is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BoardError(
            f"host={host!r}, port={port}: cannot listen here: {reason}. Use another --port."
        ) from None
    # Asyncio does not, where it is given a socket: head and body of an answer were 40 ms apart.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def url_of(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def write_site(
    store: Store,
    out: str | Path,
    progress: Callable[[int, int], None] | None = None,
    *,
    explorers: bool = False,
    sections: Sequence[Section] = (),
) -> Path:
    """Write the board's pages into a folder, and return the path of `index.html`.

    The same board gives the same bytes. Unchanged files and other files are left alone. Explorers,
    of each run of each scored submission, have 60 kB or more and take a second each.
    """
    out = Path(out)
    _refuse_board(out)
    pages = Pages(store, explorers=explorers, sections=sections)
    paths = list(pages.paths())
    for done, path in enumerate(paths, start=1):
        content, target = pages.read(path), out / path
        assert content is not None, path
        if not (target.is_file() and target.read_bytes() == content):
            write_file(target, content)
        if progress is not None:
            progress(done, len(paths))
    return out / "index.html"


def _refuse_board(out: Path) -> None:
    """Refuse a folder in which pages would replace a board's files. A site has a board.json too."""
    target = out.resolve()
    for above in (target, *target.parents):
        board = Folder(above)
        if not (board.key.exists() or (board.board.is_file() and board.log.is_dir())):
            continue
        folders = ("log", "objects", "seasons", "submissions", "withdrawals", "results")
        own = [(above / each).resolve() for each in folders]
        if target == above or any(map(target.is_relative_to, own)):
            raise OptionError(
                f"out={str(out)!r}: belongs to the board {above}, whose files the pages would "
                f"replace. Give another folder, such as {above / 'site'}."
            )
