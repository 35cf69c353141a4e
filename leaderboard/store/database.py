"""`Database`: a board's signed log and its SQLite index in step, for many processes and threads.

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
from typing import ClassVar, Self

from leaderboard.documents.board import RULES, BoardDocument, Folder
from leaderboard.documents.signed import SigningKey
from leaderboard.documents.submission import now
from leaderboard.errors import BoardError, TamperedError
from leaderboard.store.blobs import FolderLock, Objects, digest_of, unwritable
from leaderboard.store.index import KINDS, Index, Kinds, files_of
from leaderboard.store.log import EMPTY, Clock, Head, Log, clock_offset, uptime
from sme_registry.spec.document import StrictModel


class Database:
    """The log and its index; a context manager, which `connect` opens.

    Args:
      path: the board's folder.
      read_only: write nothing, and read nothing but log and documents: the index, which is then
        held in memory, is built from them.

    Attributes:
      kinds: of the log's entries, which those of further tracks extend.
    """

    kinds: ClassVar[Kinds] = KINDS

    def __init__(self, path: str | Path, *, read_only: bool) -> None:
        self.folder = Folder(path)
        self.document: BoardDocument = self.folder.read()
        self.read_only = read_only
        self.objects = Objects(self.folder, by_kind=self.document.rules == 2)
        self.clock = Clock()
        self._log = Log(self.folder, self.document.key)
        self._thread_lock = threading.RLock()
        self._in_transaction = False
        self._progress: Callable[[int], None] | None = None
        self._key: SigningKey | None = None
        self._index: Index | None = None
        if not self._log.has(0):
            raise TamperedError("log/00000000.json", "is missing; every log starts with it")
        self._lock = FolderLock(self.folder.log)

    def connect(self, *, reindex: bool, progress: Callable[[int], None] | None = None) -> None:
        """Connect to the index and bring it up to date; rebuild it if it is unusable.

        Args:
          reindex: rebuild the index and ignore what the old one recorded of the log.
          progress: called with the number of each log entry that is read.
        """
        self._progress = progress
        if not self.read_only and not os.access(self.folder.path, os.W_OK):
            raise BoardError(
                f"{self.folder.path}: is not writable. Get write permission, or open the board "
                "read-only."
            )
        with self.locked():
            # Without the key, nothing was ever written here: the index is somebody else's.
            self._connect(rebuild=reindex or not self.folder.key.is_file())
        try:
            self._refresh()
        except TamperedError:  # passes with a rebuilt index if only the index was altered
            if self.read_only:
                raise
            with self.locked():
                self._connect(rebuild=True)
            self._refresh()
        self._progress = None

    def close(self) -> None:
        """Close the index and the lock; closing twice does nothing."""
        with self._thread_lock:
            if self._index is not None:
                # Closing the last connection moves SQLite's write-ahead log into the database.
                with self.locked():
                    self._index.close()
                self._index = None
            self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Block all writers for a short while; a writable store also blocks all readers."""
        with self._thread_lock, self._lock.hold(exclusive=not self.read_only):
            yield

    @contextlib.contextmanager
    def transaction(self) -> Iterator[Index]:
        """Write to the board while every other process and thread waits. Nests.

        Several calls inside one block (check a quota, then `receive`) see no change in between.

        Yields:
          The index, up to date.
        """
        self.refuse_read_only()
        with self._thread_lock:
            if self._in_transaction:
                yield self._connected
                return
            with self._lock.hold(exclusive=True), self._explained():
                index = self._connected
                with index.transaction():
                    self._catch_up(index)
                    self._follow_clock(index)
                    self._in_transaction = True
                    try:
                        yield index
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

    def record(self, event: str, subject: str, document: StrictModel) -> None:
        """Log a document, which must be allowed now; call it in a transaction.

        Raises:
          Rejection: it is not allowed, and nothing was written.
        """
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
        """Note how the machine's clock stands, once after each start of the machine, or anew.

        From then on, nothing is written if it jumps.
        """
        with self.transaction() as index:
            row = clock_offset()
            if anew or index.one("SELECT 1 FROM clock WHERE boot = ?", row[0]) is None:
                index.connection.execute("DELETE FROM clock")
                index.connection.execute("INSERT INTO clock VALUES (?, ?)", row)
            self._follow_clock(index)

    def correct_clock(self) -> int:
        """Date all entries of the log that are dated later than now as of now.

        Returns:
          The number of the first of them; 0 if there is none.
        """
        key = self.signing_key()
        with self.transaction() as index:
            time = now()
            first = self._log.first_after(index.head, time)
            if first is None:
                return 0
            subject, document = first.digest, digest_of(first)
            entry = self._log.entry(key, index.head, "clock", subject, document, time)
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
        with self.locked():
            self._connect(rebuild=True)

    @property
    def _connected(self) -> Index:
        if self._index is None:
            raise BoardError(f"{self.folder.path}: the store is closed. Open it again.")
        return self._index

    def _refresh(self) -> None:
        """Apply what other processes have logged; a look at one file shows whether they have."""
        index = self._connected
        if self.read_only:
            if self._log.has(index.head.sequence + 1):
                with index.transaction():
                    self._catch_up(index)
        elif self._log.has(index.head.sequence + 1):
            with self.transaction():
                pass

    def _catch_up(self, index: Index) -> None:
        head = index.head
        while self._log.has(head.sequence + 1):
            entry = self._log.read_after(head)
            index.apply(entry)
            head = entry.head
            if self._progress is not None:
                self._progress(head.sequence)

    def _connect(self, *, rebuild: bool) -> None:
        """Connect to the index, rebuilt in place if necessary, while the board is locked."""
        if self.read_only:
            self._index = Index.empty(self.folder, self.document, self.kinds)
            return
        if self._index is None:
            self._index = self._opened()
        with self._explained():
            if not rebuild and self._index.is_current:
                self._refuse_lost_log(self._index.head)
                return
            with self._index.transaction():
                uploads = self._index.uploads() if self._index.is_current else []
                self._index.clear()
                self._catch_up(self._index)
                self._index.add_uploads(uploads)

    def _opened(self) -> Index:
        """The index, in a new file if the old one is unusable."""
        path = self.folder.index
        with contextlib.suppress(sqlite3.Error, OSError):
            return Index.open(self.folder, self.document, self.kinds)
        try:
            for each in files_of(path):
                each.unlink(missing_ok=True)
            with self._explained():
                return Index.open(self.folder, self.document, self.kinds)
        except OSError as error:
            raise unwritable(path, error) from error

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
