"""`index.sqlite`: the tables behind pages, ranking and queue, derived from log and documents.

The tables `head`, `track`, `entry`, `run`, `object` and `artefact` are a function of the log alone,
so a rebuilt index equals one that grew. `entry` has the entrants of all tracks, and `track` the
tracks besides the open one; `Kinds` are what each kind of log entry does to them. `lease` and
`upload` are temporary state: the claims of scorers and the faults that ended them, and artefacts
that no submission names yet. `clock` is how the machine's clock stood when the board was first
served since the machine started.

Runs are copies of earlier ones if their actions on the board's states are exactly equal. What
counts is when their submissions were received, not when they were scored, and the reference rows
are no source of copies.
"""

from __future__ import annotations

import base64
import contextlib
import os
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from leaderboard.documents.board import BoardDocument
from leaderboard.documents.result import Copies, EntryRow, Result, RunScore, Scores, Status
from leaderboard.documents.signed import Signed
from leaderboard.documents.submission import (
    REFERENCE_FAMILY,
    Artefact,
    Manifest,
    Submission,
    Withdrawal,
)
from leaderboard.errors import BoardError, Rejection, TamperedError
from leaderboard.store.log import (
    BUSY_SECONDS,
    EMPTY,
    Head,
    Log,
    LogEntry,
    Objects,
    digest_of,
    to_bytes,
    unwritable,
)
from sme_registry.io import is_regular
from sme_registry.spec.document import StrictModel

TIMES = (
    ("track", "announced"), ("entry", "received"), ("object", "received"), ("upload", "time"),
    ("spent", "time"),
)  # fmt: skip
"""Tables and their columns with times of receipt, which an entry of the event "clock" corrects.

What an end or a reveal was decided by stays: it has happened.
"""

SCHEMA = """
CREATE TABLE head (
  zero INTEGER PRIMARY KEY CHECK (zero = 0),
  board TEXT NOT NULL, sequence INTEGER NOT NULL, digest TEXT NOT NULL, time TEXT NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE track (
  digest TEXT PRIMARY KEY, sequence INTEGER NOT NULL, announced TEXT NOT NULL,
  document TEXT NOT NULL, id TEXT NOT NULL UNIQUE,
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
CREATE UNIQUE INDEX entry_sequence ON entry (sequence);
CREATE TABLE run (
  position INTEGER PRIMARY KEY, submission TEXT NOT NULL, sequence INTEGER NOT NULL,
  spec TEXT NOT NULL, actions TEXT NOT NULL, -- their digest, or a sketch
  first INTEGER -- sequence of the first submission with a run like it, if it is an earlier one
) STRICT;
CREATE INDEX run_actions ON run (spec, actions);
CREATE INDEX run_alike ON run (submission) WHERE first IS NOT NULL;
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
CREATE TABLE spent ( -- by uploads that have expired
  key TEXT NOT NULL, size INTEGER NOT NULL, time TEXT NOT NULL
) STRICT;
CREATE TABLE clock (boot TEXT PRIMARY KEY, offset REAL NOT NULL) STRICT, WITHOUT ROWID;
"""
_STATEMENTS = list(filter(None, map(str.strip, SCHEMA.split(";"))))  # as SQLite keeps them

_Model = TypeVar("_Model", bound=StrictModel)
_Row = TypeVar("_Row", bound=EntryRow)
Kinds = Mapping[str, Callable[[LogEntry], None]]
_OF_LEASE = {"faults": "coalesce(faults, 0)", "fault": "coalesce(fault, '')"}


class Index:
    """A connection to a database with the schema's tables, of a board's document and objects.

    `kinds` are those of the log's entries that further tracks add. In memory, or if it grows in a
    file that no other process sees, it is empty at first.
    """

    def __init__(
        self, objects: Objects, document: BoardDocument, kinds: Kinds, *, in_memory: bool
    ) -> None:
        self.objects, self.document = objects, document
        self.connection = _connect("") if in_memory else _reopened(objects.folder.index)
        if in_memory:
            with self.transaction():
                self.clear()
        self._kinds: Kinds = {
            "opened": self._opened,
            "received": self._received,
            "result": self._result,
            "withdrawn": self._withdrawn,
            "clock": self._clock,
            **kinds,
        }
        self._written: StrictModel | None = None

    @property
    def is_current(self) -> bool:
        """Whether it has exactly the tables of this version, and is of this board."""
        rows = self.connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")
        if sorted(text for (text,) in rows) != sorted(_STATEMENTS):
            return False
        return self.one("SELECT board FROM head") == (self.document.digest,)

    def clear(self) -> None:
        """Replace all tables by empty ones of this version; uploads, which no log names, stay."""
        execute = self.connection.execute
        uploads = execute("SELECT * FROM upload").fetchall() if self.is_current else []
        for kind, name in execute(
            "SELECT type, name FROM sqlite_master WHERE type IN ('table', 'view')"
        ).fetchall():
            execute(f'DROP {kind} "{name}"')
        for statement in _STATEMENTS:
            execute(statement)
        self.connection.executemany("INSERT INTO upload VALUES (?, ?, ?, ?)", uploads)

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
        row = self.one("SELECT sequence, digest, time FROM head")
        return EMPTY if row is None else Head(*row)

    def apply(self, entry: LogEntry, document: StrictModel | None = None) -> None:
        """Apply the log entry after `head`, before it and its document, if given, are written."""
        if entry.event not in self._kinds:
            raise BoardError(
                f"{entry.file}: event={entry.event}: must be one of {', '.join(self._kinds)}. "
                "Open the board with all its tracks."
            )
        if entry.time < self.head.time and self.document.rules > 2 and entry.event != "clock":
            raise entry.contradiction("is dated before the entry before it")
        self._written = document
        try:
            self._kinds[entry.event](entry)
        except Rejection as error:
            if document is not None:
                raise
            raise entry.contradiction(error.message) from None
        if entry.event not in ("opened", "clock"):
            self._name_document(entry)
        self.connection.execute(
            "REPLACE INTO head VALUES (0, ?, ?, ?, ?)",
            (self.document.digest, entry.sequence, entry.digest, entry.time),
        )

    def read(self, kind: type[_Model], entry: LogEntry) -> _Model:
        """The document of an entry that is applied."""
        if self._written is not None:
            return cast(_Model, self._written)
        return self.objects.document(kind, entry.document)

    def _name_document(self, entry: LogEntry) -> None:
        """Add the entry's document to the objects, as one of the entrant's or the board's."""
        if self._written is None:
            size = self.objects.path(entry.document).stat().st_size
        else:
            size = len(to_bytes(self._written))
        (key,) = self.one("SELECT key FROM entry WHERE id = ?", entry.subject) or (
            self.document.key,
        )
        self._name_object(entry.document, size, key, entry)

    def _name_object(self, digest: str, size: int, key: str, entry: LogEntry) -> None:
        row = digest, size, key, entry.time
        self.connection.execute("INSERT OR IGNORE INTO object VALUES (?, ?, ?, ?)", row)
        self.connection.execute("DELETE FROM upload WHERE digest = ? AND key = ?", (digest, key))

    def name_artefact(self, artefact: Artefact, key: str, entry: LogEntry) -> None:
        """Add a file that an entrant's document names, which is no mere upload from then on."""
        self._name_object(artefact.sha256, artefact.size, key, entry)
        row = artefact.sha256, entry.subject
        self.connection.execute("INSERT OR IGNORE INTO artefact VALUES (?, ?)", row)

    def add_entrant(self, entry: LogEntry, manifest: Manifest, **fields: Any) -> None:
        """Add an entrant of any track, which the log receives once."""
        if self.one("SELECT 1 FROM entry WHERE id = ?", entry.subject) is not None:
            raise entry.contradiction("receives an entrant twice")
        method, submitter = manifest.method, manifest.submitter
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
            "code_link": manifest.code,
        }
        self.insert("entry", values | fields)

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
        submission = self.read(Signed[Submission], entry).content
        entry.check_subject(submission.digest)
        key, family = submission.submitter.key, submission.method.family
        artefacts = [run.artefact for run in submission.runs if run.artefact is not None]
        self.add_entrant(
            entry,
            submission,
            runs=len(submission.runs),
            policies=len(artefacts),
            steps=sum(run.steps for run in submission.runs),
            reference=key == self.document.key and family == REFERENCE_FAMILY,
        )
        for artefact in artefacts:
            self.name_artefact(artefact, key, entry)

    def _result(self, entry: LogEntry) -> None:
        row = self.one("SELECT sequence, reference FROM entry WHERE id = ?", entry.subject)
        if row is None or self.status(entry.subject) != "waiting":
            raise entry.contradiction("the submission was not waiting for a result")
        result = self.read(Result, entry)
        entry.check_subject(result.submission)
        self.connection.execute(
            "UPDATE entry SET result = ?, status = ?, code = ?, enough_runs = ?, oracle_like = ?, "
            "scores = ? WHERE id = ?",
            (
                *(entry.document, result.status, result.code),
                *(result.enough_runs, result.oracle_like),
                None if result.scores is None else result.scores.to_text(),
                entry.subject,
            ),
        )
        sequence, is_reference = row
        if not is_reference:
            for run in result.runs:
                self._add_run(entry.subject, sequence, run)
        self._end_lease(entry)

    def _withdrawn(self, entry: LogEntry) -> None:
        if self.status(entry.subject) in (None, "withdrawn"):
            raise entry.contradiction("the submission is unknown or already withdrawn")
        entry.check_subject(self.read(Signed[Withdrawal], entry).content.submission)
        self.connection.execute(
            "UPDATE entry SET status = 'withdrawn', withdrawal = ? WHERE id = ?",
            (entry.document, entry.subject),
        )
        self._end_lease(entry)

    def _end_lease(self, entry: LogEntry) -> None:
        self.connection.execute("DELETE FROM lease WHERE submission = ?", (entry.subject,))

    def _clock(self, entry: LogEntry) -> None:
        first = Log(self.objects.folder, self.document.key).first_after(self.head, entry.time)
        if first is None or (first.digest, digest_of(first)) != (entry.subject, entry.document):
            raise entry.contradiction("does not name the first entry that is dated later")
        for table, column in TIMES:
            self.connection.execute(
                f"UPDATE {table} SET {column} = ?1 WHERE {column} > ?1", (entry.time,)
            )

    def _add_run(self, submission: str, sequence: int, run: RunScore) -> None:
        """Add a scored run, and update the later ones that are like it."""
        actions = run.actions or run.sketch
        if run.spec is None or not actions:
            return
        alike = self._runs_like(run.spec, actions)
        first = min((other for _, other in alike if other < sequence), default=None)
        self.connection.execute(
            "INSERT INTO run (submission, sequence, spec, actions, first) VALUES (?, ?, ?, ?, ?)",
            (submission, sequence, run.spec, actions, first),
        )
        self.connection.executemany(
            "UPDATE run SET first = min(coalesce(first, ?1), ?1) WHERE position = ?2",
            [(sequence, position) for position, other in alike if other > sequence],
        )

    def _runs_like(self, spec: str, actions: str) -> list[tuple[int, int]]:
        """Position and sequence of the runs on an instance that act like one."""
        if actions.startswith("sha256:"):
            return self.connection.execute(
                "SELECT position, sequence FROM run WHERE spec = ? AND actions = ?", (spec, actions)
            ).fetchall()
        runs = self.connection.execute(
            "SELECT position, sequence, actions FROM run "
            "WHERE spec = ? AND actions NOT LIKE 'sha256:%' ORDER BY position",
            (spec,),
        ).fetchall()
        alike = sketches_alike(actions, [sketch for *_, sketch in runs])
        return [(run[0], run[1]) for run, is_alike in zip(runs, alike, strict=True) if is_alike]

    def one(self, statement: str, *values: Any) -> tuple[Any, ...] | None:
        """The first row of a query; None if there is none."""
        row: tuple[Any, ...] | None = self.connection.execute(statement, values).fetchone()
        return row

    def status(self, id: str) -> Status | None:
        """A submission's status; None if there is no such submission."""
        row = self.one("SELECT status FROM entry WHERE id = ? AND track = ''", id)
        return None if row is None else row[0]

    def entrants(self, kind: type[_Row], where: str = "track = ''", *values: Any) -> Iterator[_Row]:
        """Rows of `entry` as a class that has its columns, in the order of the log."""
        names = [field.name for field in fields(kind) if field.name != "alike"]
        columns = ", ".join(_OF_LEASE.get(name, f"entry.{name}") for name in names)
        rows = self.connection.execute(
            f"SELECT {columns} FROM entry LEFT JOIN lease ON submission = id WHERE {where} "
            "ORDER BY sequence",
            values,
        ).fetchall()
        for row in rows:
            facts = dict(zip(names, row, strict=True))
            for name in ("enough_runs", "oracle_like", "reference"):
                facts[name] = bool(facts[name])
            if facts["scores"] is not None:
                facts["scores"] = Scores.from_text(facts["scores"])
            yield kind(**facts, alike=self._copies(facts["id"]))

    def _copies(self, submission: str) -> tuple[Copies, ...]:
        """The earlier submissions with runs like those of one."""
        rows = self.connection.execute(
            "SELECT entry.id, entry.key, count(*) FROM run JOIN entry "
            "ON entry.sequence = run.first WHERE run.first IS NOT NULL AND run.submission = ? "
            "GROUP BY run.first ORDER BY run.first",
            (submission,),
        )
        return tuple(Copies(*row) for row in rows)


def _files_of(index: Path) -> list[Path]:
    """The paths of a database and of what SQLite writes beside it."""
    return [index.with_name(index.name + end) for end in ("", "-wal", "-shm", "-journal")]


def _reopened(index: Path) -> sqlite3.Connection:
    """Connect to a file, a new one if there is none or the old one is unusable."""
    with contextlib.suppress(sqlite3.Error, OSError):
        return _opened(index)
    try:
        for path in _files_of(index):
            path.unlink(missing_ok=True)
        return _opened(index)
    except OSError as error:
        raise unwritable(index, error) from error


def _opened(index: Path) -> sqlite3.Connection:
    """Connect to a file; an error if it is no database, broken, or no regular file."""
    *paths, journal = _files_of(index)
    if os.path.lexists(journal):  # from which SQLite would restore, and delete, what it names
        raise OSError(f"{journal.name} exists, which a board never writes")
    for path in paths:
        if os.path.lexists(path) and not is_regular(path):
            raise OSError(f"{path.name} is not a regular file")
    connection = _connect(str(index))
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
    return connection


def _connect(target: str) -> sqlite3.Connection:
    # Transactions begin explicitly; the store's lock admits one thread at a time.
    return sqlite3.connect(
        target, timeout=BUSY_SECONDS, isolation_level=None, check_same_thread=False
    )


FEATURES, ALIKE, SAME_SCALE = 32, 0.001, 0.9


def sketches_alike(one: str, others: list[str]) -> list[bool]:
    """Which sketches of runs, of results of rules 2, are like one.

    A sketch has, of both halves h of the states, K = 32 moments m_hk of a − a*, their mean variance
    ν_h and a scale u_h, which may differ by a tenth; mean_k (m_hk − m'_hk)² is at most
    ALIKE min(u_h, u'_h)² + 2 (ν_h + ν'_h). Numbers that are not finite are like no others.
    """
    data = b"".join(map(base64.b64decode, [one, *others]))
    numbers = np.frombuffer(data, "<f4").astype(np.float64).reshape(len(others) + 1, -1)
    x, y = numbers[0], numbers[1:]
    with np.errstate(all="ignore"):
        ratio = y[:, -2:] / x[-2:]
        near = (ratio >= SAME_SCALE) & (ratio <= 1 / SAME_SCALE)
        moments = (y[:, : 2 * FEATURES] - x[: 2 * FEATURES]).reshape(-1, 2, FEATURES)
        noise = 2.0 * (y[:, -4:-2] + x[-4:-2])
        scale = np.minimum(y[:, -2:], x[-2:])
        within = (moments**2).mean(axis=2) <= ALIKE * scale**2 + noise
    return [bool(each) for each in (near & within).all(axis=1)]
