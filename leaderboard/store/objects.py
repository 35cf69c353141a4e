"""`Objects`: artefacts as `objects/ab/cdef…`, named by the SHA-256 of their bytes."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from leaderboard.documents.board import Folder
from leaderboard.documents.submission import MAX_ARTEFACT_BYTES
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store.files import durable_file, unwritable
from sme_registry.io import is_regular, read_regular


class Objects:
    """The artefacts of one board."""

    def __init__(self, folder: Folder) -> None:
        self.folder = folder

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

    def has(self, digest: str) -> bool:
        """Whether the artefact exists, as a regular file."""
        return is_regular(self.folder.object(digest))

    def touch(self, digest: str) -> bool:
        """Make an artefact young, so that `gc` keeps it; False if it does not exist.

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
        """Read an artefact and verify its digest.

        Raises:
          BoardError: it does not exist.
          TamperedError: its bytes have another digest.
        """
        path = self.folder.object(digest)
        try:
            data = read_regular(path, MAX_ARTEFACT_BYTES)
        except OSError as error:
            raise BoardError(
                f"{path}: cannot be read: {error.strerror}. Upload the artefact again."
            ) from None
        if hashlib.sha256(data).hexdigest() != path.parent.name + path.name:
            where = path.relative_to(self.folder.path).as_posix()
            raise TamperedError(where, "its bytes do not match the digest in its name")
        return data

    def paths(self) -> Iterator[tuple[str, Path]]:
        """Digest and path of every artefact, sorted."""
        if not self.folder.objects.is_dir():
            return
        for shelf in sorted(self.folder.objects.iterdir()):
            if not shelf.is_dir():
                continue
            for path in sorted(shelf.iterdir()):
                if not path.name.startswith("."):
                    yield f"sha256:{shelf.name}{path.name}", path


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
