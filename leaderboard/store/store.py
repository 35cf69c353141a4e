"""`Store`: one board's folder, for any number of processes and threads at once.

A write takes the board's turn, writes its documents' files, then the log entry, then the index's
rows. Killed before the log entry, nothing has happened; killed after it, the next process to come
takes the entry into the index.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import os
import sqlite3
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, Self

from leaderboard.documents.board import BoardDocument, Folder
from leaderboard.documents.checks import refuse_unsubmittable
from leaderboard.documents.keys import SigningKey, verifies
from leaderboard.documents.result import Result
from leaderboard.documents.submission import SignedSubmission, SignedWithdrawal, now, utc
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store import files
from leaderboard.store.documents import digest_of, read_document, write_document
from leaderboard.store.index import BUSY_SECONDS, EntryRow, Index, IndexUnusable
from leaderboard.store.log import EMPTY, Event, Head, Log, LogEntry
from leaderboard.store.objects import Objects
from sme_registry.errors import UnknownNameError
from sme_registry.io import TEMPORARY, temporary_beside
from sme_registry.spec import EvaluationProtocol, StrictModel, Suite

LEASE_SECONDS = 60.0
ATTEMPTS = 5


@dataclass(frozen=True)
class Claim:
    """The right to write one submission's result, as long as nobody else has claimed it since.

    Attributes:
      id: the submission's.
      worker: who claims.
      attempt: how often it has been claimed, this time included.
      seconds: how long the claim holds without a heartbeat.
    """

    id: str
    worker: str
    attempt: int
    seconds: float


@dataclass(frozen=True)
class Garbage:
    """What `gc` removed, or would remove.

    Attributes:
      temporary: files that dead processes left half-written.
      objects: artefacts that no submission names.
      bytes: of all of them.
    """

    temporary: int
    objects: int
    bytes: int

    @property
    def files(self) -> int:
        """Of both kinds."""
        return self.temporary + self.objects


class Store:
    """A board's folder; made by `create` or `open`, and a context manager.

    Attributes:
      folder: its paths.
      document: what the board is of.
      read_only: whether it was opened so.
    """

    def __init__(self, path: str | Path, *, read_only: bool) -> None:
        self.folder = Folder(path)
        self.document: BoardDocument = self.folder.read()
        self.read_only = read_only
        self._log = Log(self.folder, self.document.key)
        self._objects = Objects(self.folder)
        self._thread = threading.RLock()
        self._in_turn = False
        self._key: SigningKey | None = None
        self._index: Index | None = None
        self._inode = (0, 0)
        if not self._log.has(0):
            raise TamperedError("log/00000000.json", "is missing: a board begins with it")
        # Locked is the log's folder, which is never replaced, as the index may be.
        self._lock = os.open(self.folder.log, os.O_RDONLY | os.O_DIRECTORY)

    @classmethod
    def create(
        cls,
        path: str | Path,
        *,
        title: str,
        suite_name: str,
        suite: Suite,
        protocol_name: str,
        protocol: EvaluationProtocol,
        **fields: Any,
    ) -> Store:
        """Make a board, with a key of its own, in a new folder.

        Args:
          path: a folder that does not exist yet, or is empty.
          title, suite_name, suite, protocol_name, protocol, fields: of `BoardDocument`.

        Returns:
          The board's store, opened for writing.

        Raises:
          BoardError: the folder is in use or cannot be made, or the suite cannot be of a board.
          SpecError: a field is wrong.
        """
        key = SigningKey.generate()
        document = BoardDocument.from_dict(
            {
                "title": title,
                "suite_name": suite_name,
                "suite": suite,
                "protocol_name": protocol_name,
                "protocol": protocol,
                "key": key.public,
                **fields,
            }
        )
        if any(spec.team is not None for spec in suite.instances):
            raise BoardError(
                f"suite={suite_name}: has teams: a board is of single agents. Choose another suite."
            )
        if len(document.instances) != len(suite.instances):
            raise BoardError(
                f"suite={suite_name}: two classes share an instance. Change one of their seeds."
            )
        refuse_unsubmittable(document)
        path = Path(path)
        # Made beside and renamed, so that no folder ever holds half a board.
        making = Folder(temporary_beside(path.absolute()))
        try:
            for folder in (making.log, making.submissions, making.withdrawals, making.results):
                files.make_folder(folder)
            files.make_folder(making.objects)
            key.write(making.key)
            write_document(making.board, document, new=True)
            Log(making, key.public).append(
                key, EMPTY, "opened", document.digest, digest_of(document)
            )
            files.sync_folder(making.path)
            os.rename(making.path, path)
            files.sync_folder(path.absolute().parent)
        except OSError as error:
            raise BoardError(
                f"{path}: no board can be made here: {error.strerror}. Give a new folder."
            ) from None
        finally:
            if making.path.exists():
                _remove_tree(making.path)
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path, *, read_only: bool = False, reindex: bool = False) -> Store:
        """Open a board; its index is brought up to date, or made anew where it is of no use.

        Args:
          path: the board's folder.
          read_only: write nothing, not even the index, which is then held in memory.
          reindex: make the index anew, without a look at what an old one remembers of the log.

        Raises:
          BoardError: there is no board, or the index cannot be written.
          TamperedError: log, documents and index do not agree; has the first altered row.
        """
        store = cls(path, read_only=read_only)
        try:
            if not read_only and not os.access(store.folder.path, os.W_OK):
                raise BoardError(
                    f"{path}: cannot be written to. Get the right to write, or open it read-only."
                )
            with store._thread, store._locked(exclusive=not read_only):
                store._open_index(anew=reindex)
            try:
                store._refresh()
            except TamperedError:
                # If it was the index that lied, one made anew does not; else this raises too.
                with store._thread, store._locked(exclusive=not read_only):
                    store._open_index(anew=True)
                store._refresh()
            if not read_only:
                store._sweep()
        except BaseException:
            store.close()
            raise
        return store

    def close(self) -> None:
        """Give everything back; closing twice does nothing."""
        with self._thread:
            if self._lock < 0:
                return
            if self._index is not None:
                # Closing the last connection empties SQLite's log of writes into the database.
                with self._locked(exclusive=not self.read_only):
                    self._index.close()
                self._index = None
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Objects.

    def put_object(self, digest: str, chunks: Iterable[bytes], *, by: str) -> bool:
        """Take an artefact, of the board's size limit, as its bytes come.

        Args:
          digest: what its bytes must have.
          chunks: the bytes; not read where the artefact is there already.
          by: the public key of who uploads it, for the quotas.

        Returns:
          True if it is new.

        Raises:
          Rejection: `too_large` or `artefact_digest`.
          BoardError: it cannot be written, or the board's key is not here.
        """
        self._refuse_read_only()
        self._signing_key()  # or no submission could follow, and the artefact would be left over
        size = 0

        def counted() -> Iterator[bytes]:
            nonlocal size
            for chunk in chunks:
                size += len(chunk)
                yield chunk

        if not self._objects.put(digest, counted(), self.document.limits.artefact_bytes):
            return False
        with self.turn() as index:
            if index.one("SELECT 1 FROM object WHERE digest = ?", digest) is None:
                index.connection.execute(
                    "INSERT OR IGNORE INTO upload VALUES (?, ?, ?, ?)", (digest, size, by, now())
                )
        return True

    def has_object(self, digest: str) -> bool:
        """Whether the artefact of this digest is there."""
        return self._objects.has(digest)

    def object_bytes(self, digest: str) -> bytes:
        """An artefact's bytes, hashed anew.

        Raises:
          BoardError: it is not there.
          TamperedError: its bytes have another digest.
        """
        return self._objects.read(digest)

    # Submissions.

    def receive(self, signed: SignedSubmission) -> bool:
        """Take a submission, which waits from then on; `intake` has checked it.

        Returns:
          False if it is known already: the same submission twice is one row.

        Raises:
          BoardError: it cannot be written.
        """
        with self.turn() as index:
            if index.status(signed.id) is not None:
                return False
            self._record("received", signed.id, self.folder.submission(signed.id), signed)
        return True

    def withdraw(self, signed: SignedWithdrawal) -> bool:
        """Take a submission off the board; its page stays, marked so.

        Returns:
          False if it was withdrawn already.

        Raises:
          UnknownNameError: there is no such submission.
          Rejection: `bad_signature`, where it is not signed by the submission's own key.
          BoardError: it cannot be written.
        """
        withdrawal = signed.withdrawal
        with self.turn() as index:
            row = index.one("SELECT key FROM entry WHERE id = ?", withdrawal.submission)
            if row is None:
                self._unknown(withdrawal.submission)
            if not verifies(row[0], signed.signature, "withdrawal", withdrawal.digest):
                raise Rejection(
                    "bad_signature",
                    f"signature={signed.signature[:16]}…: is not of this withdrawal by the key "
                    f"{row[0][:16]}…. Sign it with the key that signed the submission.",
                )
            if index.status(withdrawal.submission) == "withdrawn":
                return False
            path = self.folder.withdrawal(withdrawal.submission)
            self._record("withdrawn", withdrawal.submission, path, signed)
        return True

    def submission(self, id: str) -> SignedSubmission:
        """A submission as it was signed.

        Raises:
          UnknownNameError: there is no such submission.
          TamperedError: its file is not what the log names.
        """
        row = self._one("SELECT document FROM entry WHERE id = ?", id)
        if row is None:
            self._unknown(id)
        return read_document(self.folder, self.folder.submission(id), SignedSubmission, row[0])

    def result(self, id: str) -> Result | None:
        """What scoring found; None where there is none yet, or no such submission.

        Raises:
          TamperedError: its file is not what the log names.
        """
        row = self._one("SELECT result FROM entry WHERE id = ? AND result IS NOT NULL", id)
        if row is None:
            return None
        return read_document(self.folder, self.folder.result(id), Result, row[0])

    def withdrawal(self, id: str) -> SignedWithdrawal | None:
        """What took a submission off the board; None where nothing did.

        Raises:
          TamperedError: its file is not what the log names.
        """
        row = self._one("SELECT withdrawal FROM entry WHERE id = ? AND withdrawal IS NOT NULL", id)
        if row is None:
            return None
        return read_document(self.folder, self.folder.withdrawal(id), SignedWithdrawal, row[0])

    def entries(self) -> list[EntryRow]:
        """Every submission, in the order in which they came."""
        with self._reading() as index:
            return index.entries()

    def entry(self, id: str) -> EntryRow | None:
        """One submission; None where there is no such submission."""
        with self._reading() as index:
            return index.entry(id)

    # The queue.

    def claim(self, worker: str, *, seconds: float = LEASE_SECONDS) -> Claim | None:
        """The oldest submission that waits and that nobody is at.

        A claim holds for `seconds` of the machine's running time, whatever is done to its clock;
        `heartbeat` renews it. A submission whose claims were lost five times is rejected with
        `scoring_failed`, but never a reference row: it is the machine that failed, and without
        the row the board would show nothing for good.

        Args:
          worker: who claims; no two at once may have the same name.
          seconds: how long it holds without a heartbeat.

        Returns:
          The claim; None where there is nothing to do now.

        Raises:
          BoardError: the index cannot be written.
        """
        with self.turn() as index:
            while True:
                row = index.one(
                    "SELECT id, reference, coalesce(attempt, 0), "
                    "coalesce(lost, 0) + (worker IS NOT NULL) "
                    "FROM entry LEFT JOIN lease ON submission = id WHERE status = 'waiting' "
                    "AND (submission IS NULL OR boot <> ? OR expires <= ?) "
                    "ORDER BY sequence LIMIT 1",
                    *_running_time(),
                )
                if row is None:
                    return None
                id, reference, attempts, lost = row
                if lost >= ATTEMPTS and not reference:
                    self._finish(self._given_up(id))
                    continue
                boot, at = _running_time()
                index.connection.execute(
                    "REPLACE INTO lease VALUES (?, ?, ?, ?, ?, ?)",
                    (id, worker, attempts + 1, lost, boot, at + seconds),
                )
                return Claim(id, worker, attempts + 1, seconds)

    def heartbeat(self, claim: Claim) -> bool:
        """Renew a claim.

        Returns:
          False if it is lost: somebody else has claimed, finished or withdrawn the submission.
        """
        boot, at = _running_time()
        with self.turn() as index:
            return self._renew(index, claim, boot, at + claim.seconds)

    def release(self, claim: Claim) -> None:
        """Give a claim back for reasons outside the submission; it does not count as lost."""
        with self.turn() as index:
            if self._is_current(index, claim):
                index.connection.execute(
                    "UPDATE lease SET worker = NULL, expires = 0 WHERE submission = ?", (claim.id,)
                )

    def abandon(self, worker: str) -> None:
        """Declare a worker dead: what it had claimed is lost, and can be claimed at once."""
        with self.turn() as index:
            index.connection.execute("UPDATE lease SET expires = 0 WHERE worker = ?", (worker,))

    def finish(self, claim: Claim, result: Result) -> bool:
        """Write a result, unless somebody else has claimed the submission since.

        Returns:
          False if the claim is no longer the current one; nothing is written then.

        Raises:
          ValueError: the result is of another submission, suite or protocol.
          BoardError: it cannot be written.
        """
        document = self.document
        of = (result.submission, result.suite, result.protocol)
        if of != (claim.id, document.suite.digest, document.protocol.digest):
            raise ValueError(f"a result of {of} for the claim {claim}")
        with self.turn() as index:
            if not self._is_current(index, claim):
                return False
            self._finish(result)
        return True

    def waiting(self) -> int:
        """How many submissions have neither a result nor a withdrawal."""
        return self._count("SELECT count(*) FROM entry WHERE status = 'waiting'")

    def done(self) -> int:
        """How many submissions have a result or a withdrawal."""
        return self._count("SELECT count(*) FROM entry WHERE status <> 'waiting'")

    def given_up(self) -> int:
        """How many were rejected because scorers were lost over them."""
        return self._count("SELECT count(*) FROM entry WHERE code = 'scoring_failed'")

    def claimable(self) -> int:
        """How many of the waiting ones nobody is at."""
        return self._count(
            "SELECT count(*) FROM entry LEFT JOIN lease ON submission = id "
            "WHERE status = 'waiting' AND (submission IS NULL OR boot <> ? OR expires <= ?)",
            *_running_time(),
        )

    # The log.

    @property
    def head(self) -> Head:
        """The last log entry: its number, digest and time."""
        with self._reading() as index:
            return index.head

    def log(self, start: int = 0, count: int = 100) -> list[LogEntry]:
        """Log entries, at most `count` from number `start` on.

        Raises:
          TamperedError: one is altered.
        """
        last = self.head.sequence
        return [
            self._log.read(sequence)
            for sequence in range(max(start, 0), min(start + count, last + 1))
        ]

    # For the quotas.

    def uploads(self, by: str, since: str) -> int:
        """Bytes of the artefacts that a key has brought since a time, such as `now()` gives."""
        return self._count(
            "SELECT (SELECT coalesce(sum(size), 0) FROM object WHERE key = ?1 AND received >= ?2)"
            " + (SELECT coalesce(sum(size), 0) FROM upload WHERE key = ?1 AND time >= ?2)",
            by,
            since,
        )

    def submissions_of(self, key: str, since: str) -> list[str]:
        """When the submissions of a key were received, from a time on, in order."""
        with self._reading() as index:
            return [
                received
                for (received,) in index.connection.execute(
                    "SELECT received FROM entry WHERE key = ? AND received >= ? ORDER BY received",
                    (key, since),
                )
            ]

    def total_bytes(self) -> int:
        """Bytes of all artefacts."""
        return self._count(
            "SELECT (SELECT coalesce(sum(size), 0) FROM object)"
            " + (SELECT coalesce(sum(size), 0) FROM upload)"
        )

    # Upkeep.

    def reindex(self) -> None:
        """Make the index anew from log and documents, whatever state it is in.

        Raises:
          TamperedError: log and documents do not agree.
          BoardError: it cannot be written.
        """
        self._refuse_read_only()
        with self._thread, self._locked(exclusive=True):
            self._rebuild()

    def gc(
        self,
        *,
        temporary_older_than: float = 3600.0,
        objects_older_than: float = 86400.0,
        dry_run: bool = False,
    ) -> Garbage:
        """Remove half-written files of dead processes and artefacts that no submission names.

        Args:
          temporary_older_than: seconds since a temporary file was last written to: one that is
            young may be an upload in flight.
          objects_older_than: seconds since an artefact was uploaded: the submission may be on its
            way.
          dry_run: only count.

        Raises:
          BoardError: something cannot be removed.
        """
        at = time.time()
        with self.turn() as index:
            temporary = [
                path
                for path in self.folder.path.rglob(TEMPORARY)
                if path.is_file() and path.stat().st_mtime <= at - temporary_older_than
            ]
            objects = [
                (digest, path)
                for digest, path in self._objects.paths()
                if path.stat().st_mtime <= at - objects_older_than
                and index.one("SELECT 1 FROM object WHERE digest = ?", digest) is None
            ]
            found = [*temporary, *(path for _, path in objects)]
            size = sum(path.stat().st_size for path in found)
            if not dry_run:
                for path in found:
                    try:
                        path.unlink()
                    except OSError as error:
                        raise files.unwritable(path, error) from error
                for digest, _ in objects:
                    index.connection.execute("DELETE FROM upload WHERE digest = ?", (digest,))
        return Garbage(len(temporary), len(objects), size)

    @contextlib.contextmanager
    def turn(self) -> Iterator[Index]:
        """The board's one turn to write: every other process and thread waits. Nests.

        Several calls inside one turn (a quota asked for, then `receive`) see no change between.

        Yields:
          The index, up to date.

        Raises:
          BoardError: the board was opened read-only, or is busy for a minute, or SQLite fails.
        """
        self._refuse_read_only()
        with self._thread:
            if self._in_turn:
                yield self._opened
                return
            with self._locked(exclusive=True), self._sqlite_explained():
                if self._replaced():
                    self._open_index()
                index = self._opened
                with index.transaction():
                    self._catch_up(index)
                    self._in_turn = True
                    try:
                        yield index
                    finally:
                        self._in_turn = False

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """No process writes while the block runs, which has to be short."""
        with self._thread, self._locked(exclusive=not self.read_only):
            yield

    @property
    def _opened(self) -> Index:
        if self._index is None:
            raise BoardError(f"{self.folder.path}: the store is closed. Open it again.")
        return self._index

    @contextlib.contextmanager
    def _reading(self) -> Iterator[Index]:
        with self._thread, self._sqlite_explained():
            if not self._in_turn:
                self._refresh()
            yield self._opened

    def _refresh(self) -> None:
        """Take in what others have written since: seen by two looks at the file system."""
        index = self._opened
        if self.read_only:
            self._catch_up(index)
        elif self._replaced() or self._log.has(index.head.sequence + 1):
            with self.turn():
                pass

    def _catch_up(self, index: Index) -> None:
        head = index.head
        while self._log.has(head.sequence + 1):
            entry = self._log.read_after(head)
            index.apply(entry)
            head = entry.head

    def _record(self, event: Event, subject: str, path: Path, document: StrictModel) -> None:
        """What every write is, in a turn: the document's file, the log entry, the rows."""
        key = self._signing_key()
        index = self._opened
        write_document(path, document)
        entry = self._log.append(key, index.head, event, subject, digest_of(document))
        index.apply(entry)

    def _signing_key(self) -> SigningKey:
        if self._key is None:
            if not self.folder.key.exists():
                raise BoardError(
                    f"{self.folder.path}: this board's key is not here, so it takes nothing in. "
                    f"Copy it with its {self.folder.key.name} from where it is kept, or make a "
                    "board of your own with `sme-leaderboard init`."
                )
            key = self.folder.signing_key()
            if key.public != self.document.key:
                raise BoardError(
                    f"{self.folder.key}: is not the key that board.json names, "
                    f"{self.document.key[:16]}…. Restore that one."
                )
            self._key = key
        return self._key

    def _finish(self, result: Result) -> None:
        self._record("result", result.submission, self.folder.result(result.submission), result)

    def _given_up(self, id: str) -> Result:
        return Result(
            submission=id,
            suite=self.document.suite.digest,
            protocol=self.document.protocol.digest,
            status="rejected",
            code="scoring_failed",
            message=f"the scorer was lost {ATTEMPTS} times while it was at this submission. "
            "Try it at home with `sme-leaderboard check`, then tell the board's owner.",
        )

    @staticmethod
    def _is_current(index: Index, claim: Claim) -> bool:
        return (
            index.one(
                "SELECT 1 FROM lease WHERE submission = ? AND worker = ? AND attempt = ?",
                *(claim.id, claim.worker, claim.attempt),
            )
            is not None
        )

    def _renew(self, index: Index, claim: Claim, boot: str, expires: float) -> bool:
        if not self._is_current(index, claim):
            return False
        index.connection.execute(
            "UPDATE lease SET boot = ?, expires = ? WHERE submission = ?",
            (boot, expires, claim.id),
        )
        return True

    def _open_index(self, *, anew: bool = False) -> None:
        """Connect to the index, made anew if need be; the board is locked meanwhile.

        Locked, because a connection that opened a database just as it is replaced could find
        the other one's log of writes beside it.
        """
        old, self._index = self._index, None
        if old is not None:
            old.close()
        existing = Index.snapshot if self.read_only else Index.open
        if not anew:
            with contextlib.suppress(IndexUnusable):
                self._index = existing(self.folder.index, self.folder, self.document)
        if self._index is not None:
            self._inode = _inode(self.folder.index)
            self._refuse_lost_log(self._index.head)
        elif self.read_only:
            self._index = Index.empty(None, self.folder, self.document)
        else:
            self._rebuild()

    def _refuse_lost_log(self, head: Head) -> None:
        """The index never runs ahead of the log, so what it remembers has to be there still."""
        if head == EMPTY:
            return
        where = f"log/{head.sequence:08d}.json"
        advice = "Restore the log, or accept it as it is with `sme-leaderboard reindex`"
        if not self._log.has(head.sequence):
            raise TamperedError(where, f"is missing, but was there once. {advice}")
        if self._log.read(head.sequence).digest != head.digest:
            raise TamperedError(where, f"was exchanged for another entry. {advice}")

    def _rebuild(self) -> None:
        """A new index from the log, put in the old one's place; the board is locked meanwhile."""
        path = self.folder.index
        making = temporary_beside(path)
        with self._sqlite_explained():
            try:
                index = Index.empty(making, self.folder, self.document)
                try:
                    with index.transaction():
                        self._catch_up(index)
                        self._find_uploads(index)
                    index.connection.execute("PRAGMA journal_mode = WAL")
                finally:
                    index.close()
                os.chmod(making, 0o644)
                if self._index is not None:
                    self._index.close()
                    self._index = None
                # In this order: a database must never be found beside another's log of writes.
                for suffix in ("", "-wal", "-shm"):
                    path.with_name(path.name + suffix).unlink(missing_ok=True)
                os.replace(making, path)
                files.sync_folder(path.parent)
            except OSError as error:
                raise files.unwritable(path, error) from error
            finally:
                for suffix in ("", "-journal", "-wal", "-shm"):
                    with contextlib.suppress(OSError):  # there is none, or the disk is read-only
                        making.with_name(making.name + suffix).unlink()
        try:
            self._index = Index.open(path, self.folder, self.document)
        except IndexUnusable as error:
            raise BoardError(
                f"{path}: {error} as soon as it was made. Look what removes it, and try again."
            ) from None
        self._inode = _inode(path)

    def _find_uploads(self, index: Index) -> None:
        """Artefacts that no submission names, by nobody known, so that their bytes count."""
        for digest, path in self._objects.paths():
            if index.one("SELECT 1 FROM object WHERE digest = ?", digest) is None:
                stat = path.stat()
                time_ = utc(datetime.datetime.fromtimestamp(stat.st_mtime, datetime.UTC))
                index.connection.execute(
                    "INSERT INTO upload VALUES (?, ?, '', ?)", (digest, stat.st_size, time_)
                )

    def _sweep(self) -> None:
        """Remove results that are in no log entry: of a process killed between the two."""
        if not self.folder.results.is_dir():
            return
        with self.turn() as index:
            for path in self.folder.results.glob("[!.]*.json"):
                logged = index.one(
                    "SELECT 1 FROM entry WHERE id = ? AND result IS NOT NULL", f"sha256:{path.stem}"
                )
                if logged is None:
                    path.unlink()

    def _replaced(self) -> bool:
        """Whether the index's file was deleted, or made anew by another process."""
        return _inode(self.folder.index) != self._inode

    @contextlib.contextmanager
    def _locked(self, *, exclusive: bool) -> Iterator[None]:
        """The board's lock between processes; a dead one's is free at once."""
        if self._lock < 0:
            raise BoardError(f"{self.folder.path}: the store is closed. Open it again.")
        kind = fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH
        give_up = time.monotonic() + BUSY_SECONDS
        while True:
            try:
                fcntl.flock(self._lock, kind | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > give_up:
                    raise BoardError(
                        f"{self.folder.path}: another process has held the board for "
                        f"{BUSY_SECONDS:.0f} s. Look what hangs, and try again."
                    ) from None
                time.sleep(0.002)
        try:
            yield
        finally:
            fcntl.flock(self._lock, fcntl.LOCK_UN)

    @contextlib.contextmanager
    def _sqlite_explained(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise BoardError(
                f"{self.folder.index}: {error}. Make room or give the right to write where that "
                "is missing; else remove this file, which is made anew from the log."
            ) from error

    def _one(self, statement: str, *values: Any) -> tuple[Any, ...] | None:
        with self._reading() as index:
            return index.one(statement, *values)

    def _count(self, statement: str, *values: Any) -> int:
        row = self._one(statement, *values)
        assert row is not None  # an aggregate has one row
        return int(row[0])

    def _refuse_read_only(self) -> None:
        if self.read_only:
            raise BoardError(f"{self.folder.path}: opened read-only. Open it for writing.")

    @staticmethod
    def _unknown(id: str) -> NoReturn:
        raise UnknownNameError(
            f"submission={id[:80]!r}: no submission of this board has this id. "
            "Ids are 'sha256:' and 64 hex digits; `sme-leaderboard rank` lists them."
        )


def _running_time() -> tuple[str, float]:
    """The machine's boot, and seconds since: no setting of the clock moves them."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
    return (boot.read_text().strip() if boot.exists() else ""), time.clock_gettime(clock)


def _inode(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except OSError:
        return (0, 0)
    return stat.st_dev, stat.st_ino


def _remove_tree(path: Path) -> None:
    for inner in sorted(path.rglob("*"), reverse=True):
        inner.rmdir() if inner.is_dir() else inner.unlink()
    path.rmdir()
