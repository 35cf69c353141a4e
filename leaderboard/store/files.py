"""Files of a board: complete or absent, durable, and read back only if they match the log; locks.

The writing itself is `sme_registry.io.atomic_file`. A board also syncs the folder that names a
file, so that a logged entry survives a loss of power, and makes files readable to everyone.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, TypeVar

from leaderboard.documents.board import Folder
from leaderboard.errors import BoardError, TamperedError
from sme_registry import io
from sme_registry.errors import SMEError
from sme_registry.io import read_regular
from sme_registry.spec.document import StrictModel

try:
    import fcntl
except ImportError:  # Windows, where boards can be read but not written
    fcntl = None  # type: ignore[assignment]

BUSY_SECONDS = 60.0
MAX_DOCUMENT_BYTES = 16 * 2**20
"""Of a file that a board has written: a result of 10,000 failed runs has 3.3 MiB."""

MAX_LOG_ENTRY_BYTES = 4096
_Model = TypeVar("_Model", bound=StrictModel)


@contextlib.contextmanager
def durable_file(path: Path, *, new: bool = False) -> Iterator[BinaryIO]:
    """`sme_registry.io.atomic_file` in a folder that need not exist, durable on a loss of power.

    Raises:
      BoardError: the disk is full, the folder is not writable, or (`new`) the file exists.
    """
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
            io.sync_folder(path.parent.parent)
        with io.atomic_file(path, new=new) as stream:
            os.fchmod(stream.fileno(), 0o644)
            yield stream
        io.sync_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error


def write_file(path: Path, data: bytes, *, new: bool = False) -> None:
    """Write a whole file; arguments and errors as for `durable_file`."""
    with durable_file(path, new=new) as stream:
        stream.write(data)


def unwritable(path: Path, error: OSError) -> BoardError:
    """The error to raise where a write failed."""
    return BoardError(
        f"{path}: cannot be written: {error.strerror or error}. "
        "Nothing was changed. Free disk space or get write permission, then try again."
    )


def to_bytes(document: StrictModel) -> bytes:
    """The contents of a document's file."""
    return io.to_json(document.to_dict()).encode()


def digest_of(document: StrictModel) -> str:
    """`sha256:` and 64 hex digits of the document's file, as `sha256sum` prints them."""
    return io.sha256_of(to_bytes(document))


def write_document(path: Path, document: StrictModel, *, new: bool = False) -> None:
    """Write a document's file; arguments and errors as for `durable_file`."""
    write_file(path, to_bytes(document), new=new)


def read_document(
    folder: Folder,
    path: Path,
    kind: type[_Model],
    *,
    limit: int = MAX_DOCUMENT_BYTES,
) -> _Model:
    """Read board.json or a log entry, whose digest nothing names.

    Raises:
      TamperedError: the file is missing, is not a regular file, is too large, is not a document of
        this type, or is not in the form in which the board writes it.
    """
    where = path.relative_to(folder.path).as_posix()
    try:
        data = read_regular(path, limit)
    except OSError as error:
        raise TamperedError(where, f"cannot be read: {error.strerror}") from None
    document = parse_document(data, kind, where)
    if to_bytes(document) != data:
        raise TamperedError(where, "is not in the form in which the board writes it")
    return document


def parse_document(data: bytes, kind: type[_Model], where: str) -> _Model:
    """A document from its bytes, which `where` names in errors."""
    try:
        return kind.from_dict(io.parse_json(data, where), where)
    except SMEError as error:
        raise TamperedError(where, f"is not a document that the board wrote: {error}") from None


class FolderLock:
    """One writer or many readers of a board at a time, across processes.

    The lock is `flock` on a folder that is never replaced. It needs no file of its own, so a board
    can be read from a folder that is read-only, and the kernel frees it when its holder dies.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open = True
        self._handle = None if fcntl is None else os.open(path, os.O_RDONLY | os.O_DIRECTORY)

    def close(self) -> None:
        """Release the lock's handle; closing twice does nothing."""
        if self._open and self._handle is not None:
            os.close(self._handle)
        self._open = False

    @contextlib.contextmanager
    def hold(self, *, exclusive: bool) -> Iterator[None]:
        """Hold the lock for the block; a shared one admits other shared holders.

        Raises:
          BoardError: the lock is closed, another process holds it for a minute, or (exclusive)
            this system has no `flock`.
        """
        if not self._open:
            raise BoardError(f"{self._path.parent}: the store is closed. Open it again.")
        if self._handle is None:
            if exclusive:
                raise BoardError(
                    f"{self._path.parent}: a board can only be written on Linux and macOS. "
                    "Open it read-only here."
                )
            yield  # no process of this system can write
            return
        kind = fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH
        deadline = time.monotonic() + BUSY_SECONDS
        while True:
            try:
                fcntl.flock(self._handle, kind | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise BoardError(
                        f"{self._path.parent}: another process has locked the board for "
                        f"{BUSY_SECONDS:.0f} s. Find the process that hangs, then try again."
                    ) from None
                time.sleep(0.002)
        try:
            yield
        finally:
            fcntl.flock(self._handle, fcntl.LOCK_UN)
