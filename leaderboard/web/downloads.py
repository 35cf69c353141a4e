"""Artefacts as answers: verified, then sent from the open file in pieces."""

from __future__ import annotations

import hashlib
import os
from collections.abc import AsyncIterator
from typing import BinaryIO

from anyio import to_thread
from fastapi import Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from leaderboard.documents.board import hex_of
from leaderboard.documents.reading import open_regular
from leaderboard.errors import BoardError, TamperedError
from leaderboard.store import Store
from leaderboard.web.errors import HTTP_CODES, RequestError

PIECE = 2**16  # bytes of an answer that are in memory at a time


class Downloads:
    """The public artefacts of a board.

    A file's digest is computed once, and again only if the file has changed, so that requests for
    large artefacts cost as little as their transfer.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._verified: set[tuple[str, int, int, int]] = set()

    async def answer(self, request: Request, digest: str) -> Response:
        """An artefact, or its size only if the method is HEAD.

        Raises:
          RequestError: `not_found`, also if the artefact exists but is not public.
          TamperedError: the file does not match its digest.
        """
        file = await to_thread.run_sync(self._open, digest)
        headers = {
            "Cache-Control": "public, max-age=31536000, immutable",
            "Content-Disposition": f'attachment; filename="{hex_of(digest)}.onnx"',
            "Content-Length": str(os.fstat(file.fileno()).st_size),
        }
        if request.method == "HEAD":
            file.close()
            return Response(headers=headers, media_type=_FileAnswer.media_type)
        return _FileAnswer(file, headers)

    def _open(self, digest: str) -> BinaryIO:
        if not self._store.is_public(digest):
            raise RequestError("not_found", f"object={digest}: {HTTP_CODES['not_found']}.")
        path = self._store.folder.object(digest)
        try:
            file = open_regular(path)
        except OSError as error:
            raise BoardError(f"{path}: cannot be read: {error.strerror}.") from None
        try:
            status = os.fstat(file.fileno())
            version = digest, status.st_ino, status.st_size, status.st_mtime_ns
            if version not in self._verified:
                if hashlib.file_digest(file, "sha256").hexdigest() != hex_of(digest):
                    where = path.relative_to(self._store.folder.path).as_posix()
                    raise TamperedError(where, "its bytes do not match the digest in its name")
                self._verified.add(version)
                file.seek(0)
        except BaseException:
            file.close()
            raise
        return file


class _FileAnswer(StreamingResponse):
    """An open file, read as fast as the client takes it, and closed however the answer ends."""

    media_type = "application/octet-stream"

    def __init__(self, file: BinaryIO, headers: dict[str, str]) -> None:
        super().__init__(_pieces(file), headers=headers)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()


async def _pieces(file: BinaryIO) -> AsyncIterator[bytes]:
    while piece := await to_thread.run_sync(file.read, PIECE):
        yield piece
