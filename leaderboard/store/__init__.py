"""`Store`: one board's folder, its signed log and SQLite index in step, for many processes.

A write holds the board's lock and writes the document's file, then the log entry, then the index's
rows. A process that dies before the log entry has changed nothing. If it dies after it, the next
process adds the entry to the index.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self, TypeVar

from leaderboard.documents.board import (
    RULES,
    BoardDocument,
    Folder,
    refuse_unsubmittable,
)
from leaderboard.documents.result import EntryRow, Result
from leaderboard.documents.signed import Signed, SigningKey
from leaderboard.documents.submission import Submission, Withdrawal, now
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store.index import Index, Kinds
from leaderboard.store.log import (
    EMPTY,
    Clock,
    FolderLock,
    Head,
    Log,
    LogEntry,
    Objects,
    clock_offset,
    digest_of,
    uptime,
    write_document,
)
from leaderboard.store.queue import Queue
from sme_registry.io import build_folder
from sme_registry.spec.document import StrictModel

_Model = TypeVar("_Model", bound=StrictModel)


class Store:
    """A board's folder, opened by `create` or `open`; a context manager."""

    def __init__(self, path: str | Path, *, read_only: bool) -> None:
        self.folder = Folder(path)
        self.document: BoardDocument = self.folder.read()
        self.read_only = read_only
        self.objects = Objects(self.folder, by_kind=self.document.rules == 2)
        self.clock = Clock()
        self.queue = Queue(self)
        self._log = Log(self.folder, self.document.key)
        self._thread_lock = threading.RLock()
        self._in_transaction = False
        self._progress: Callable[[int], None] | None = None
        self._key: SigningKey | None = None
        self._index: Index | None = None
        if not self._log.has(0):
            raise TamperedError("log/00000000.json", "is missing; every log starts with it")
        self._lock = FolderLock(self.folder.log)

    @classmethod
    def create(cls, path: str | Path, **fields: Any) -> Self:
        """Create a board of these fields, with its own key, in a new or empty folder."""
        key = SigningKey.generate()
        document = BoardDocument.from_dict({"key": key.public, "rules": RULES, **fields})
        if len(document.instances) != len(document.suite.instances):
            raise BoardError(
                f"suite={document.suite_name}: two classes share an instance. Change one of the "
                "seeds."
            )
        refuse_unsubmittable(document)
        path = Path(path)
        is_empty = path.is_dir() and not any(path.iterdir())
        if os.path.lexists(path) and not is_empty:
            raise BoardError(f"{path}: already exists. Choose a new folder for the board.")
        with build_folder(path, force=is_empty) as building:
            folder = Folder(building)
            for part in (folder.log, folder.objects):  # `build_folder` flushes them to disk
                part.mkdir()
            key.write(folder.key)
            write_document(folder.board, document, new=True)
            log, digest = Log(folder, key.public), digest_of(document)
            log.write(log.entry(key, EMPTY, "opened", document.digest, digest, now()))
        return cls.open(path)

    @classmethod
    def open(
        cls,
        path: str | Path,
        *,
        read_only: bool = False,
        reindex: bool = False,
        progress: Callable[[int], None] | None = None,
    ) -> Self:
        """Open a board and bring its index up to date; an unusable index is rebuilt.

        Read-only, for copies of boards, whose index may lie, nothing is written, and nothing read
        but log and documents, from which an index in memory is built.
        """
        store = cls(path, read_only=read_only)
        store._progress = progress
        try:
            store._open(reindex=reindex)
        except BaseException:
            store.close()
            raise
        store._progress = None
        return store

    def _open(self, *, reindex: bool) -> None:
        if not self.read_only and not os.access(self.folder.path, os.W_OK):
            raise BoardError(
                f"{self.folder.path}: is not writable. Get write permission, or open the board "
                "read-only."
            )
        # Without the key, nothing was ever written here: the index is somebody else's.
        self._connect(rebuild=reindex or not self.folder.key.is_file())
        try:
            self._refresh()
        except TamperedError:  # passes with a rebuilt index if only the index was altered
            if self.read_only:
                raise
            self._connect(rebuild=True)

    def close(self) -> None:
        """Close the index and the lock; closing twice does nothing."""
        with self._thread_lock:
            if self._index is not None:
                # Closing the last connection moves SQLite's write-ahead log into the database.
                with self.locked():
                    self._index.connection.close()
                self._index = None
            self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def kinds(self) -> Kinds:
        """What log entries of further tracks do to the index."""
        return {}

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Block all writers for a short while; a writable store also blocks all readers."""
        with self._thread_lock, self._lock.hold(exclusive=not self.read_only):
            yield

    @contextlib.contextmanager
    def transaction(self) -> Iterator[Index]:
        """Write while every other process and thread waits; nests; yields the index."""
        self.refuse_read_only()
        with self._thread_lock:
            if self._in_transaction:
                yield self._connected
                return
            with self._lock.hold(exclusive=True), self._explained(), self._writing() as index:
                self._catch_up(index)
                self._follow_clock(index)
                yield index

    @contextlib.contextmanager
    def _writing(self) -> Iterator[Index]:
        """Write into the index, which is not refreshed meanwhile."""
        with self._connected.transaction():
            self._in_transaction = True
            try:
                yield self._connected
            finally:
                self._in_transaction = False

    @contextlib.contextmanager
    def reading(self) -> Iterator[Index]:
        """Read the index, brought up to date with what other processes have written."""
        with self._thread_lock, self._explained():
            if not self._in_transaction:
                self._refresh()
                self._follow_clock(self._connected)
            yield self._connected

    def query(self, statement: str, *values: Any) -> list[tuple[Any, ...]]:
        """The rows that answer a query of the index."""
        with self.reading() as index:
            return index.connection.execute(statement, values).fetchall()

    def record(self, event: str, subject: str, document: StrictModel) -> None:
        """Log a document in a transaction; a `Rejection` says why it is not allowed now."""
        key = self.signing_key()
        index, time = self._connected, self.clock.received()
        entry = self._log.entry(key, index.head, event, subject, digest_of(document), time)
        index.apply(entry, document)
        self.objects.write(document)
        self._log.write(entry)
        self.clock.last = entry.time

    @property
    def time(self) -> str:
        """When the board receives what comes now."""
        with self.reading():
            return self.clock.received()

    def note_clock(self, *, anew: bool = False) -> None:
        """Note the clock, once after each start or anew; after a jump, nothing is written."""
        with self.transaction() as index:
            row = clock_offset()
            if anew or index.one("SELECT 1 FROM clock WHERE boot = ?", row[0]) is None:
                index.connection.execute("DELETE FROM clock")
                index.connection.execute("INSERT INTO clock VALUES (?, ?)", row)
            self._follow_clock(index)

    def correct_clock(self) -> int:
        """Date all later entries of the log as of now; the number of the first, or 0 for none."""
        key = self.signing_key()
        with self.transaction() as index:
            time = now()
            first = self._log.first_after(index.head, time)
            if first is None:
                return 0
            entry = self._log.entry(key, index.head, "clock", first.digest, digest_of(first), time)
            self._log.write(entry)
            index.apply(entry)
            self.clock.last = time
        return first.sequence

    def _follow_clock(self, index: Index) -> None:
        self.clock.last = index.head.time
        row = index.one("SELECT offset FROM clock WHERE boot = ?", uptime()[0])
        self.clock.offset = None if row is None else row[0]

    def signing_key(self) -> SigningKey:
        """The board's key."""
        if self.document.rules != RULES:
            raise BoardError(
                f"{self.folder.path}: follows rules {self.document.rules}, and boards that accept "
                f"submissions follow rules {RULES}. Go on with the version that made it, or create "
                "a new board with `sme-leaderboard init`."
            )
        if self._key is None:
            if not self.folder.key.exists():
                raise BoardError(
                    f"{self.folder.path}: cannot accept anything without the board's key, "
                    f"{self.folder.key.name}. Copy it from the original board, or create your own "
                    "board with `sme-leaderboard init`."
                )
            key = self.folder.signing_key()
            if key.public != self.document.key:
                raise BoardError(
                    f"{self.folder.key}: is not the key in board.json, "
                    f"{self.document.key[:16]}…. Restore that key."
                )
            self._key = key
        return self._key

    def refuse_read_only(self) -> None:
        """Raise `BoardError` if the board was opened read-only."""
        if self.read_only:
            raise BoardError(f"{self.folder.path}: opened read-only. Open it for writing.")

    def reindex(self) -> None:
        """Rebuild the index from the log and the documents, whatever its state."""
        self.refuse_read_only()
        self._connect(rebuild=True)

    @property
    def _connected(self) -> Index:
        if self._index is None:
            raise BoardError(f"{self.folder.path}: the store is closed. Open it again.")
        return self._index

    def _refresh(self) -> None:
        """Apply what other processes have logged; a look at one file shows whether they have."""
        index = self._connected
        if self._log.has(index.head.sequence + 1):
            if self.read_only:
                with self._writing():
                    self._catch_up(index)
            else:
                with self.transaction():
                    pass

    def _catch_up(self, index: Index) -> None:
        head = index.head
        while self._log.has(head.sequence + 1):
            entry = self._log.read(head.sequence + 1, head)
            index.apply(entry)
            head = entry.head
            if self._progress is not None:
                self._progress(head.sequence)

    def _connect(self, *, rebuild: bool) -> None:
        """Connect to the index, rebuilt in place if necessary, while the board is locked."""
        with self.locked(), self._explained():
            self._index = self._index or Index(
                self.objects, self.document, self.kinds, in_memory=self.read_only
            )
            if self.read_only:
                return
            if not rebuild and self._index.is_current:
                self._refuse_lost_log(self._index.head)
                return
            with self._writing() as index:
                index.clear()
                self._catch_up(index)

    def _refuse_lost_log(self, head: Head) -> None:
        """Check that the log still has the index's last entry; an index is never ahead of it."""
        if head == EMPTY:
            return
        where = f"log/{head.sequence:08d}.json"
        remedy = "Restore the log, or accept the present one with `sme-leaderboard admin reindex`"
        if not self._log.has(head.sequence):
            raise TamperedError(where, f"is missing, but the index recorded it. {remedy}")
        if self._log.read(head.sequence).digest != head.digest:
            raise TamperedError(where, f"differs from the entry that the index recorded. {remedy}")

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise BoardError(
                f"{self.folder.index}: {error}. Free disk space or get write permission; "
                "otherwise stop what uses the board, and delete this file, which is then rebuilt."
            ) from error

    def put_object(self, digest: str, data: bytes, *, by: str) -> bool:
        """Store an artefact of a key; False if the key has uploaded or submitted it before.

        Its bytes show that the uploader has it, too, and not only its digest. A `Rejection` is
        `too_large` or `artefact_digest`.
        """
        self.refuse_read_only()
        self.signing_key()  # without it no submission could follow
        self.objects.put(digest, data, self.document.limits.artefact_bytes)
        with self.transaction() as index:
            if not self.objects.touch(digest):
                raise BoardError(f"artefact={digest}: was removed meanwhile. Upload it again.")
            time, execute = self.clock.received(), index.connection.execute
            renewed = "UPDATE upload SET time = ? WHERE digest = ? AND key = ?"
            if execute(renewed, (time, digest, by)).rowcount or self.possesses(by, digest):
                return False
            execute("INSERT INTO upload VALUES (?, ?, ?, ?)", (digest, len(data), by, time))
        return True

    def receive(self, signed: Signed[Submission]) -> bool:
        """Add a submission, which was admitted, to the queue; False if the board has it."""
        with self.transaction() as index:
            if index.status(signed.id) is not None:
                return False
            self.record("received", signed.id, signed)
        return True

    def withdraw(self, signed: Signed[Withdrawal]) -> bool:
        """Record a withdrawal, which was admitted; False if the submission was withdrawn before."""
        with self.transaction() as index:
            if index.status(signed.content.submission) == "withdrawn":
                return False
            self.record("withdrawn", signed.content.submission, signed)
        return True

    def submission(self, id: str) -> Signed[Submission]:
        """A submission as it was signed; a `Rejection` is `unknown_submission`."""
        signed = self._read("document", id, Signed[Submission])
        if signed is None:
            raise unknown_submission(id)
        return signed

    def result(self, id: str) -> Result | None:
        """A submission's result; None if it has none, or does not exist."""
        return self._read("result", id, Result)

    def withdrawal(self, id: str) -> Signed[Withdrawal] | None:
        """A submission's withdrawal; None if there is none."""
        return self._read("withdrawal", id, Signed[Withdrawal])

    def _read(self, column: str, id: str, kind: type[_Model]) -> _Model | None:
        """A document of a submission, whose digest in the log the index has in `column`."""
        rows = self.query(f"SELECT {column} FROM entry WHERE id = ? AND track = ''", id)
        digest = rows[0][0] if rows else None
        return None if digest is None else self.objects.document(kind, digest)

    def entries(self) -> list[EntryRow]:
        """All submissions, in the order in which they were received."""
        with self.reading() as index:
            return list(index.entrants(EntryRow))

    def entry(self, id: str) -> EntryRow | None:
        """One submission; None if there is no such submission."""
        with self.reading() as index:
            return next(index.entrants(EntryRow, "track = '' AND id = ?", id), None)

    @property
    def head(self) -> Head:
        """Number, digest and time of the last log entry."""
        with self.reading() as index:
            return index.head

    def log(self, start: int = 0, count: int = 100) -> list[LogEntry]:
        """At most `count` log entries, from number `start` on."""
        stop = min(start + count, self.head.sequence + 1)
        return [self._log.read(sequence) for sequence in range(max(start, 0), stop)]

    def possesses(self, key: str, digest: str) -> bool:
        """Whether a key has uploaded an artefact: digests are public before the artefacts are."""
        held = self.query(
            "SELECT 1 FROM upload WHERE digest = ?1 AND key = ?2 UNION "
            "SELECT 1 FROM artefact JOIN entry ON id = submission WHERE digest = ?1 AND key = ?2",
            *(digest, key),
        )
        return bool(held)

    def is_public(self, digest: str) -> bool:
        """Whether a file is a document, or belongs to a reference row or a scored submission.

        Others are not published: who could download a policy that waits to be scored could submit
        it under another key, as if it were the first.
        """
        published = self.query(
            "SELECT 1 FROM artefact JOIN entry ON id = submission "
            "WHERE digest = ?1 AND (reference OR scores IS NOT NULL) UNION SELECT 1 FROM object "
            "WHERE digest = ?1 AND digest NOT IN (SELECT digest FROM artefact)",
            digest,
        )
        return bool(published)

    def named_objects(self) -> list[str]:
        """The digests of all documents and policy files that logged documents name."""
        return [digest for (digest,) in self.query("SELECT digest FROM object ORDER BY digest")]

    def submission_times(self, key: str, since: str) -> list[str]:
        """When each entrant of a key, of any track, was received after a time, in order."""
        after = "SELECT received FROM entry WHERE key = ? AND received > ? ORDER BY received"
        return [time for (time,) in self.query(after, key, since)]

    def holder_of_name(self, name: str) -> str | None:
        """The key that was first to use a submitter's name, in whatever case.

        A name is used by an entrant of any track that waits for its scores, or has had scores of
        at least one policy: otherwise, policies that are rejected would be enough to occupy names.
        """
        rows = self.query(
            "SELECT key FROM entry WHERE lower(submitter) = lower(?) AND "
            "(status = 'waiting' OR (scores IS NOT NULL AND policies > 0)) "
            "ORDER BY sequence LIMIT 1",
            name,
        )
        return rows[0][0] if rows else None

    def uploaded_bytes(self, key: str, since: str) -> int:
        """Bytes that a key has sent, or caused as results, after a time as documents write it."""
        [(size,)] = self.query(
            "SELECT coalesce(sum(size), 0) FROM ("
            "SELECT size FROM object WHERE key = ?1 AND received > ?2 UNION ALL "
            "SELECT size FROM upload WHERE key = ?1 AND time > ?2 UNION ALL "
            "SELECT size FROM spent WHERE key = ?1 AND time > ?2)",
            *(key, since),
        )
        return int(size)

    def total_bytes(self) -> int:
        """Bytes of all files; running tickets count with the most that they can take."""
        [(size,)] = self.query(
            "SELECT coalesce(sum(size), 0) + (SELECT coalesce(sum(reserved), 0) FROM entry) "
            "FROM (SELECT digest, size FROM object UNION SELECT digest, size FROM upload)"
        )
        return int(size)


def unknown_submission(id: str) -> Rejection:
    """The rejection of an id that no submission on the board has."""
    return Rejection(
        "unknown_submission",
        f"submission={id[:80]}: is not on this board. Check the id: 'sha256:' and 64 hex digits.",
    )
