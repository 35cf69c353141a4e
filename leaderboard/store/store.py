"""`Store`: one board's folder, for any number of processes and threads at once."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn, Self

from leaderboard.documents.board import BoardDocument, Folder
from leaderboard.documents.checks import refuse_unsubmittable
from leaderboard.documents.keys import SigningKey, verifies
from leaderboard.documents.result import Result
from leaderboard.documents.submission import SignedSubmission, SignedWithdrawal, now
from leaderboard.errors import BoardError, Rejection
from leaderboard.store import upkeep
from leaderboard.store.database import Database
from leaderboard.store.files import (
    digest_of,
    make_folder,
    read_document,
    write_document,
)
from leaderboard.store.index import EntryRow, Index
from leaderboard.store.log import EMPTY, Head, Log, LogEntry
from leaderboard.store.objects import Objects
from leaderboard.store.queue import Queue
from leaderboard.store.usage import Usage
from sme_registry.errors import UnknownNameError
from sme_registry.io import build_folder
from sme_registry.spec import EvaluationProtocol, Suite


class Store:
    """A board's folder, opened by `create` or `open`; a context manager.

    Attributes:
      folder: its paths.
      document: the board's document.
      read_only: whether it was opened read-only.
      objects: the artefacts; `put_object` adds one.
      queue: the submissions that wait to be scored.
      usage: what keys have uploaded and submitted.
    """

    def __init__(self, path: str | Path, *, read_only: bool) -> None:
        self.folder = Folder(path)
        self.document: BoardDocument = self.folder.read()
        self.read_only = read_only
        self.objects = Objects(self.folder)
        self._database = Database(self.folder, self.document, self.objects, read_only=read_only)
        self.queue = Queue(self._database)
        self.usage = Usage(self._database)

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
        """Create a board with its own key in a new folder.

        Args:
          path: a folder that does not exist or is empty.
          title, suite_name, suite, protocol_name, protocol, fields: of `BoardDocument`.

        Returns:
          The board's store, opened for writing.

        Raises:
          BoardError: the folder exists and is not empty, or the suite does not fit a board.
          OptionError: the folder cannot be created.
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
    def open(cls, path: str | Path, *, read_only: bool = False, reindex: bool = False) -> Store:
        """Open a board and bring its index up to date; an unusable index is rebuilt.

        Args:
          path: the board's folder.
          read_only: write nothing, not even the index, which is then held in memory.
          reindex: rebuild the index and ignore what the old one recorded of the log.

        Raises:
          BoardError: the folder holds no board, or the index cannot be written.
          TamperedError: log, documents and index disagree; names the first altered row.
        """
        store = cls(path, read_only=read_only)
        try:
            store._database.open(reindex=reindex)
            if not read_only:
                upkeep.remove_unlogged_results(store)
        except BaseException:
            store.close()
            raise
        return store

    def close(self) -> None:
        """Release all files and locks; closing twice does nothing."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def put_object(self, digest: str, chunks: Iterable[bytes], *, by: str) -> bool:
        """Store an artefact while its bytes arrive, up to the board's size limit.

        Args:
          digest: the artefact's expected digest.
          chunks: the bytes; not read if the board already has the artefact.
          by: the uploader's public key, for the quotas.

        Returns:
          True if it is new.

        Raises:
          Rejection: `too_large` or `artefact_digest`.
          BoardError: it cannot be written, or the board's key is missing.
        """
        self._database.refuse_read_only()
        self._database.signing_key()  # without it no submission could follow
        size = 0

        def counted() -> Iterator[bytes]:
            nonlocal size
            for chunk in chunks:
                size += len(chunk)
                yield chunk

        if not self.objects.put(digest, counted(), self.document.limits.artefact_bytes):
            return False
        with self.transaction() as index:
            if index.one("SELECT 1 FROM object WHERE digest = ?", digest) is None:
                index.connection.execute(
                    "INSERT OR IGNORE INTO upload VALUES (?, ?, ?, ?)", (digest, size, by, now())
                )
        return True

    def receive(self, signed: SignedSubmission) -> bool:
        """Add a submission, which `intake` has checked, to the queue.

        Returns:
          False if the board already has it.

        Raises:
          BoardError: it cannot be written.
        """
        with self.transaction() as index:
            if index.status(signed.id) is not None:
                return False
            path = self.folder.submission(signed.id)
            self._database.record("received", signed.id, path, signed)
        return True

    def withdraw(self, signed: SignedWithdrawal) -> bool:
        """Withdraw a submission; its page stays and shows the withdrawal.

        Returns:
          False if it was withdrawn before.

        Raises:
          UnknownNameError: there is no such submission.
          Rejection: `bad_signature`, if the submission's own key did not sign it.
          BoardError: it cannot be written.
        """
        withdrawal = signed.withdrawal
        with self.transaction() as index:
            row = index.one("SELECT key FROM entry WHERE id = ?", withdrawal.submission)
            if row is None:
                _refuse_unknown(withdrawal.submission)
            if not verifies(row[0], signed.signature, "withdrawal", withdrawal.digest):
                raise Rejection(
                    "bad_signature",
                    f"signature={signed.signature[:16]}…: does not match this withdrawal and the "
                    f"key {row[0][:16]}…. Sign it with the key that signed the submission.",
                )
            if index.status(withdrawal.submission) == "withdrawn":
                return False
            path = self.folder.withdrawal(withdrawal.submission)
            self._database.record("withdrawn", withdrawal.submission, path, signed)
        return True

    def submission(self, id: str) -> SignedSubmission:
        """A submission as it was signed.

        Raises:
          UnknownNameError: there is no such submission.
          TamperedError: its file differs from the logged one.
        """
        digest = self._logged("document", id)
        if digest is None:
            _refuse_unknown(id)
        return read_document(self.folder, self.folder.submission(id), SignedSubmission, digest)

    def result(self, id: str) -> Result | None:
        """A submission's result; None if it has none, or does not exist.

        Raises:
          TamperedError: its file differs from the logged one.
        """
        digest = self._logged("result", id)
        if digest is None:
            return None
        return read_document(self.folder, self.folder.result(id), Result, digest)

    def withdrawal(self, id: str) -> SignedWithdrawal | None:
        """A submission's withdrawal; None if there is none.

        Raises:
          TamperedError: its file differs from the logged one.
        """
        digest = self._logged("withdrawal", id)
        if digest is None:
            return None
        return read_document(self.folder, self.folder.withdrawal(id), SignedWithdrawal, digest)

    def entries(self) -> list[EntryRow]:
        """All submissions, in the order in which they were received."""
        with self._database.reading() as index:
            return index.entries()

    def entry(self, id: str) -> EntryRow | None:
        """One submission; None if there is no such submission."""
        with self._database.reading() as index:
            return index.entry(id)

    @property
    def head(self) -> Head:
        """Number, digest and time of the last log entry."""
        with self._database.reading() as index:
            return index.head

    def log(self, start: int = 0, count: int = 100) -> list[LogEntry]:
        """At most `count` log entries, from number `start` on.

        Raises:
          TamperedError: an entry was altered.
        """
        stop = min(start + count, self.head.sequence + 1)
        return [self._database.log.read(sequence) for sequence in range(max(start, 0), stop)]

    def transaction(self) -> contextlib.AbstractContextManager[Index]:
        """Write while every other process and thread waits; see `Database.transaction`.

        Several calls inside one block (check a quota, then `receive`) see no change in between.
        """
        return self._database.transaction()

    def locked(self) -> contextlib.AbstractContextManager[None]:
        """Block all writers for the block, which must be short."""
        return self._database.locked()

    def reindex(self) -> None:
        """Rebuild the index from the log and the documents; see `Database.rebuild`."""
        self._database.rebuild()

    def _logged(self, column: str, id: str) -> str | None:
        """The digest of a submission's document, result or withdrawal in the log."""
        with self._database.reading() as index:
            row = index.one(f"SELECT {column} FROM entry WHERE id = ?", id)
        return None if row is None else row[0]


def _refuse_unfit(document: BoardDocument) -> None:
    suite = document.suite
    if any(spec.team is not None for spec in suite.instances):
        raise BoardError(
            f"suite={document.suite_name}: has teams; a board needs single-agent tasks. "
            "Choose another suite."
        )
    if len(document.instances) != len(suite.instances):
        raise BoardError(
            f"suite={document.suite_name}: two classes share an instance. Change one of the seeds."
        )
    refuse_unsubmittable(document)


def _write_board(folder: Folder, document: BoardDocument, key: SigningKey) -> None:
    for part in (folder.log, folder.submissions, folder.withdrawals, folder.results):
        make_folder(part)
    make_folder(folder.objects)
    key.write(folder.key)
    write_document(folder.board, document, new=True)
    Log(folder, key.public).append(key, EMPTY, "opened", document.digest, digest_of(document))


def _refuse_unknown(id: str) -> NoReturn:
    raise UnknownNameError(
        f"submission={id[:80]!r}: no submission on this board has this id. "
        "Ids are 'sha256:' and 64 hex digits; `sme-leaderboard rank` lists them."
    )
