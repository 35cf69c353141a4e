"""`index.sqlite`: what pages, ranking and queue ask for, derived from the log and the documents.

The tables `head`, `entry` and `object` are a function of the log alone, so that an index made
anew equals the one that grew. `lease` and `upload` hold what passes: who scores what, and the
artefacts that no submission names yet.
"""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
import sqlite3
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from leaderboard.documents.board import BoardDocument, Folder
from leaderboard.documents.result import METRICS, Estimate, Result, Scores
from leaderboard.documents.submission import SignedSubmission, SignedWithdrawal
from leaderboard.errors import TamperedError
from leaderboard.store.documents import digest_of, read_document
from leaderboard.store.log import EMPTY, Head, LogEntry

Status = Literal["waiting", "scored", "rejected", "withdrawn"]

BUSY_SECONDS = 60.0
DERIVED = {"head": "zero", "entry": "id", "object": "digest"}  # tables and their keys

SCHEMA = """
CREATE TABLE head (
  zero INTEGER PRIMARY KEY CHECK (zero = 0),
  board TEXT NOT NULL, sequence INTEGER NOT NULL, digest TEXT NOT NULL, time TEXT NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE entry (
  id TEXT PRIMARY KEY, sequence INTEGER NOT NULL, received TEXT NOT NULL,
  document TEXT NOT NULL, result TEXT, withdrawal TEXT,
  status TEXT NOT NULL, code TEXT NOT NULL,
  method TEXT NOT NULL, version TEXT NOT NULL, family TEXT NOT NULL, knowledge TEXT NOT NULL,
  submitter TEXT NOT NULL, key TEXT NOT NULL, code_link TEXT,
  runs INTEGER NOT NULL, steps INTEGER NOT NULL,
  enough_runs INTEGER NOT NULL, oracle_like INTEGER NOT NULL, reference INTEGER NOT NULL,
  scores TEXT
) STRICT, WITHOUT ROWID;
CREATE INDEX entry_waiting ON entry (sequence) WHERE status = 'waiting';
CREATE INDEX entry_of_key ON entry (key, received);
CREATE TABLE object (
  digest TEXT PRIMARY KEY, size INTEGER NOT NULL, key TEXT NOT NULL, received TEXT NOT NULL
) STRICT, WITHOUT ROWID;
CREATE INDEX object_of_key ON object (key, received);
CREATE TABLE lease (
  submission TEXT PRIMARY KEY, worker TEXT, attempt INTEGER NOT NULL, lost INTEGER NOT NULL,
  boot TEXT NOT NULL, expires REAL NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE upload (
  digest TEXT PRIMARY KEY, size INTEGER NOT NULL, key TEXT NOT NULL, time TEXT NOT NULL
) STRICT, WITHOUT ROWID;
"""
VERSION = zlib.crc32(SCHEMA.encode()) & 0x7FFFFFFF  # another text is another schema


class IndexUnusable(Exception):
    """The index is missing, broken, of another schema or of another log: make it anew."""


@dataclass(frozen=True)
class EntryRow:
    """One submission, as board and ranking need it.

    Attributes:
      id: the submission's digest.
      sequence: of the log entry by which it was received: the order of submission.
      received: when.
      status: "withdrawn" may have scores.
      code: why it was rejected; empty where it was not.
      runs: listed in the submission, failed ones included.
      steps: environment steps of all runs.
      reference: one of the board's own rows, "optimal" and "constant".
      scores: null where nothing was scored.
    """

    id: str
    sequence: int
    received: str
    status: Status
    code: str
    method: str
    version: str
    family: str
    knowledge: str
    submitter: str
    key: str
    code_link: str | None
    runs: int
    steps: int
    enough_runs: bool
    oracle_like: bool
    reference: bool
    scores: Scores | None


_COLUMNS = tuple(field.name for field in fields(EntryRow))
_ROW = ", ".join(_COLUMNS)


class Index:
    """A connection to an index.

    Args:
      connection: to a database that has the tables.
      folder, document: the board's.
    """

    def __init__(
        self, connection: sqlite3.Connection, folder: Folder, document: BoardDocument
    ) -> None:
        self.connection = connection
        self.folder = folder
        self.document = document

    @classmethod
    def open(cls, path: Path, folder: Folder, document: BoardDocument) -> Index:
        """An existing index for writing.

        Raises:
          IndexUnusable: it has to be made anew.
        """
        if not path.is_file():
            raise IndexUnusable("missing")
        connection = None
        try:
            connection = _connect(f"{path.absolute().as_uri()}?mode=rw")
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = FULL")
            _refuse_unusable(connection, document)
        except sqlite3.DatabaseError as error:
            if connection is not None:
                connection.close()
            raise IndexUnusable(str(error)) from None
        except IndexUnusable:
            if connection is not None:
                connection.close()
            raise
        return cls(connection, folder, document)

    @classmethod
    def snapshot(cls, path: Path, folder: Folder, document: BoardDocument) -> Index:
        """A copy in memory of an existing index; writes nothing into a folder that is read-only.

        Raises:
          IndexUnusable: it has to be made anew.
        """
        if not path.is_file():
            raise IndexUnusable("missing")
        memory = _connect(":memory:")
        try:
            try:
                _copy(path, memory)
            except sqlite3.OperationalError:
                # SQLite reads a log of writes (WAL) only where it may write beside it.
                with tempfile.TemporaryDirectory() as elsewhere:
                    copy = Path(elsewhere) / path.name
                    for suffix in ("", "-wal"):
                        part = path.with_name(path.name + suffix)
                        if part.exists():
                            shutil.copyfile(part, copy.with_name(part.name))
                    _copy(copy, memory)
            _refuse_unusable(memory, document)
        except (sqlite3.DatabaseError, OSError) as error:
            memory.close()
            raise IndexUnusable(str(error)) from None
        except IndexUnusable:
            memory.close()
            raise
        return cls(memory, folder, document)

    @classmethod
    def empty(cls, path: Path | None, folder: Folder, document: BoardDocument) -> Index:
        """An index of nothing, in a new file or in memory; filled by `apply`."""
        connection = _connect(":memory:" if path is None else str(path))
        connection.executescript(f"PRAGMA user_version = {VERSION}; BEGIN; {SCHEMA} COMMIT;")
        return cls(connection, folder, document)

    def close(self) -> None:
        """Give the connection back."""
        self.connection.close()

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """All or nothing; no other connection writes meanwhile."""
        self.connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self.connection.execute("ROLLBACK")
            raise
        self.connection.execute("COMMIT")

    @property
    def head(self) -> Head:
        """The last log entry that the index holds."""
        row = self.connection.execute("SELECT sequence, digest, time FROM head").fetchone()
        return EMPTY if row is None else Head(*row)

    def apply(self, entry: LogEntry) -> None:
        """Take in the log entry after `head`.

        Raises:
          TamperedError: the document that it names is missing or altered, or the entry makes no
            sense after those before it.
        """
        match entry.event:
            case "opened":
                document = self.document
                if (entry.subject, entry.document) != (document.digest, digest_of(document)):
                    raise TamperedError("board.json", "is not the board that the log opened")
            case "received":
                self._received(entry)
            case "result":
                self._result(entry)
            case "withdrawn":
                self._withdrawn(entry)
        self.connection.execute(
            "REPLACE INTO head VALUES (0, ?, ?, ?, ?)",
            (self.document.digest, entry.sequence, entry.digest, entry.time),
        )

    def _received(self, entry: LogEntry) -> None:
        if self.one("SELECT 1 FROM entry WHERE id = ?", entry.subject) is not None:
            raise _senseless(entry, "receives a submission again")
        path = self.folder.submission(entry.subject)
        submission = read_document(self.folder, path, SignedSubmission, entry.document).submission
        if submission.digest != entry.subject:
            raise _senseless(entry, "names a document that is of another submission")
        method, submitter = submission.method, submission.submitter
        self.connection.execute(
            f"INSERT INTO entry VALUES ({', '.join('?' * 21)})",
            (
                *(entry.subject, entry.sequence, entry.time, entry.document, None, None),
                *("waiting", ""),
                *(method.name, method.version, method.family, method.knowledge),
                *(submitter.name, submitter.key, submission.code),
                *(len(submission.runs), sum(run.steps for run in submission.runs)),
                *(False, False),
                submitter.key == self.document.key and method.family == "reference",
                None,
            ),
        )
        for run in submission.runs:
            if run.artefact is not None:
                self.connection.execute(
                    "INSERT OR IGNORE INTO object VALUES (?, ?, ?, ?)",
                    (run.artefact.sha256, run.artefact.size, submitter.key, entry.time),
                )
                self.connection.execute(
                    "DELETE FROM upload WHERE digest = ?", (run.artefact.sha256,)
                )

    def _result(self, entry: LogEntry) -> None:
        if self.status(entry.subject) != "waiting":
            raise _senseless(entry, "is of a submission that does not wait for a result")
        path = self.folder.result(entry.subject)
        result = read_document(self.folder, path, Result, entry.document)
        if result.submission != entry.subject:
            raise _senseless(entry, "names a document that is of another submission")
        self.connection.execute(
            "UPDATE entry SET result = ?, status = ?, code = ?, enough_runs = ?, oracle_like = ?, "
            "scores = ? WHERE id = ?",
            (
                *(entry.document, result.status, result.code),
                *(result.enough_runs, result.oracle_like),
                None if result.scores is None else _scores_text(result.scores),
                entry.subject,
            ),
        )
        self.connection.execute("DELETE FROM lease WHERE submission = ?", (entry.subject,))

    def _withdrawn(self, entry: LogEntry) -> None:
        if self.status(entry.subject) in (None, "withdrawn"):
            raise _senseless(entry, "withdraws what is not there")
        path = self.folder.withdrawal(entry.subject)
        signed = read_document(self.folder, path, SignedWithdrawal, entry.document)
        if signed.withdrawal.submission != entry.subject:
            raise _senseless(entry, "names a document that is of another submission")
        self.connection.execute(
            "UPDATE entry SET status = 'withdrawn', withdrawal = ? WHERE id = ?",
            (entry.document, entry.subject),
        )
        self.connection.execute("DELETE FROM lease WHERE submission = ?", (entry.subject,))

    def one(self, statement: str, *values: Any) -> tuple[Any, ...] | None:
        """The first row of an answer; None where there is none."""
        row: tuple[Any, ...] | None = self.connection.execute(statement, values).fetchone()
        return row

    def status(self, id: str) -> Status | None:
        """A submission's status; None where there is no such submission."""
        row = self.one("SELECT status FROM entry WHERE id = ?", id)
        return None if row is None else row[0]

    def entries(self) -> list[EntryRow]:
        """Every submission, in the order in which they came."""
        return [
            _entry_row(row)
            for row in self.connection.execute(f"SELECT {_ROW} FROM entry ORDER BY sequence")
        ]

    def entry(self, id: str) -> EntryRow | None:
        """One submission; None where there is no such submission."""
        row = self.one(f"SELECT {_ROW} FROM entry WHERE id = ?", id)
        return None if row is None else _entry_row(row)

    def derived_rows(self) -> Iterator[tuple[str, str, tuple[Any, ...]]]:
        """Table, key and values of each row that is a function of the log, in a fixed order."""
        for table, key in DERIVED.items():
            for row in self.connection.execute(f"SELECT {key}, * FROM {table} ORDER BY {key}"):
                yield table, str(row[0]), row[1:]


def _connect(target: str) -> sqlite3.Connection:
    # Transactions are begun by hand; the store's own lock lets one thread in at a time.
    return sqlite3.connect(
        target,
        timeout=BUSY_SECONDS,
        isolation_level=None,
        check_same_thread=False,
        uri=target.startswith("file:"),
    )


def _copy(path: Path, memory: sqlite3.Connection) -> None:
    with contextlib.closing(_connect(f"{path.absolute().as_uri()}?mode=ro")) as source:
        source.backup(memory)


def _refuse_unusable(connection: sqlite3.Connection, document: BoardDocument) -> None:
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version != VERSION:
        raise IndexUnusable("of another schema")
    (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise IndexUnusable(f"broken: {verdict}")
    head = connection.execute("SELECT board FROM head").fetchone()
    if head is None or head[0] != document.digest:
        raise IndexUnusable("of another board")


def _senseless(entry: LogEntry, what: str) -> TamperedError:
    return TamperedError(f"log/{entry.sequence:08d}.json", f"event={entry.event}: {what}")


def _scores_text(scores: Scores) -> str:
    """Scores as lists of numbers: read back 1,000 at a time, so without names."""
    estimates = [getattr(scores, metric) for metric in METRICS] + list(scores.normalised_regret)
    return json.dumps([[each.value, each.low, each.high] for each in estimates])


@functools.lru_cache(maxsize=4096)  # frozen, and asked for again each time that the log grows
def _scores(text: str) -> Scores:
    """`_scores_text` undone, not validated again: what was written came out of a `Result`."""
    estimates = [
        Estimate.model_construct(value=value, low=low, high=high)
        for value, low, high in json.loads(text)
    ]
    count = len(METRICS)
    named = dict(zip(METRICS, estimates[:count], strict=True))
    return Scores.model_construct(None, **named, normalised_regret=tuple(estimates[count:]))


def _entry_row(row: tuple[Any, ...]) -> EntryRow:
    values = dict(zip(_COLUMNS, row, strict=True))
    for name in ("enough_runs", "oracle_like", "reference"):
        values[name] = bool(values[name])
    if values["scores"] is not None:
        values["scores"] = _scores(values["scores"])
    return EntryRow(**values)
