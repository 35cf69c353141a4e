"""The files of a board: a log, which is authoritative, objects by digest, and a lock.

entry_n.previous  = digest(entry_{n−1})          64 zeros for the first
entry_n.signature = by the board's key, over the entry without it

There is one file for each event. The number orders the entries. The time of an entry is when it was
received, by the machine's clock and never earlier than the entry before it; what is open, closed,
over or counted follows from it. An entry of the event "clock" corrects the times after its own,
which a wrong clock has made.

`Objects` are documents and policy files as `objects/ab/cdef…`, named by their SHA-256. All files
are complete or absent, and read back only as they were written. The writing itself is
`sme_registry.io.atomic_file`; a board also syncs the folder that names a file, so that a logged
entry survives a loss of power, and makes files readable to everyone.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar

from pydantic import Field, field_validator

from leaderboard.documents.board import Folder
from leaderboard.documents.signed import PlainDocument, Signature, SigningKey, plain_json, verifies
from leaderboard.documents.submission import UtcTime, now, shifted, utc
from leaderboard.errors import BoardError, ClockError, Rejection, TamperedError
from sme_registry import io
from sme_registry.errors import SMEError
from sme_registry.io import TEMPORARY, is_regular, read_regular, sha256_of
from sme_registry.spec.document import Digest, Integer, SchemaVersion, StrictModel

if TYPE_CHECKING:
    from leaderboard.store import Store

try:
    import fcntl
except ImportError:  # Windows, where boards can be read but not written
    fcntl = None  # type: ignore[assignment]

NOTHING = "sha256:" + "0" * 64
MOST_BEHIND, LONGEST_JUMP = 60.0, 300.0
"""Seconds of the machine's clock: behind the log's last entry, and against the uptime."""


class Head(NamedTuple):
    """The last entry of a log or an index, which the next entry must follow."""

    sequence: int  # its number; −1 if there is none
    digest: str
    time: str


EMPTY = Head(-1, NOTHING, "")


class LogEntry(PlainDocument):
    """One event.

    It is "opened" (once, the first), "received", "result" or "withdrawn"; "clock", which dates all
    entries with a later time as its own; or of another track.
    """

    schema_version: SchemaVersion = 1
    sequence: Annotated[Integer, Field(ge=0)]  # 0 for the first
    previous: Digest  # of the entry before
    time: UtcTime  # when it was received
    event: Annotated[str, Field(pattern=r"^[a-z]{1,16}$")]
    subject: Digest  # the entrant's id; of board.json, or of the first entry that "clock" dates
    document: Digest  # of the file of what was received, or of the subject
    signature: Signature  # by the board's key

    @field_validator("time")
    @classmethod
    def _is_a_time(cls, value: str) -> str:
        datetime.datetime.fromisoformat(value)  # not 30 February
        return value

    @property
    def signed_digest(self) -> str:
        """Of the entry without its signature."""
        fields = self.to_dict()
        del fields["signature"]
        return sha256_of(plain_json(fields))

    @property
    def file(self) -> str:
        return f"log/{self.sequence:08d}.json"

    @property
    def head(self) -> Head:
        """This entry as the one that the next entry must follow."""
        return Head(self.sequence, self.digest, self.time)

    def contradiction(self, message: str) -> TamperedError:
        """The error to raise where this entry contradicts those before it."""
        return TamperedError(self.file, f"event={self.event}: {message}")

    def check_subject(self, id: str) -> None:
        """Raise `TamperedError` if its document is of another subject."""
        if id != self.subject:
            raise self.contradiction("names a document of another subject")


class Log:
    """The log of one board, whose entries `key` verifies."""

    def __init__(self, folder: Folder, key: str) -> None:
        self.folder = folder
        self.key = key

    def has(self, sequence: int) -> bool:
        return self.folder.log_entry(sequence).exists()

    def read(self, sequence: int, after: Head | None = None) -> LogEntry:
        """Read an entry and verify its signature; and that it follows `after`, if that is given."""
        entry = read_document(self.folder, self.folder.log_entry(sequence), LogEntry)
        if entry.sequence != sequence:
            raise TamperedError(f"log/{sequence:08d}.json", f"holds entry {entry.sequence}")
        self.check(entry, after)
        return entry

    def check(self, entry: LogEntry, after: Head | None) -> None:
        """Raise `TamperedError` unless the board has signed an entry, and it follows `after`."""
        if not verifies(self.key, entry.signature, "log", entry.signed_digest):
            raise TamperedError(entry.file, "its signature does not match the board's key")
        if after is None:
            return
        if (entry.sequence, entry.previous) != (after.sequence + 1, after.digest):
            raise TamperedError(entry.file, "does not follow the entry before it: one was replaced")
        if (entry.event == "opened") != (entry.sequence == 0):
            raise TamperedError(entry.file, "only the first entry may open a board")

    def entry(
        self, key: SigningKey, after: Head, event: str, subject: str, document: str, time: str
    ) -> LogEntry:
        fields: dict[str, Any] = {
            "schema_version": 1,
            "sequence": after.sequence + 1,
            "previous": after.digest,
            "time": time,
            "event": event,
            "subject": subject,
            "document": document,
        }
        signature = key.sign("log", sha256_of(plain_json(fields)))
        return LogEntry.from_dict({**fields, "signature": signature})

    def write(self, entry: LogEntry) -> None:
        write_document(self.folder.log_entry(entry.sequence), entry, new=True)

    def first_after(self, head: Head, time: str) -> LogEntry | None:
        """The first of the last entries, up to `head`, with a later time; None if there is none."""
        first = None
        for sequence in range(head.sequence, 0, -1):
            entry = self.read(sequence)
            if entry.time <= time:
                break
            first = entry
        return first


class Clock:
    """When a board receives something: by the machine's clock, not before the log's last entry."""

    def __init__(self) -> None:
        self.last = ""  # time of the log's last entry
        # Seconds of the machine's clock against its uptime, when a server first noted it.
        self.offset: float | None = None

    @property
    def time(self) -> str:
        """The board's time, for readers."""
        return max(now(), self.last)

    def received(self) -> str:
        """The board's time, for what is written or expires."""
        if _seconds(self.last) - time.time() > MOST_BEHIND:
            raise ClockError(
                f"clock={now()}: is behind the log's last entry, of {self.last}. Nothing was "
                "changed. Set the machine's clock; if it is right, that entry is dated wrongly: "
                "correct it with `sme-leaderboard admin clock --correct`."
            )
        if self.offset is not None and abs(clock_offset()[1] - self.offset) > LONGEST_JUMP:
            raise ClockError(
                f"clock={now()}: has jumped since the board was first served. Nothing was changed. "
                "Set the machine's clock; if it is right, go on with `sme-leaderboard admin clock`."
            )
        return self.time


@functools.lru_cache(8)  # asked for at every step of a ticket
def _seconds(text: str) -> float:
    """Since 1970."""
    return datetime.datetime.fromisoformat(text).timestamp() if text else 0.0


def uptime() -> tuple[str, float]:
    """The machine's boot id, and seconds since boot, also in suspend: no clock changes them."""
    return _boot(), time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@functools.cache
def _boot() -> str:
    path = Path("/proc/sys/kernel/random/boot_id")
    return path.read_text().strip() if path.exists() else ""


def clock_offset() -> tuple[str, float]:
    """The boot id, and what the machine's clock is ahead of its uptime, in seconds."""
    boot, seconds = uptime()
    return boot, time.time() - seconds


BUSY_SECONDS = 60.0
MAX_DOCUMENT_BYTES = 16 * 2**20
"""Of a file that a board has written: a result of 10,000 failed runs has 3.3 MiB."""

_UNNAMED = datetime.timedelta(hours=1)
DAY = datetime.timedelta(days=1)  # of the quotas of a key
_Model = TypeVar("_Model", bound=StrictModel)


def write_file(path: Path, data: bytes, *, new: bool = False) -> None:
    """Write a file completely or not at all, durable on a loss of power, in a folder or none."""
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
            io.sync_folder(path.parent.parent)
        with io.atomic_file(path, new=new) as stream:
            os.fchmod(stream.fileno(), 0o644)
            stream.write(data)
        io.sync_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error


def unwritable(path: Path, error: OSError) -> BoardError:
    return BoardError(
        f"{path}: cannot be written: {error.strerror or error}. "
        "Nothing was changed. Free disk space or get write permission, then try again."
    )


def to_bytes(document: StrictModel) -> bytes:
    return io.to_json(document.to_dict()).encode()


def digest_of(document: StrictModel) -> str:
    """`sha256:` and 64 hex digits of the document's file, as `sha256sum` prints them."""
    return sha256_of(to_bytes(document))


def write_document(path: Path, document: StrictModel, *, new: bool = False) -> None:
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
    """One writer or many readers of a board at a time, across processes."""

    # `flock` on a folder that is never replaced needs no file of its own, so that a board can be
    # read from a folder that is read-only, and the kernel frees it when its holder dies.

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open = True
        self._handle = None if fcntl is None else os.open(path, os.O_RDONLY | os.O_DIRECTORY)

    def close(self) -> None:
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

    def put(self, digest: str, data: bytes, limit: int) -> None:
        """Verify a policy file's bytes, and write them unless they exist."""
        if len(data) > limit:
            raise Rejection(
                "too_large",
                f"artefact={digest[:19]}…: has more than {limit:,} bytes. Submit a smaller policy.",
            )
        actual = sha256_of(data)
        if actual != digest:
            raise Rejection(
                "artefact_digest",
                f"artefact={digest[:19]}…: the bytes have the digest {actual[:19]}…. "
                "Upload the file that was hashed.",
            )
        if not self.touch(digest):
            write_file(self.folder.object(digest), data)

    def write(self, document: StrictModel) -> str:
        digest = digest_of(document)
        path = self.folder.object(digest)
        if not is_regular(path):
            write_document(path, document)
        return digest

    def path(self, digest: str) -> Path:
        path = self.folder.object(digest)
        return path if is_regular(path) else self._by_kind.get(digest, path)

    def has(self, digest: str) -> bool:
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


class Garbage(NamedTuple):
    """What `collect_garbage` removed, or would remove."""

    temporary: int  # half-written files of dead processes
    objects: int  # artefacts that no submission names
    bytes: int  # of both


def collect_garbage(
    store: Store,
    *,
    temporary_older_than: float = 3600.0,
    objects_older_than: float = 86400.0,
    dry_run: bool = False,
) -> Garbage:
    """Remove half-written files of dead processes and artefacts that no submission names.

    Those last written to so many seconds ago: an upload may be in progress, or its submission
    follow. `dry_run` only counts.
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
    """Remove uploads of more than an hour ago that no submission of their key has named.

    They still count towards their key's quota of a day.
    """
    moment = datetime.datetime.fromisoformat(store.time)
    until = utc(shifted(moment, -_UNNAMED))
    held = "SELECT 1 FROM object WHERE digest = ?1 UNION SELECT 1 FROM upload WHERE digest = ?1"
    with store.transaction() as index:
        execute = index.connection.execute
        old = execute(
            "DELETE FROM upload WHERE time <= ? RETURNING digest, key, size, time", (until,)
        ).fetchall()
        index.connection.executemany("INSERT INTO spent VALUES (?, ?, ?)", (row for _, *row in old))
        execute("DELETE FROM spent WHERE time <= ?", (utc(shifted(moment, -DAY)),))
        for digest, *_ in old:
            if index.one(held, digest) is None:
                _remove(store.folder.object(digest))


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
