"""Error answers: codes, HTTP statuses, and the page that a browser gets."""

from __future__ import annotations

import html
from typing import Any

from fastapi import Request
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

from leaderboard.errors import NotPublishable, Rejection

HTTP_CODES = {
    "not_found": "nothing exists at this address",
    "method_not_allowed": "this address does not accept this method",
    "broken_off": "the connection closed before the whole body arrived",
    "too_slow": "the body did not arrive in time",
    "not_publishable": "a reference row is missing, waiting or off",
    "bad_request": "the request is invalid",
    "season_not_served": "this server does not have the season's secret, and cannot step its tasks",
    "busy": "the server has as many such requests as it can take; try again in a few seconds",
    "internal": "the server failed; its log has the details",
}

STATUSES = {
    "not_json": 400,
    "unsafe_name": 400,
    "bad_signature": 403,
    "wrong_board": 403,
    "stale_time": 403,
    "token_wrong": 403,
    "unknown_submission": 404,
    "season_unknown": 404,
    "ticket_unknown": 404,
    "instance_unknown": 404,
    "not_found": 404,
    "method_not_allowed": 405,
    "too_slow": 408,
    "start_conflict": 409,
    "step_conflict": 409,
    "step_ahead": 409,
    "budget_spent": 409,
    "instance_phase": 409,
    "answer_conflict": 409,
    "withdrawn": 410,
    "ticket_ended": 410,
    "too_large": 413,
    "quota": 429,
    "ticket_limit": 429,
    "internal": 500,
    "busy": 503,
    "season_not_served": 503,
    "not_publishable": 503,
    "storage_full": 507,
}
"""Any other code of a `Rejection` is 422, any other code is 400."""


class RequestError(Exception):
    """A request that fails for a reason in `HTTP_CODES`."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message


async def on_rejection(request: Request, error: Exception) -> Response:
    """The answer to a `Rejection` or a `RequestError`."""
    assert isinstance(error, Rejection | RequestError)
    return error_answer(request, error.code, error.message)


async def on_http_error(request: Request, error: Exception) -> Response:
    """The answer to an error that Starlette raises."""
    assert isinstance(error, HTTPException)
    code = {404: "not_found", 405: "method_not_allowed"}.get(error.status_code, "bad_request")
    return error_answer(request, code, f"{HTTP_CODES[code]}.", headers=error.headers)


async def on_board_error(request: Request, error: Exception) -> Response:
    """The answer where the board publishes nothing; `Guard` logs every other fault and hides it."""
    if not isinstance(error, NotPublishable):
        raise error
    waits = error.waiting and request.app.state.scores
    headers = {"Retry-After": str(_RETRY_SECONDS)} if waits else None
    return error_answer(request, "not_publishable", str(error), headers)


def error_answer(request: Request, code: str, message: str, headers: Any = None) -> Response:
    """An error as JSON, or as a page if a browser asks for one."""
    status = STATUSES.get(code, 400 if code in HTTP_CODES else 422)
    message = message[:_MESSAGE_CHARACTERS]
    if code == "busy":
        headers = {**(headers or {}), "Retry-After": str(_RETRY_SECONDS)}
    if _wants_page(request):
        page = _ERROR_PAGE.format(
            status=status,
            code=html.escape(code),
            message=html.escape(message),
            root=_root(request),
        )
        return Response(page, status, headers=headers, media_type="text/html")
    return JSONResponse({"code": code, "message": message}, status, headers=headers)


def _wants_page(request: Request) -> bool:
    is_api = request.url.path.startswith("/api/")
    return not is_api and "text/html" in request.headers.get("Accept", "")


def _root(request: Request) -> str:
    """The relative address of the board from the page that was asked for."""
    return "../" * (request.url.path.count("/") - 1) or "./"


_RETRY_SECONDS = 5
_MESSAGE_CHARACTERS = 2000

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
