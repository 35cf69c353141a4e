"""Files of a board: complete or absent, durable, and read back only as they were written; locks.

`Objects` are documents and policy files as `objects/ab/cdef…`, named by their SHA-256. The writing
itself is `sme_registry.io.atomic_file`; a board also syncs the folder that names a file, so that a
logged entry survives a loss of power, and makes files readable to everyone.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, TypeVar

from leaderboard.documents.board import Folder
from leaderboard.errors import BoardError, Rejection, TamperedError
from sme_registry import io
from sme_registry.errors import SMEError
from sme_registry.io import is_regular, read_regular, sha256_of
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
    """`sme_registry.io.atomic_file` in a folder that need not exist, durable on a loss of power."""
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
    """Read board.json or a log entry, whose digest nothing names."""
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
        """Hold the lock for the block; a shared one admits other shared holders."""
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
        """Make a policy file young, so that `gc` keeps it; False if it does not exist."""
        path = self.folder.object(digest)
        try:
            os.utime(path)
        except FileNotFoundError:
            return False
        except OSError as error:
            raise unwritable(path, error) from error
        return True

    def read(self, digest: str) -> bytes:
        """Read a document or policy file and verify its digest."""
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
        """Read a document that the log names."""
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
