"""`Objects`: documents and policy files as `objects/ab/cdef…`, named by their SHA-256."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from leaderboard.documents.board import Folder
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store.files import (
    MAX_DOCUMENT_BYTES,
    digest_of,
    durable_file,
    parse_document,
    unwritable,
    write_document,
)
from sme_registry.io import is_regular, read_regular, sha256_of
from sme_registry.spec.document import StrictModel

_Model = TypeVar("_Model", bound=StrictModel)


class Objects:
    """The documents and policy files of one board.

    Args:
      folder: the board's.
      by_kind: whether its documents lie in folders for each kind, as by rules 2.
    """

    def __init__(self, folder: Folder, *, by_kind: bool = False) -> None:
        self.folder = folder
        self._is_by_kind = by_kind

    def put(self, digest: str, chunks: Iterable[bytes], limit: int) -> int:
        """Write an artefact of at most `limit` bytes; it exists only once all of it is verified.

        If it exists, its bytes are verified, too, but not written. Arguments and errors as for
        `Store.put_object`.

        Returns:
          Its size in bytes.
        """
        if self.touch(digest):
            return sum(len(chunk) for chunk in _verified(digest, chunks, limit))
        size = 0
        with durable_file(self.folder.object(digest)) as stream:
            for chunk in _verified(digest, chunks, limit):
                size += stream.write(chunk)
        return size

    def write(self, document: StrictModel) -> str:
        """Write a document, and return its digest."""
        digest = digest_of(document)
        path = self.folder.object(digest)
        if not is_regular(path):
            write_document(path, document)
        return digest

    def path(self, digest: str) -> Path:
        """The file of a digest, whether it exists or not."""
        path = self.folder.object(digest)
        return path if is_regular(path) else self._by_kind.get(digest, path)

    def has(self, digest: str) -> bool:
        """Whether the document or policy file exists, as a regular file."""
        return is_regular(self.path(digest))

    def touch(self, digest: str) -> bool:
        """Make a policy file young, so that `gc` keeps it; False if it does not exist.

        Raises:
          BoardError: the folder is not writable.
        """
        path = self.folder.object(digest)
        try:
            os.utime(path)
        except FileNotFoundError:
            return False
        except OSError as error:
            raise unwritable(path, error) from error
        return True

    def read(self, digest: str) -> bytes:
        """Read a document or policy file and verify its digest.

        Raises:
          BoardError: it does not exist.
          TamperedError: its bytes have another digest.
        """
        path = self.path(digest)
        try:
            data = read_regular(path, MAX_DOCUMENT_BYTES)
        except OSError as error:
            raise BoardError(
                f"{path}: cannot be read: {error.strerror}. Upload the artefact again."
            ) from None
        if sha256_of(data) != digest:
            raise TamperedError(self._where(digest), "its bytes do not match its digest")
        return data

    def document(self, kind: type[_Model], digest: str) -> _Model:
        """Read a document that the log names.

        Raises:
          TamperedError: it is missing, altered, or not of this kind.
        """
        try:
            data = self.read(digest)
        except BoardError:
            where = self._where(digest)
            raise TamperedError(where, "is missing, altered, or no regular file") from None
        return parse_document(data, kind, self._where(digest))

    def paths(self) -> Iterator[tuple[str, Path]]:
        """Digest and path of every file in objects/, sorted."""
        if not self.folder.objects.is_dir():
            return
        for shelf in sorted(self.folder.objects.iterdir()):
            if not shelf.is_dir():
                continue
            for path in sorted(shelf.iterdir()):
                if not path.name.startswith("."):
                    yield f"sha256:{shelf.name}{path.name}", path

    def _where(self, digest: str) -> str:
        if self._is_by_kind and not self.has(digest):  # its file, which was altered, has another
            return f"document {digest}"
        return self.path(digest).relative_to(self.folder.path).as_posix()

    @functools.cached_property
    def _by_kind(self) -> dict[str, Path]:
        """The documents of a board of rules 2, by digest."""
        found: dict[str, Path] = {}
        if not self._is_by_kind:
            return found
        for kind in ("submissions", "withdrawals", "results", "seasons"):
            for path in sorted((self.folder.path / kind).rglob("*.json")):
                with contextlib.suppress(OSError):
                    found[sha256_of(read_regular(path, MAX_DOCUMENT_BYTES))] = path
        return found


def _verified(digest: str, chunks: Iterable[bytes], limit: int) -> Iterator[bytes]:
    """The bytes as they arrive; raises at the end if they are not the artefact of this digest."""
    sha256, size = hashlib.sha256(), 0
    for chunk in chunks:
        size += len(chunk)
        if size > limit:
            raise Rejection(
                "too_large",
                f"artefact={digest[:19]}…: has more than {limit:,} bytes. Submit a smaller policy.",
            )
        sha256.update(chunk)
        yield chunk
    actual = "sha256:" + sha256.hexdigest()
    if actual != digest:
        raise Rejection(
            "artefact_digest",
            f"artefact={digest[:19]}…: the bytes have the digest {actual[:19]}…. "
            "Upload the file that was hashed.",
        )
