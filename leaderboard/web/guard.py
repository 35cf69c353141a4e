"""`Guard`: security headers, answers in pieces, unsafe paths rejected, internal faults hidden."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator

from fastapi import Request
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from leaderboard.web.downloads import PIECE
from leaderboard.web.errors import HTTP_CODES, error_answer

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


class Guard:
    """ASGI middleware around a whole application."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
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
            for piece in _pieces(message):
                await send(piece)

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
        except Exception:
            _log.exception("%s %s failed", scope["method"], scope["path"])
            if started:
                raise
            answer = error_answer(request, "internal", f"{HTTP_CODES['internal']}.")
            await answer(scope, receive, send_with_headers)


def _pieces(message: Message) -> Iterator[Message]:
    """A message of an answer in pieces: the server copies only what the client is about to read."""
    body = message.get("body", b"")
    while len(body) > PIECE:
        yield {**message, "body": bytes(body[:PIECE]), "more_body": True}
        body = memoryview(body)[PIECE:]
    yield {**message, "body": bytes(body)} if body else message


def _is_safe(scope: Scope) -> bool:
    raw, path = scope.get("raw_path") or b"", scope["path"]
    return (
        not _ENCODED.search(raw) and not {".", ".."} & set(path.split("/")) and path.isprintable()
    )
