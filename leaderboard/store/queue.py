"""`Queue`: what waits to be scored, and the scorers that have claimed it.

Submissions, and before them jobs: tickets of seasons that are over.

First come, first served, the reference rows before all others. A key has a second submission in
progress only while nobody else's waits, so that many scorers do not all work for one.

Whatever ends a claim without a result is a fault of the machine (a killed scorer, a full disk, a
sandbox that does not start) and never a verdict on the submission. It waits and is tried again: at
once after the first fault, then after 10 s, 20 s, 40 s … up to an hour. Meanwhile, others are
scored.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from leaderboard.documents.result import Result
from leaderboard.store.database import Database
from leaderboard.store.index import Index
from leaderboard.store.log import uptime

LEASE_SECONDS = 60.0
RETRY_SECONDS, LONGEST_RETRY_SECONDS = 10.0, 3600.0
"""After the second fault of a submission, and after many."""

MAX_FAULT = 500
"""Characters of a fault's text that are kept."""

_NO_NEWS = "its scorer stopped, or could not reach the board"
_ENDED = "its scorer ended without a result"

_CLAIMED = "held AND boot = ? AND expires > ?"
_CLAIMABLE = (
    "FROM entry LEFT JOIN lease ON submission = id WHERE status = 'waiting' "
    "AND (submission IS NULL OR boot <> ? OR expires <= ?)"
)
_NEXT = f"""
SELECT id, coalesce(attempt, 0), coalesce(faults, 0), coalesce(fault, '') {_CLAIMABLE}
ORDER BY reference DESC,
  key IN (SELECT key FROM lease JOIN entry ON id = submission WHERE held), sequence LIMIT 1
"""
_NEXT_JOB = """
SELECT id, coalesce(attempt, 0), coalesce(faults, 0), coalesce(fault, '')
FROM job LEFT JOIN lease ON submission = id
WHERE submission IS NULL OR boot <> ? OR expires <= ? ORDER BY job.rowid LIMIT 1
"""
_WAITING = """
SELECT id FROM (SELECT id, 2 AS rank, rowid AS at FROM job
  UNION ALL SELECT id, reference, sequence FROM entry WHERE status = 'waiting')
ORDER BY rank DESC, at
"""


@dataclass(frozen=True)
class Claim:
    """The right to write one submission's result, or to do a job, until another scorer claims it.

    Attributes:
      id: the submission's, or the job's.
      worker: the scorer's name.
      attempt: number of claims of this submission, this one included.
      seconds: how long the claim holds without a heartbeat.
    """

    id: str
    worker: str
    attempt: int
    seconds: float
    is_job: bool = False


class Queue:
    """The queue of one board."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add_jobs(self, ids: Iterable[str]) -> None:
        """Let scorers do jobs that the log does not know of, before submissions."""
        with self._database.transaction() as index:
            index.connection.executemany("INSERT OR IGNORE INTO job VALUES (?)", zip(ids))

    def end_job(self, claim: Claim) -> None:
        """Remove a job that is done."""
        with self._database.transaction() as index:
            index.connection.execute("DELETE FROM job WHERE id = ?", (claim.id,))
            index.connection.execute("DELETE FROM lease WHERE submission = ?", (claim.id,))

    def claim(
        self,
        worker: str,
        *,
        seconds: float = LEASE_SECONDS,
        submissions: bool = True,
        jobs: bool = False,
    ) -> Claim | None:
        """Claim the next job or submission that waits, is not claimed, and is not postponed.

        A claim holds for `seconds` of the machine's uptime, whatever its clock is set to;
        `heartbeat` renews it.

        Args:
          worker: the scorer's name, unique among those running.
          seconds: how long the claim holds without a heartbeat.
          submissions, jobs: what to claim.

        Returns:
          The claim; None if there is nothing to claim now.
        """
        with self._database.transaction() as index:
            _end_lost(index)
            boot, at = uptime()
            job = index.one(_NEXT_JOB, boot, at) if jobs else None
            row = index.one(_NEXT, boot, at) if submissions and job is None else job
            if row is None:
                return None
            self._database.signing_key()  # without it no result could follow
            id, attempts, faults, fault = row
            index.connection.execute(
                "REPLACE INTO lease VALUES (?, ?, ?, 1, ?, ?, ?, ?)",
                (id, worker, attempts + 1, faults, fault, boot, at + seconds),
            )
            return Claim(id, worker, attempts + 1, seconds, is_job=job is not None)

    def heartbeat(self, claim: Claim) -> bool:
        """Renew a claim.

        Returns:
          False if it is lost: the submission was claimed again, finished or withdrawn.
        """
        boot, at = uptime()
        with self._database.transaction() as index:
            if not _is_current(index, claim):
                return False
            index.connection.execute(
                "UPDATE lease SET held = 1, boot = ?, expires = ? WHERE submission = ?",
                (boot, at + claim.seconds, claim.id),
            )
        return True

    def release(self, claim: Claim) -> None:
        """Return a claim that ended without a fault of the machine; it can be claimed at once."""
        with self._database.transaction() as index:
            if _is_current(index, claim):
                _end(index, claim.id)

    def fault(self, claim: Claim, text: str) -> None:
        """Return a claim that ended in a fault of the machine; the submission is postponed.

        Args:
          claim: nothing happens if it is no longer current.
          text: the fault, as readers of the board see it.
        """
        with self._database.transaction() as index:
            if _is_current(index, claim):
                _end(index, claim.id, fault=text)

    def abandon(self, worker: str, fault: str = _ENDED) -> bool:
        """Declare a scorer dead, and end its claim.

        Args:
          worker: the scorer's name.
          fault: that ended it; empty if it was none, and its submission is not postponed.

        Returns:
          Whether it had a claim.
        """
        with self._database.transaction() as index:
            row = index.one("SELECT submission FROM lease WHERE worker = ?", worker)
            if row is not None:
                _end(index, row[0], fault=fault)
        return row is not None

    def retry(self) -> None:
        """End the postponement of every submission, for example after a fault was repaired."""
        with self._database.transaction() as index:
            _end_lost(index)
            index.connection.execute("UPDATE lease SET expires = 0 WHERE NOT held")

    def finish(self, claim: Claim, result: Result) -> bool:
        """Write a result, unless the submission was claimed again since.

        Returns:
          False if the claim is no longer current; then nothing is written.

        Raises:
          ValueError: the result is of another submission, suite or protocol.
        """
        document = self._database.document
        digests = (result.submission, result.suite, result.protocol)
        if digests != (claim.id, document.suite.digest, document.protocol.digest):
            raise ValueError(f"result of {digests} does not match {claim}")
        with self._database.transaction() as index:
            if not _is_current(index, claim):
                return False
            self._database.record("result", claim.id, result)
        return True

    def waiting(self) -> int:
        """Number of submissions with neither a result nor a withdrawal."""
        return self._count("FROM entry WHERE status = 'waiting'")

    def queued(self) -> int:
        """Number of waiting submissions that no fault has stopped so far."""
        return self._count(
            "FROM entry LEFT JOIN lease ON submission = id "
            "WHERE status = 'waiting' AND coalesce(faults, 0) = 0"
        )

    def done(self) -> int:
        """Number of submissions with a result or a withdrawal."""
        return self._count("FROM entry WHERE status NOT IN ('waiting', 'entered') AND track = ''")

    def claimable(self) -> int:
        """Number of waiting submissions that are neither claimed nor postponed."""
        return self._count(_CLAIMABLE, *uptime())

    def claimed(self) -> int:
        """Number of submissions that scorers work on."""
        return self._count(f"FROM lease WHERE {_CLAIMED}", *uptime())

    def faults(self) -> int:
        """Number of faults that waiting submissions have met."""
        with self._database.reading() as index:
            return index.number("SELECT coalesce(sum(faults), 0) FROM lease")

    def places(self) -> dict[str, int]:
        """The place of each job and submission that waits, from 1: first come, first served."""
        with self._database.reading() as index:
            waiting = index.connection.execute(_WAITING).fetchall()
        return {id: place for place, (id,) in enumerate(waiting, start=1)}

    def _count(self, clauses: str, *values: Any) -> int:
        with self._database.reading() as index:
            return index.number(f"SELECT count(*) {clauses}", *values)


def retry_seconds(faults: int) -> float:
    """How long a submission is postponed after its n-th fault."""
    if faults <= 1:
        return 0.0
    return min(RETRY_SECONDS * 2.0 ** min(faults - 2, 20), LONGEST_RETRY_SECONDS)


def _end_lost(index: Index) -> None:
    """End the claims that have expired."""
    lost = f"SELECT submission, worker FROM lease WHERE held AND NOT ({_CLAIMED})"
    for id, worker in index.connection.execute(lost, uptime()).fetchall():
        # It keeps its worker, who may be slow, and finish before anyone claims it again.
        _end(index, id, worker, fault=_NO_NEWS)


def _end(index: Index, id: str, worker: str = "", *, fault: str = "") -> None:
    """End a claim; after a fault of the machine, its submission is postponed.

    `worker` is who may still finish it.
    """
    boot, at = uptime()
    faults = index.number("SELECT faults FROM lease WHERE submission = ?", id) + bool(fault)
    text = " ".join(fault.split())[:MAX_FAULT]
    index.connection.execute(
        "UPDATE lease SET worker = ?, held = 0, faults = ?, fault = coalesce(nullif(?, ''), fault),"
        " boot = ?, expires = ? WHERE submission = ?",
        (worker, faults, text, boot, at + retry_seconds(faults) if fault else 0.0, id),
    )


def _is_current(index: Index, claim: Claim) -> bool:
    return (
        index.one(
            "SELECT 1 FROM lease WHERE submission = ? AND worker = ? AND attempt = ?",
            *(claim.id, claim.worker, claim.attempt),
        )
        is not None
    )
