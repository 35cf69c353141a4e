"""Artefacts by content: `objects/ab/cdef…`, named by the SHA-256 of their bytes."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from leaderboard.documents.board import Folder
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store.files import atomic_file, unwritable


class Objects:
    """The artefacts of one board.

    Args:
      folder: the board's.
    """

    def __init__(self, folder: Folder) -> None:
        self.folder = folder

    def put(self, digest: str, chunks: Iterable[bytes], limit: int) -> bool:
        """Write an artefact as its bytes come; nothing of it is there before all of it is right.

        Args:
          digest: what its bytes must have.
          chunks: the bytes; not read where the artefact is there already.
          limit: most bytes.

        Returns:
          True if it is new.

        Raises:
          Rejection: `too_large` or `artefact_digest`.
          BoardError: it cannot be written.
        """
        path = self.folder.object(digest)
        try:
            os.utime(path)  # young again, so that `gc` leaves it to the submission that is coming
            return False
        except FileNotFoundError:
            pass
        except OSError as error:
            raise unwritable(path, error) from error
        sha256, size = hashlib.sha256(), 0
        with atomic_file(path) as stream:
            for chunk in chunks:
                size += len(chunk)
                if size > limit:
                    raise Rejection(
                        "too_large",
                        f"artefact={digest[:19]}…: more than {limit:,} bytes. "
                        "Submit a smaller policy.",
                    )
                sha256.update(chunk)
                stream.write(chunk)
            found = "sha256:" + sha256.hexdigest()
            if found != digest:
                raise Rejection(
                    "artefact_digest",
                    f"artefact={digest[:19]}…: its bytes have the digest {found[:19]}…. "
                    "Send the file that was hashed.",
                )
        return True

    def has(self, digest: str) -> bool:
        """Whether the artefact is there."""
        return self.folder.object(digest).is_file()

    def read(self, digest: str) -> bytes:
        """An artefact's bytes, hashed anew.

        Raises:
          BoardError: it is not there.
          TamperedError: its bytes have another digest.
        """
        path = self.folder.object(digest)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise BoardError(
                f"{path}: cannot be read: {error.strerror}. Upload the artefact again."
            ) from None
        if hashlib.sha256(data).hexdigest() != path.parent.name + path.name:
            where = path.relative_to(self.folder.path).as_posix()
            raise TamperedError(where, "its bytes have another digest than its name says")
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
