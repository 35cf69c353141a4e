"""Which runs on a board behave like earlier ones: the table `run`.

The order is that in which submissions were received, not scored: whoever copies a policy and is
scored first has copied nevertheless. The board's own reference rows are no source of copies.
"""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

from leaderboard.documents import sketch
from leaderboard.documents.result import RunScore

SCHEMA = """
CREATE TABLE run (
  position INTEGER PRIMARY KEY, submission TEXT NOT NULL, sequence INTEGER NOT NULL,
  spec TEXT NOT NULL, sketch BLOB NOT NULL,
  first INTEGER -- sequence of the first submission with a run like it, if it is an earlier one
) STRICT;
CREATE INDEX run_alike ON run (submission) WHERE first IS NOT NULL;
"""


@dataclass(frozen=True)
class Likeness:
    """An earlier submission whose policies some runs of a submission behave like.

    Attributes:
      id, key: of the earlier submission; of several, a run counts for the earliest.
      runs: number of such runs.
    """

    id: str
    key: str
    runs: int


@dataclass
class _Instance:
    """The runs on one instance: positions and sequences, and the bytes of their sketches."""

    positions: list[int] = field(default_factory=list)
    sequences: list[int] = field(default_factory=list)
    sketches: bytearray = field(default_factory=bytearray)


class Runs:
    """The table of runs, whose committed rows are also held in memory.

    Args:
      connection: to a database with `SCHEMA` and the table `entry`.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self.forget()

    def forget(self) -> None:
        """Forget the rows in memory, after a transaction was rolled back."""
        self._instances: dict[str, _Instance] = defaultdict(_Instance)
        self._loaded = 0

    def add(self, submission: str, sequence: int, runs: Iterable[RunScore]) -> None:
        """Add the scored runs of a submission, and update the later ones that are like them."""
        self._load()
        position = self._loaded
        for run in runs:
            if run.spec is None or not run.sketch:
                continue
            data = sketch.to_bytes(run.sketch)
            known = self._instances[run.spec]
            found = sketch.alike(sketch.numbers(data)[0], sketch.numbers(known.sketches)).tolist()
            earlier = [known.sequences[i] for i in found if known.sequences[i] < sequence]
            self._connection.execute(
                "INSERT INTO run VALUES (?, ?, ?, ?, ?, ?)",
                (position, submission, sequence, run.spec, data, min(earlier, default=None)),
            )
            self._connection.executemany(
                "UPDATE run SET first = min(coalesce(first, ?1), ?1) WHERE position = ?2",
                [(sequence, known.positions[i]) for i in found if known.sequences[i] > sequence],
            )
            position += 1

    def _load(self) -> None:
        """Load the rows that other processes, or earlier calls, have added."""
        for position, sequence, spec, data in self._connection.execute(
            "SELECT position, sequence, spec, sketch FROM run WHERE position >= ? "
            "ORDER BY position",
            (self._loaded,),
        ):
            known = self._instances[spec]
            known.positions.append(position)
            known.sequences.append(sequence)
            known.sketches += data
            self._loaded = position + 1

    def likenesses(self, submission: str | None = None) -> dict[str, tuple[Likeness, ...]]:
        """The earlier submissions that each submission, or only this one, has runs like."""
        found: dict[str, list[Likeness]] = defaultdict(list)
        for id, *likeness in self._connection.execute(
            "SELECT run.submission, entry.id, entry.key, count(*) FROM run "
            "JOIN entry ON entry.sequence = run.first "
            "WHERE run.first IS NOT NULL AND (?1 IS NULL OR run.submission = ?1) "
            "GROUP BY run.submission, run.first ORDER BY run.submission, run.first",
            (submission,),
        ):
            found[id].append(Likeness(*likeness))
        return {id: tuple(each) for id, each in found.items()}
