"""Limits on what a client sends: the size and time of a body, and its room in the quotas."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import AsyncIterator

import anyio
from anyio import CapacityLimiter, to_thread
from fastapi import Request
from starlette.requests import ClientDisconnect

from leaderboard import intake
from leaderboard.documents.submission import MAX_BYTES
from leaderboard.errors import Rejection
from leaderboard.store import Store
from leaderboard.web.errors import HTTP_CODES, RequestError

UPLOAD_SECONDS = 300.0
_DOCUMENT_SECONDS = 30.0


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
    """Read a body as it arrives, up to a size and a time.

    Raises:
      Rejection: `too_large`.
      RequestError: `too_slow` or `broken_off`.
    """
    size = 0
    deadline = anyio.current_time() + seconds
    stream = request.stream()
    while True:
        try:
            with anyio.fail_after(deadline - anyio.current_time()):
                chunk = await anext(stream, b"")
        except TimeoutError:
            raise RequestError(
                "too_slow", f"{name}: did not arrive within {seconds:g} seconds. Send it again."
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


async def drain(request: Request, limit: int, seconds: float) -> None:
    """Let a client finish its body: one that is cut off while it sends may never read why."""
    with contextlib.suppress(Rejection, RequestError, RuntimeError):  # already read to its end
        async for _ in body_chunks(request, limit, seconds):
            pass
