"""Files of a board: complete or absent, durable, and read back only as they were written; locks.

`Objects` are documents and policy files as `objects/ab/cdef…`, named by their SHA-256. The writing
itself is `sme_registry.io.atomic_file`; a board also syncs the folder that names a file, so that a
logged entry survives a loss of power, and makes files readable to everyone.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import hashlib
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeVar

from leaderboard.documents.board import Folder
from leaderboard.documents.submission import shifted, utc
from leaderboard.errors import BoardError, Rejection, TamperedError
from sme_registry import io
from sme_registry.errors import SMEError
from sme_registry.io import TEMPORARY, is_regular, read_regular, sha256_of
from sme_registry.spec.document import StrictModel

if TYPE_CHECKING:
    from leaderboard.store.store import Store

try:
    import fcntl
except ImportError:  # Windows, where boards can be read but not written
    fcntl = None  # type: ignore[assignment]

BUSY_SECONDS = 60.0
MAX_DOCUMENT_BYTES = 16 * 2**20
"""Of a file that a board has written: a result of 10,000 failed runs has 3.3 MiB."""

_UNNAMED_SECONDS = 3600.0
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
    return sha256_of(to_bytes(document))


def write_document(path: Path, document: StrictModel, *, new: bool = False) -> None:
    """Write a document's file; arguments and errors as for `durable_file`."""
    write_file(path, to_bytes(document), new=new)


def read_document(folder: Folder, path: Path, kind: type[_Model]) -> _Model:
    """Read board.json or a log entry, whose digest nothing names."""
    where = path.relative_to(folder.path).as_posix()
    try:
        data = read_regular(path, MAX_DOCUMENT_BYTES)
    except OSError as error:
        raise TamperedError(where, f"cannot be read: {error.strerror}") from None
    document = _parsed(data, kind, where)
    if to_bytes(document) != data:
        raise TamperedError(where, "is not in the form in which the board writes it")
    return document


def _parsed(data: bytes, kind: type[_Model], where: str) -> _Model:
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
        board = self._path.parent
        if not self._open:
            raise BoardError(f"{board}: the store is closed. Open it again.")
        if self._handle is None:
            if exclusive:
                raise BoardError(
                    f"{board}: a board can only be written on Linux and macOS. Open it read-only "
                    "here."
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
                        f"{board}: another process has locked the board for {BUSY_SECONDS:.0f} s. "
                        "Find the process that hangs, then try again."
                    ) from None
                time.sleep(0.002)
        try:
            yield
        finally:
            fcntl.flock(self._handle, fcntl.LOCK_UN)


class Objects:
    """The documents and policy files of one board; by rules 2 (`by_kind`) in folders by kind."""

    def __init__(self, folder: Folder, *, by_kind: bool = False) -> None:
        self.folder = folder
        self._is_by_kind = by_kind

    def put(self, digest: str, chunks: Iterable[bytes], limit: int) -> int:
        """Verify an artefact's bytes, and write them unless they exist; returns their number."""
        verified = _verified(digest, chunks, limit)
        if self.touch(digest):
            return sum(map(len, verified))
        with durable_file(self.folder.object(digest)) as stream:
            return sum(map(stream.write, verified))

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
        return _parsed(data, kind, self._where(digest))

    def paths(self) -> Iterator[tuple[str, Path]]:
        """Digest and path of every file in objects/, sorted."""
        for path in sorted(self.folder.objects.glob("*/*")):
            if not path.name.startswith("."):
                yield f"sha256:{path.parent.name}{path.name}", path

    def _where(self, digest: str) -> str:
        if self._is_by_kind and not self.has(digest):  # its file, which was altered, has another
            return f"document {digest}"
        return self.path(digest).relative_to(self.folder.path).as_posix()

    @functools.cached_property
    def _by_kind(self) -> dict[str, Path]:
        """The documents of a board of rules 2, by digest."""
        paths: dict[str, Path] = {}
        for kind in ("submissions", "withdrawals", "results", "seasons") * self._is_by_kind:
            for path in sorted((self.folder.path / kind).rglob("*.json")):
                with contextlib.suppress(OSError):
                    paths[sha256_of(read_regular(path, MAX_DOCUMENT_BYTES))] = path
        return paths


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


@dataclass(frozen=True)
class Garbage:
    """What `collect_garbage` removed, or would remove."""

    temporary: int  # half-written files of dead processes
    objects: int  # artefacts that no submission names
    bytes: int  # of both

    @property
    def files(self) -> int:
        """Number of files of both kinds."""
        return self.temporary + self.objects


def collect_garbage(
    store: Store,
    *,
    temporary_older_than: float = 3600.0,
    objects_older_than: float = 86400.0,
    dry_run: bool = False,
) -> Garbage:
    """Remove half-written files of dead processes and artefacts that no submission names.

    Ages are in seconds since a file was last written to: a younger one may belong to an upload in
    progress, or its submission may follow. `dry_run` only counts.
    """
    now = time.time()

    def is_older(path: Path, seconds: float) -> bool:
        return path.lstat().st_mtime <= now - seconds

    with store.transaction() as index:
        temporary = [
            path
            for path in store.folder.path.rglob(TEMPORARY)
            if path.is_file() and is_older(path, temporary_older_than)
        ]
        named = set(store.named_objects())
        objects = {
            digest: path
            for digest, path in store.objects.paths()
            if digest not in named and is_older(path, objects_older_than)
        }
        paths = [*temporary, *objects.values()]
        size = sum(path.lstat().st_size for path in paths)
        if not dry_run:
            for path in paths:
                _remove(path)
            for digest in objects:
                index.connection.execute("DELETE FROM upload WHERE digest = ?", (digest,))
    return Garbage(len(temporary), len(objects), size)


def expire_uploads(store: Store) -> None:
    """Remove uploads of more than an hour ago that no submission of their key has named."""
    moment = datetime.datetime.fromisoformat(store.time)
    until = utc(shifted(moment, -datetime.timedelta(seconds=_UNNAMED_SECONDS)))
    held = "SELECT 1 FROM object WHERE digest = ?1 UNION SELECT 1 FROM upload WHERE digest = ?1"
    with store.transaction() as index:
        old = index.connection.execute(
            "DELETE FROM upload WHERE time <= ? RETURNING digest", (until,)
        ).fetchall()
        for (digest,) in old:
            if index.one(held, digest) is None:
                _remove(store.folder.object(digest))


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
