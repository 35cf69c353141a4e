"""`index.sqlite`: the tables behind pages, ranking and queue, derived from log and documents.

The tables `head`, `track`, `entry`, `run`, `object` and `artefact` are a function of the log alone,
so a rebuilt index equals one that grew. `entry` has the entrants of all tracks, and `track` the
tracks besides the open one; `KINDS` says what each kind of log entry does to them. `lease` and
`upload` are temporary state: the claims of scorers and the faults that ended them, and artefacts
that no submission names yet.
`clock` is how the machine's clock stood when the board was first served since the machine started.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sqlite3
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, cast

from leaderboard.documents.board import BoardDocument, Folder
from leaderboard.documents.result import Result
from leaderboard.documents.signed import Signed
from leaderboard.documents.submission import Artefact, Submission, Withdrawal
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store import rows
from leaderboard.store.blobs import BUSY_SECONDS, Objects, digest_of, to_bytes
from leaderboard.store.log import EMPTY, Head, Log, LogEntry
from leaderboard.store.rows import Copies, EntryRow, Status, scores_of, scores_text
from sme_registry.io import is_regular
from sme_registry.spec.document import StrictModel

TIMES = (("track", "announced"), ("entry", "received"), ("object", "received"), ("upload", "time"))
"""Tables and their columns with times of receipt, which an entry of the event "clock" corrects.

What an end or a reveal was decided by stays: it has happened.
"""

SCHEMA = f"""
CREATE TABLE head (
  zero INTEGER PRIMARY KEY CHECK (zero = 0),
  board TEXT NOT NULL, sequence INTEGER NOT NULL, digest TEXT NOT NULL, time TEXT NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE track (
  digest TEXT PRIMARY KEY, sequence INTEGER NOT NULL, announced TEXT NOT NULL,
  document TEXT NOT NULL, id TEXT NOT NULL UNIQUE, title TEXT NOT NULL, kind TEXT NOT NULL,
  opens TEXT NOT NULL, closes TEXT NOT NULL, instances INTEGER NOT NULL,
  reveal TEXT, revealed TEXT NOT NULL DEFAULT ''
) STRICT, WITHOUT ROWID;
CREATE TABLE admitted (
  track TEXT NOT NULL, key TEXT NOT NULL, name TEXT NOT NULL, PRIMARY KEY (track, key)
) STRICT, WITHOUT ROWID;
CREATE TABLE entry (
  id TEXT PRIMARY KEY, sequence INTEGER NOT NULL, received TEXT NOT NULL,
  document TEXT NOT NULL, result TEXT, withdrawal TEXT,
  status TEXT NOT NULL DEFAULT 'waiting', code TEXT NOT NULL DEFAULT '',
  method TEXT NOT NULL, version TEXT NOT NULL, family TEXT NOT NULL, knowledge TEXT NOT NULL,
  submitter TEXT NOT NULL, key TEXT NOT NULL, code_link TEXT,
  runs INTEGER NOT NULL, policies INTEGER NOT NULL, steps INTEGER NOT NULL DEFAULT 0,
  enough_runs INTEGER NOT NULL DEFAULT 0, oracle_like INTEGER NOT NULL DEFAULT 0,
  reference INTEGER NOT NULL DEFAULT 0, scores TEXT,
  track TEXT NOT NULL DEFAULT '', number INTEGER, created TEXT NOT NULL DEFAULT '',
  finished TEXT NOT NULL DEFAULT '', reserved INTEGER NOT NULL DEFAULT 0 -- bytes at most
) STRICT, WITHOUT ROWID;
CREATE UNIQUE INDEX entry_number ON entry (track, number);
CREATE INDEX entry_waiting ON entry (sequence) WHERE status = 'waiting';
CREATE INDEX entry_of_key ON entry (key, received);
CREATE UNIQUE INDEX entry_sequence ON entry (sequence);{rows.SCHEMA}
CREATE TABLE object (
  digest TEXT PRIMARY KEY, size INTEGER NOT NULL, key TEXT NOT NULL, received TEXT NOT NULL
) STRICT, WITHOUT ROWID;
CREATE INDEX object_of_key ON object (key, received);
CREATE TABLE artefact (
  digest TEXT NOT NULL, submission TEXT NOT NULL, PRIMARY KEY (digest, submission)
) STRICT, WITHOUT ROWID;
CREATE TABLE lease (
  submission TEXT PRIMARY KEY, worker TEXT NOT NULL, attempt INTEGER NOT NULL,
  held INTEGER NOT NULL, faults INTEGER NOT NULL, fault TEXT NOT NULL,
  boot TEXT NOT NULL, expires REAL NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE job (id TEXT PRIMARY KEY) STRICT;
CREATE TABLE upload (
  digest TEXT NOT NULL, size INTEGER NOT NULL, key TEXT NOT NULL, time TEXT NOT NULL,
  PRIMARY KEY (digest, key)
) STRICT, WITHOUT ROWID;
CREATE TABLE clock (boot TEXT PRIMARY KEY, offset REAL NOT NULL) STRICT, WITHOUT ROWID;
"""
VERSION = zlib.crc32(SCHEMA.encode()) & 0x7FFFFFFF  # changes with the schema's text

_COLUMNS = tuple(field.name for field in fields(EntryRow) if field.name != "alike")
_OF_LEASE = {"faults": "coalesce(faults, 0)", "fault": "coalesce(fault, '')"}
_ROW = ", ".join(_OF_LEASE.get(name, f"entry.{name}") for name in _COLUMNS)
_ROWS = f"SELECT {_ROW} FROM entry LEFT JOIN lease ON submission = id WHERE track = ''"


_Model = TypeVar("_Model", bound=StrictModel)
Kinds = Mapping[str, "Callable[[Index, LogEntry], None]"]


class Index:
    """A connection to a database with the schema's tables, of a board's folder and document."""

    def __init__(
        self,
        connection: sqlite3.Connection,
        folder: Folder,
        document: BoardDocument,
        kinds: Kinds,
    ) -> None:
        self.connection = connection
        self.folder = folder
        self.document = document
        self.objects = Objects(folder, by_kind=document.rules == 2)
        self._board = document.digest
        self._written: StrictModel | None = None
        self._kinds = kinds

    @classmethod
    def open(cls, folder: Folder, document: BoardDocument, kinds: Kinds) -> Index:
        """Connect to a board's index, whose file is created if it does not exist.

        Raises:
          sqlite3.Error: the file is no database, or is broken.
          OSError: it, or one of those beside it, is no regular file.
        """
        *files, journal = files_of(folder.index)
        if os.path.lexists(journal):  # from which SQLite would restore, and delete, what it names
            raise OSError(f"{journal.name} exists, which a board never writes")
        for path in files:
            if os.path.lexists(path) and not is_regular(path):
                raise OSError(f"{path.name} is not a regular file")
        connection = _connect(str(folder.index))
        try:
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = FULL")
            (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
            if verdict != "ok":
                raise sqlite3.DatabaseError(verdict)
        except BaseException:
            connection.close()
            raise
        return cls(connection, folder, document, kinds)

    @classmethod
    def empty(cls, folder: Folder, document: BoardDocument, kinds: Kinds) -> Index:
        """An empty index in memory, or if it grows in a file that no other process sees."""
        index = cls(_connect(""), folder, document, kinds)
        with index.transaction():
            index.clear()
        return index

    @property
    def is_current(self) -> bool:
        """Whether it has exactly the tables of this version, and is of this board."""
        (version,) = self.connection.execute("PRAGMA user_version").fetchone()
        if version != VERSION or _definitions(self.connection) != _expected():
            return False
        row = self.one("SELECT board FROM head")
        return row is not None and row[0] == self._board

    def clear(self) -> None:
        """Replace all tables by empty ones of this version, in a transaction."""
        for kind, name in self.connection.execute(
            "SELECT type, name FROM sqlite_master WHERE type IN ('table', 'view')"
        ).fetchall():
            self.connection.execute(f'DROP {kind} "{name}"')
        for statement in SCHEMA.split(";"):
            self.connection.execute(statement)
        self.connection.execute(f"PRAGMA user_version = {VERSION}")

    def uploads(self) -> list[tuple[Any, ...]]:
        """Of files that no submission names yet, which are not in the log."""
        return self.connection.execute("SELECT * FROM upload").fetchall()

    def add_uploads(self, rows: list[tuple[Any, ...]]) -> None:
        self.connection.executemany("INSERT INTO upload VALUES (?, ?, ?, ?)", rows)

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Commit all writes of the block or none; other connections wait."""
        self.connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self.connection.execute("ROLLBACK")
            raise
        self.connection.execute("COMMIT")

    @property
    def head(self) -> Head:
        """The last log entry in the index."""
        row = self.connection.execute("SELECT sequence, digest, time FROM head").fetchone()
        return EMPTY if row is None else Head(*row)

    def apply(self, entry: LogEntry, document: StrictModel | None = None) -> None:
        """Apply the log entry after `head`, which may be one that is not written yet.

        Args:
          entry: the entry.
          document: that it names, where it is not written yet.

        Raises:
          Rejection: the document is not allowed at the entry's time, and is not written yet.
        """
        if entry.event not in self._kinds:
            raise BoardError(
                f"log/{entry.sequence:08d}.json: event={entry.event}: must be one of "
                f"{', '.join(self._kinds)}. Open the board with all its tracks."
            )
        if entry.time < self.head.time and self.document.rules > 2 and entry.event != "clock":
            raise entry.contradiction("is dated before the entry before it")
        self._written = document
        try:
            self._kinds[entry.event](self, entry)
        except Rejection as error:
            if document is not None:
                raise
            raise entry.contradiction(error.message) from None
        if entry.event not in ("opened", "clock"):
            self._name_document(entry)
        self.connection.execute(
            "REPLACE INTO head VALUES (0, ?, ?, ?, ?)",
            (self._board, entry.sequence, entry.digest, entry.time),
        )

    def read(self, kind: type[_Model], entry: LogEntry) -> _Model:
        """The document of an entry that is applied."""
        if self._written is not None:
            return cast(_Model, self._written)
        return self.objects.document(kind, entry.document)

    def _name_document(self, entry: LogEntry) -> None:
        """Add the entry's document to the objects, as one of the entrant's or the board's."""
        row = self.one("SELECT key FROM entry WHERE id = ?", entry.subject)
        if self._written is None:
            size = self.objects.path(entry.document).stat().st_size
        else:
            size = len(to_bytes(self._written))
        key = self.document.key if row is None else row[0]
        self._name_object(entry.document, size, key, entry)

    def _name_object(self, digest: str, size: int, key: str, entry: LogEntry) -> None:
        row = digest, size, key, entry.time
        self.connection.execute("INSERT OR IGNORE INTO object VALUES (?, ?, ?, ?)", row)
        self.connection.execute(
            "DELETE FROM upload WHERE digest = ? AND key IN (?, '')", (digest, key)
        )

    def name_artefact(self, artefact: Artefact, key: str, entry: LogEntry) -> None:
        """Add a file that an entrant's document names, which is no mere upload from then on."""
        self._name_object(artefact.sha256, artefact.size, key, entry)
        row = artefact.sha256, entry.subject
        self.connection.execute("INSERT OR IGNORE INTO artefact VALUES (?, ?)", row)

    def insert(self, table: str, values: dict[str, Any]) -> None:
        """Insert a row, by its columns."""
        self.connection.execute(
            f"INSERT INTO {table} ({', '.join(values)}) VALUES (:{', :'.join(values)})", values
        )

    def _opened(self, entry: LogEntry) -> None:
        document = self.document
        if (entry.subject, entry.document) != (document.digest, digest_of(document)):
            raise TamperedError("board.json", "differs from the board that the log opened")

    def _received(self, entry: LogEntry) -> None:
        if self.one("SELECT 1 FROM entry WHERE id = ?", entry.subject) is not None:
            raise entry.contradiction("receives a submission twice")
        submission = self.read(Signed[Submission], entry).content
        entry.check_subject(submission.digest)
        method, submitter = submission.method, submission.submitter
        values = {
            "id": entry.subject,
            "sequence": entry.sequence,
            "received": entry.time,
            "document": entry.document,
            "method": method.name,
            "version": method.version,
            "family": method.family,
            "knowledge": method.knowledge,
            "submitter": submitter.name,
            "key": submitter.key,
            "code_link": submission.code,
            "runs": len(submission.runs),
            "policies": sum(run.artefact is not None for run in submission.runs),
            "steps": sum(run.steps for run in submission.runs),
            "reference": submitter.key == self.document.key and method.family == "reference",
        }
        self.insert("entry", values)
        for run in submission.runs:
            if run.artefact is not None:
                self.name_artefact(run.artefact, submitter.key, entry)

    def _result(self, entry: LogEntry) -> None:
        if self.status(entry.subject) != "waiting":
            raise entry.contradiction("the submission was not waiting for a result")
        result = self.read(Result, entry)
        entry.check_subject(result.submission)
        self.connection.execute(
            "UPDATE entry SET result = ?, status = ?, code = ?, enough_runs = ?, oracle_like = ?, "
            "scores = ? WHERE id = ?",
            (
                *(entry.document, result.status, result.code),
                *(result.enough_runs, result.oracle_like),
                None if result.scores is None else scores_text(result.scores),
                entry.subject,
            ),
        )
        sequence, reference = self.one(
            "SELECT sequence, reference FROM entry WHERE id = ?", entry.subject
        ) or (0, True)
        if not reference:
            rows.add_runs(self.connection, entry.subject, sequence, result.runs)
        self.connection.execute("DELETE FROM lease WHERE submission = ?", (entry.subject,))

    def _withdrawn(self, entry: LogEntry) -> None:
        if self.status(entry.subject) in (None, "withdrawn"):
            raise entry.contradiction("the submission is unknown or already withdrawn")
        signed = self.read(Signed[Withdrawal], entry)
        entry.check_subject(signed.content.submission)
        self.connection.execute(
            "UPDATE entry SET status = 'withdrawn', withdrawal = ? WHERE id = ?",
            (entry.document, entry.subject),
        )
        self.connection.execute("DELETE FROM lease WHERE submission = ?", (entry.subject,))

    def _clock(self, entry: LogEntry) -> None:
        first = Log(self.folder, self.document.key).first_after(self.head, entry.time)
        if first is None or (first.digest, digest_of(first)) != (entry.subject, entry.document):
            raise entry.contradiction("does not name the first entry that is dated later")
        for table, column in TIMES:
            self.connection.execute(
                f"UPDATE {table} SET {column} = ?1 WHERE {column} > ?1", (entry.time,)
            )

    def one(self, statement: str, *values: Any) -> tuple[Any, ...] | None:
        """The first row of a query; None if there is none."""
        row: tuple[Any, ...] | None = self.connection.execute(statement, values).fetchone()
        return row

    def number(self, statement: str, *values: Any) -> int:
        """The number that a query for an aggregate returns."""
        return int(self.connection.execute(statement, values).fetchone()[0])

    def status(self, id: str) -> Status | None:
        """A submission's status; None if there is no such submission."""
        row = self.one("SELECT status FROM entry WHERE id = ? AND track = ''", id)
        return None if row is None else row[0]

    def entries(self) -> list[EntryRow]:
        """All submissions, in the order in which they were received."""
        alike = rows.copies_of(self.connection)
        return [
            _entry_row(row, alike) for row in self.connection.execute(f"{_ROWS} ORDER BY sequence")
        ]

    def entry(self, id: str) -> EntryRow | None:
        """One submission; None if there is no such submission."""
        row = self.one(f"{_ROWS} AND id = ?", id)
        return None if row is None else _entry_row(row, rows.copies_of(self.connection, id))


KINDS: Kinds = {
    "opened": Index._opened,
    "received": Index._received,
    "result": Index._result,
    "withdrawn": Index._withdrawn,
    "clock": Index._clock,
}
"""Of log entries, on every board: what each does to the index."""


def files_of(index: Path) -> list[Path]:
    """The paths of a database and of what SQLite writes beside it."""
    return [index.with_name(index.name + end) for end in ("", "-wal", "-shm", "-journal")]


def _connect(target: str) -> sqlite3.Connection:
    # Transactions begin explicitly; the store's lock admits one thread at a time.
    return sqlite3.connect(
        target,
        timeout=BUSY_SECONDS,
        isolation_level=None,
        check_same_thread=False,
    )


def _definitions(connection: sqlite3.Connection) -> list[tuple[Any, ...]]:
    """Of all tables, indices, views and triggers."""
    return connection.execute(
        "SELECT type, name, tbl_name, sql FROM sqlite_master ORDER BY type, name"
    ).fetchall()


@functools.cache
def _expected() -> list[tuple[Any, ...]]:
    with contextlib.closing(_connect(":memory:")) as connection:
        connection.executescript(SCHEMA)
        return _definitions(connection)


def _entry_row(row: tuple[Any, ...], alike: dict[str, tuple[Copies, ...]]) -> EntryRow:
    values = dict(zip(_COLUMNS, row, strict=True))
    values["alike"] = alike.get(values["id"], ())
    for name in ("enough_runs", "oracle_like", "reference"):
        values[name] = bool(values[name])
    if values["scores"] is not None:
        values["scores"] = scores_of(values["scores"])
    return EntryRow(**values)
