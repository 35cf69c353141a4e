"""`Store`: one board's folder, for any number of processes and threads at once."""

from __future__ import annotations

import datetime
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from leaderboard.documents.board import (
    RULES,
    BoardDocument,
    Folder,
    check_receiver,
    refuse_unsubmittable,
)
from leaderboard.documents.result import Result
from leaderboard.documents.signed import Signed, SigningKey
from leaderboard.documents.submission import Submission, Withdrawal, check_text, now, shifted, utc
from leaderboard.errors import BoardError, Rejection
from leaderboard.store.blobs import digest_of, unwritable, write_document
from leaderboard.store.database import Database
from leaderboard.store.log import EMPTY, Head, Log, LogEntry
from leaderboard.store.queue import Queue
from leaderboard.store.rows import EntryRow
from sme_registry.io import TEMPORARY, build_folder
from sme_registry.spec import EvaluationProtocol, Suite
from sme_registry.spec.document import StrictModel

_Model = TypeVar("_Model", bound=StrictModel)


class Store(Database):
    """A board's folder, opened by `create` or `open`; a context manager.

    Attributes:
      folder: its paths.
      document: the board's document.
      read_only: whether it was opened read-only.
      objects: the artefacts; `put_object` adds one.
      queue: the submissions that wait to be scored.
    """

    def __init__(self, path: str | Path, *, read_only: bool) -> None:
        super().__init__(path, read_only=read_only)
        self.queue = Queue(self)

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
    ) -> Self:
        """Create a board with its own key in a new folder.

        Args:
          path: a folder that does not exist or is empty.
          title, suite_name, suite, protocol_name, protocol, fields: of `BoardDocument`.

        Returns:
          The board's store, opened for writing.

        Raises:
          SpecError: a field is invalid.
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
                "rules": RULES,
                **fields,
            }
        )
        _refuse_unfit(document)
        path = Path(path)
        is_empty = path.is_dir() and not any(path.iterdir())
        if os.path.lexists(path) and not is_empty:
            raise BoardError(f"{path}: already exists. Choose a new folder for the board.")
        with build_folder(path, force=is_empty) as building:
            _write_board(Folder(building), document, key)
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

        Args:
          path: the board's folder.
          read_only: write nothing, and read nothing but log and documents: the index, which is
            then held in memory, is built from them. For copies of boards, whose index may lie.
          reindex: rebuild the index and ignore what the old one recorded of the log.
          progress: called with the number of each log entry that is read.
        """
        store = cls(path, read_only=read_only)
        try:
            store.connect(reindex=reindex, progress=progress)
        except BaseException:
            store.close()
            raise
        return store

    def put_object(self, digest: str, chunks: Iterable[bytes], *, by: str) -> bool:
        """Store an artefact while its bytes arrive, up to the board's size limit.

        The bytes are read and verified even if the board has them: they show that the uploader has
        the artefact, too, and not only its digest. See `possesses`.

        Args:
          digest: the artefact's expected digest.
          chunks: the bytes.
          by: the uploader's public key, for the quotas and `possesses`.

        Returns:
          True if this key has neither uploaded nor submitted it before.

        Raises:
          Rejection: `too_large` or `artefact_digest`.
        """
        self.refuse_read_only()
        self.signing_key()  # without it no submission could follow
        with self.transaction():  # so that `gc` does not remove it while its bytes arrive
            self.objects.touch(digest)
        size = self.objects.put(digest, chunks, self.document.limits.artefact_bytes)
        with self.transaction() as index:
            if not self.objects.touch(digest):
                raise BoardError(f"artefact={digest}: was removed meanwhile. Upload it again.")
            time, execute = self.clock.received(), index.connection.execute
            renewed = "UPDATE upload SET time = ? WHERE digest = ? AND key = ?"
            if execute(renewed, (time, digest, by)).rowcount or self.possesses(by, digest):
                return False
            execute("INSERT INTO upload VALUES (?, ?, ?, ?)", (digest, size, by, time))
        return True

    def possesses(self, key: str, digest: str) -> bool:
        """Whether a key has uploaded an artefact, and so has its bytes.

        A submission may name only these: digests are public before the artefacts are.
        """
        with self.reading() as index:
            return (
                index.one(
                    "SELECT 1 FROM upload WHERE digest = ?1 AND key = ?2 UNION "
                    "SELECT 1 FROM artefact JOIN entry ON id = submission "
                    "WHERE digest = ?1 AND key = ?2",
                    *(digest, key),
                )
                is not None
            )

    def holder_of_name(self, name: str) -> str | None:
        """The key that was first to use a submitter's name, in whatever case.

        A name is used by an entrant of any track that waits for its scores, or has had scores of
        at least one policy: otherwise, policies that are rejected would be enough to occupy names.
        """
        with self.reading() as index:
            row = index.one(
                "SELECT key FROM entry WHERE lower(submitter) = lower(?) AND "
                "(status IN ('entered', 'waiting') OR (scores IS NOT NULL AND policies > 0)) "
                "ORDER BY sequence LIMIT 1",
                name,
            )
        return None if row is None else row[0]

    def receive(self, signed: Signed[Submission]) -> bool:
        """Add a submission, which was admitted, to the queue.

        Returns:
          False if the board already has it.
        """
        with self.transaction() as index:
            if index.status(signed.id) is not None:
                return False
            self.record("received", signed.id, signed)
        return True

    def withdraw(self, signed: Signed[Withdrawal], address: str | None = None) -> bool:
        """Withdraw a submission; its page stays and shows the withdrawal.

        Args:
          signed: the withdrawal, its signature not verified yet.
          address: of the server that it was sent to; None if it was given to the board's folder.

        Returns:
          False if it was withdrawn before.

        Raises:
          Rejection: `unknown_submission`, `unsafe_name` (the reason), `wrong_board`, or
            `bad_signature`, if the submission's own key did not sign it.
        """
        withdrawal = signed.content
        with self.transaction() as index:
            row = index.one(
                "SELECT key FROM entry WHERE id = ? AND track = ''", withdrawal.submission
            )
            if row is None:
                raise unknown_submission(withdrawal.submission)
            check_text("reason", withdrawal.reason)
            check_receiver(self.document, signed.receiver, address)
            if not signed.is_valid(signed.board, row[0]):
                raise Rejection(
                    "bad_signature",
                    f"signature={signed.signature[:16]}…: does not match this withdrawal and the "
                    f"key {row[0][:16]}…. Sign it with the key that signed the submission.",
                )
            if index.status(withdrawal.submission) == "withdrawn":
                return False
            self.record("withdrawn", withdrawal.submission, signed)
        return True

    def submission(self, id: str) -> Signed[Submission]:
        """A submission as it was signed.

        Raises:
          Rejection: `unknown_submission`.
        """
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
        with self.reading() as index:
            row = index.one(f"SELECT {column} FROM entry WHERE id = ? AND track = ''", id)
        if row is None or row[0] is None:
            return None
        return self.objects.document(kind, row[0])

    def entries(self) -> list[EntryRow]:
        """All submissions, in the order in which they were received."""
        with self.reading() as index:
            return index.entries()

    def entry(self, id: str) -> EntryRow | None:
        """One submission; None if there is no such submission."""
        with self.reading() as index:
            return index.entry(id)

    def named_objects(self) -> list[str]:
        """The digests of all documents and policy files that logged documents name."""
        with self.reading() as index:
            rows = index.connection.execute("SELECT digest FROM object ORDER BY digest")
            return [digest for (digest,) in rows]

    @property
    def head(self) -> Head:
        """Number, digest and time of the last log entry."""
        with self.reading() as index:
            return index.head

    def uploaded_bytes(self, key: str, since: str) -> int:
        """Bytes that a key has sent or caused after a time, as documents write it.

        These are its artefacts and submissions, and their results and withdrawals.
        """
        with self.reading() as index:
            return index.number(
                "SELECT (SELECT coalesce(sum(size), 0) FROM object "
                "WHERE key = ?1 AND received > ?2) + "
                "(SELECT coalesce(sum(size), 0) FROM upload "
                "WHERE key = ?1 AND time > ?2)",
                *(key, since),
            )

    def total_bytes(self) -> int:
        """Bytes of all artefacts, submissions, results, withdrawals, journals and answers.

        Tickets count with the most that they can take, until they have ended.
        """
        with self.reading() as index:
            return index.number(
                "SELECT (SELECT coalesce(sum(size), 0) FROM "
                "(SELECT digest, size FROM object UNION SELECT digest, size FROM upload))"
                " + (SELECT coalesce(sum(reserved), 0) FROM entry)"
            )

    def submission_times(self, key: str, since: str) -> list[str]:
        """When each entrant of a key, of any track, was received after a time, in order."""
        with self.reading() as index:
            rows = index.connection.execute(
                "SELECT received FROM entry WHERE key = ? AND received > ? ORDER BY received",
                (key, since),
            )
            return [received for (received,) in rows]

    def is_public(self, digest: str) -> bool:
        """Whether a file is a document, or belongs to a reference row or a scored submission.

        Others are not published: who could download a policy that waits to be scored could submit
        it under another key, as if it were the first.
        """
        with self.reading() as index:
            row = index.one(
                "SELECT 1 FROM artefact JOIN entry ON id = submission "
                "WHERE digest = ?1 AND (reference OR scores IS NOT NULL) UNION "
                "SELECT 1 FROM object WHERE digest = ?1 AND digest NOT IN "
                "(SELECT digest FROM artefact) LIMIT 1",
                digest,
            )
        return row is not None

    def log(self, start: int = 0, count: int = 100) -> list[LogEntry]:
        """At most `count` log entries, from number `start` on."""
        stop = min(start + count, self.head.sequence + 1)
        return [self._log.read(sequence) for sequence in range(max(start, 0), stop)]


def _refuse_unfit(document: BoardDocument) -> None:
    suite = document.suite
    if len(document.instances) != len(suite.instances):
        raise BoardError(
            f"suite={document.suite_name}: two classes share an instance. Change one of the seeds."
        )
    refuse_unsubmittable(document)


def _write_board(folder: Folder, document: BoardDocument, key: SigningKey) -> None:
    for part in (folder.log, folder.objects):  # `build_folder` flushes them to disk
        part.mkdir()
    key.write(folder.key)
    write_document(folder.board, document, new=True)
    log, digest = Log(folder, key.public), digest_of(document)
    log.write(log.entry(key, EMPTY, "opened", document.digest, digest, now()))


def unknown_submission(id: str) -> Rejection:
    """The rejection of an id that no submission on the board has."""
    return Rejection(
        "unknown_submission",
        f"submission={id[:80]}: is not on this board. Check the id: 'sha256:' and 64 hex digits.",
    )


@dataclass(frozen=True)
class Garbage:
    """What `collect_garbage` removed, or would remove.

    Attributes:
      temporary: number of half-written files of dead processes.
      objects: number of artefacts that no submission names.
      bytes: of all of them.
    """

    temporary: int
    objects: int
    bytes: int

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

    Args:
      temporary_older_than: seconds since a temporary file was last written to; a younger one may
        belong to an upload in progress.
      objects_older_than: seconds since an artefact was uploaded; the submission of a younger one
        may follow.
      dry_run: only count.
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
        objects = {
            digest: path
            for digest, path in store.objects.paths()
            if is_older(path, objects_older_than)
            and index.one("SELECT 1 FROM object WHERE digest = ?", digest) is None
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
    with store.transaction() as index:
        old = index.connection.execute(
            "DELETE FROM upload WHERE time <= ? RETURNING digest", (until,)
        ).fetchall()
        for (digest,) in old:
            if index.one(_IS_HELD, digest) is None:
                _remove(store.folder.object(digest))


_UNNAMED_SECONDS = 3600.0
_IS_HELD = "SELECT 1 FROM object WHERE digest = ?1 UNION ALL SELECT 1 FROM upload WHERE digest = ?1"


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
