"""Limits on what clients send: size and time of a body, quotas, requests at the same time."""

from __future__ import annotations

import contextlib
import ipaddress
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable
from typing import TypeVar

import anyio
from anyio import CapacityLimiter, to_thread
from fastapi import Request
from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from leaderboard import intake
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES, MAX_BYTES
from leaderboard.errors import Rejection
from leaderboard.store import Store
from leaderboard.web.errors import HTTP_CODES, RequestError, error_answer

REQUESTS_OF_ADDRESS = 32
UPLOAD_SECONDS = 300.0
_DOCUMENT_SECONDS = 30.0
LEAST_RATE = 2**15  # bytes a second
_START_SECONDS = 30.0  # before which a body may be slower
_LINGER_SECONDS, _SILENCE_SECONDS = 30.0, 1.0

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
_T = TypeVar("_T")


LOOPBACK: tuple[Network, ...] = (
    ipaddress.ip_network("127.0.0.0/8"),
    ipaddress.ip_network("::1/128"),
)


def counted_address(host: str, uncounted: Iterable[Network] = LOOPBACK) -> str:
    """The address by which a client is counted; empty if it is not counted.

    An IPv6 address counts with its /64 network, which is what one client is usually given.
    """
    try:
        address = ipaddress.ip_address(host)
    except ValueError:  # a Unix socket
        return ""
    if isinstance(address, ipaddress.IPv6Address):
        address = address.ipv4_mapped or address
    if any(address in network for network in uncounted):
        return ""
    if isinstance(address, ipaddress.IPv6Address):
        return str(ipaddress.ip_network((address, 64), strict=False))
    return str(address)


class RequestsByAddress:
    """ASGI middleware: at most `limit` requests of one address are in progress; `busy` for more."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app = app
        self._limit = limit
        self._running: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        address = counted_address((scope.get("client") or ("",))[0])
        if scope["type"] != "http" or not address:
            await self._app(scope, receive, send)
            return
        if self._running[address] >= self._limit:
            answer = error_answer(
                Request(scope),
                "busy",
                f"address={address}: has {self._limit} requests in progress. Wait for some.",
            )
            await answer(scope, receive, send)
            return
        self._running[address] += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._running -= Counter({address: 1})  # drops an address without requests


class RefusedBodies:
    """ASGI middleware: a client whose request is refused can finish sending its body.

    Cut off while it sends, it may never read why. The answer goes out at once, and ends when the
    body has been read; nothing is kept of it. Who falls silent for a second, takes longer than 30
    or sends more than an artefact's bytes is cut off.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http" or scope["method"] in ("GET", "HEAD"):
            await self._app(scope, receive, send)
            return
        more_body, refused, cut_short = True, False, False

        async def receive_some() -> Message:
            nonlocal more_body
            message = await receive()
            more_body = message.get("more_body", False)
            return message

        async def send_some(message: Message) -> None:
            nonlocal refused, cut_short
            if message["type"] == "http.response.start":
                refused = message["status"] >= 400
                if refused:
                    MutableHeaders(scope=message)["Connection"] = "close"
            elif refused and more_body and not message.get("more_body"):
                cut_short = True
                message = {**message, "more_body": True}
            await send(message)

        await self._app(scope, receive_some, send_some)
        if cut_short:
            size = 0
            with anyio.move_on_after(_LINGER_SECONDS):
                while more_body and size <= MAX_ARTEFACT_BYTES:
                    with anyio.move_on_after(_SILENCE_SECONDS) as waiting:
                        size += len((await receive_some()).get("body", b""))
                    if waiting.cancelled_caught:
                        break
            await send({"type": "http.response.body"})


class Turns:
    """Work on requests in a thread, one at a time; at most `places` of them wait or run.

    Each waits for those before it only, so whoever sends many of them fills the places of others at
    worst for moments, and never the threads that serve pages.
    """

    def __init__(self, places: int) -> None:
        self._places = places
        self._thread = CapacityLimiter(1)
        self._taken: Counter[str] = Counter()

    async def run(self, work: Callable[[], _T], owner: str = "") -> _T:
        """The value of `work()`.

        Args:
          work: called in the thread.
          owner: has one place at a time; empty for no such limit.

        Raises:
          RequestError: `busy`, if there is no place.
        """
        if self._taken.total() >= self._places or (owner and self._taken[owner]):
            raise RequestError("busy", f"{HTTP_CODES['busy']}.")
        self._taken[owner] += 1
        try:
            return await to_thread.run_sync(work, limiter=self._thread)
        finally:
            self._taken -= Counter({owner: 1})


class UploadReservations:
    """Room in the quotas for uploads in progress; two at once cannot use the same room."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._checking = CapacityLimiter(1)
        self._reserved: Counter[str] = Counter()

    @contextlib.asynccontextmanager
    async def reserve(self, key: str, size: int) -> AsyncIterator[None]:
        """Reserve `size` bytes for a key while the block runs.

        Raises:
          Rejection: `too_large` or `quota`.
        """
        async with self._checking:
            await to_thread.run_sync(
                lambda: intake.check_upload(
                    self._store,
                    key,
                    size,
                    pending=self._reserved.total(),
                    pending_of_key=self._reserved[key],
                )
            )
            self._reserved[key] += size
        try:
            yield
        finally:
            self._reserved -= Counter({key: size})  # drops a key without uploads


async def read_document(request: Request, name: str) -> bytes:
    """Read a whole small body.

    Raises:
      Rejection: `too_large`.
      RequestError: `too_slow` or `broken_off`.
    """
    text = bytearray()
    async for chunk in body_chunks(request, MAX_BYTES, _DOCUMENT_SECONDS, name):
        text += chunk
    return bytes(text)


async def body_chunks(
    request: Request, limit: int, seconds: float, name: str = "object"
) -> AsyncIterator[bytes]:
    """Read a body as it arrives, up to a size and a time, and not slower than 32 KiB a second.

    Raises:
      Rejection: `too_large`.
      RequestError: `too_slow` or `broken_off`.
    """
    size = 0
    start = anyio.current_time()
    stream = request.stream()
    while True:
        # A body that hardly moves holds room in the quotas no longer than it must.
        allowed = min(seconds, _START_SECONDS + size / LEAST_RATE)
        try:
            with anyio.fail_after(start + allowed - anyio.current_time()):
                chunk = await anext(stream, b"")
        except TimeoutError:
            raise RequestError(
                "too_slow",
                f"{name}: {size:,} bytes arrived within {allowed:.0f} seconds, and the rest did "
                "not. Send it again.",
            ) from None
        except ClientDisconnect:
            raise RequestError("broken_off", f"{name}: {HTTP_CODES['broken_off']}.") from None
        if not chunk:
            return
        size += len(chunk)
        if size > limit:
            raise Rejection(
                "too_large", f"{name}: must be at most {limit:,} bytes. Send a smaller one."
            )
        yield chunk
