"""`Queue`: what waits to be scored, and the scorers that have claimed it.

Submissions, and before them jobs: tickets of seasons that are over. First come, first served, the
reference rows before all others. A key has a second submission in progress only while nobody else's
waits, so that many scorers do not all work for one.

Whatever ends a claim without a result is a fault of the machine (a killed scorer, a full disk, a
sandbox that does not start) and never a verdict on the submission. It waits and is tried again: at
once after the first fault, then after 10 s, 20 s, 40 s … up to an hour. Meanwhile, others are
scored.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from leaderboard.documents.result import Result
from leaderboard.store.index import Index
from leaderboard.store.log import uptime

if TYPE_CHECKING:
    from leaderboard.store import Store

LEASE_SECONDS = 60.0
RETRY_SECONDS, LONGEST_RETRY_SECONDS = 10.0, 3600.0
"""After the second fault of a submission, and after many."""

MAX_FAULT = 500
"""Characters of a fault's text that are kept."""

_FREE = "(submission IS NULL OR boot <> ?1 OR expires <= ?2)"
_HELD = "held AND boot = ?1 AND expires > ?2"
_ENTRIES = "FROM entry LEFT JOIN lease ON submission = id"
_WAITS = "status = 'waiting' AND track = ''"
_LEASE = "SELECT id, coalesce(attempt, 0), coalesce(faults, 0), coalesce(fault, '')"
_NEXT = f"""
{_LEASE} {_ENTRIES} WHERE {_WAITS} AND {_FREE} ORDER BY reference DESC,
  key IN (SELECT key FROM lease JOIN entry ON id = submission WHERE held), sequence LIMIT 1
"""
_NEXT_JOB = f"""
{_LEASE} FROM job LEFT JOIN lease ON submission = id WHERE {_FREE} ORDER BY job.rowid LIMIT 1
"""
_WAITING = f"""
SELECT id FROM (SELECT id, 2 AS rank, rowid AS at FROM job
  UNION ALL SELECT id, reference, sequence FROM entry WHERE {_WAITS})
ORDER BY rank DESC, at
"""

Counted = Literal["waiting", "queued", "claimable", "claimed", "done", "faults"]
_COUNTED: dict[Counted, str] = {
    "waiting": f"count(*) FROM entry WHERE {_WAITS}",
    "queued": f"count(*) {_ENTRIES} WHERE {_WAITS} AND coalesce(faults, 0) = 0",
    "claimable": f"count(*) {_ENTRIES} WHERE {_WAITS} AND {_FREE}",
    "claimed": f"count(*) FROM lease WHERE {_HELD}",
    "done": "count(*) FROM entry WHERE status <> 'waiting' AND track = ''",
    "faults": "coalesce(sum(faults), 0) FROM lease",
}
"""Submissions without result or withdrawal, those of them that no fault has stopped, and those that
are neither claimed nor postponed; those that scorers work on; those with result or withdrawal; and
the faults that waiting ones have met."""


@dataclass(frozen=True)
class Claim:
    """The right to write a submission's result, or to do a job, until another claims it."""

    id: str
    worker: str
    attempt: int
    seconds: float
    is_job: bool = False


class Queue:
    """The queue of one board."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def add_jobs(self, ids: Iterable[str]) -> None:
        """Let scorers do jobs that the log does not know of, before submissions."""
        with self._store.transaction() as index:
            index.connection.executemany("INSERT OR IGNORE INTO job VALUES (?)", zip(ids))

    def end_job(self, claim: Claim) -> None:
        """Remove a job that is done."""
        with self._store.transaction() as index:
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

        It holds for `seconds` of the machine's uptime, whatever its clock is set to.
        """
        with self._store.transaction() as index:
            _end_lost(index)
            boot, at = uptime()
            job = index.one(_NEXT_JOB, boot, at) if jobs else None
            row = index.one(_NEXT, boot, at) if submissions and job is None else job
            if row is None:
                return None
            self._store.signing_key()  # without it no result could follow
            id, attempts, faults, fault = row
            index.connection.execute(
                "REPLACE INTO lease VALUES (?, ?, ?, 1, ?, ?, ?, ?)",
                (id, worker, attempts + 1, faults, fault, boot, at + seconds),
            )
            return Claim(id, worker, attempts + 1, seconds, is_job=job is not None)

    def heartbeat(self, claim: Claim) -> bool:
        """Renew a claim; False if it is lost: claimed again, finished or withdrawn."""
        boot, at = uptime()
        with self._store.transaction() as index:
            if not _is_current(index, claim):
                return False
            index.connection.execute(
                "UPDATE lease SET held = 1, boot = ?, expires = ? WHERE submission = ?",
                (boot, at + claim.seconds, claim.id),
            )
        return True

    def release(self, claim: Claim, fault: str = "") -> None:
        """Return a claim, if it is current; a fault, which readers see, postpones it."""
        with self._store.transaction() as index:
            if _is_current(index, claim):
                _end(index, claim.id, fault=fault)

    def abandon(self, worker: str, fault: str = "its scorer ended without a result") -> bool:
        """Declare a scorer dead, end its claim as `release` does, and return whether it had one."""
        with self._store.transaction() as index:
            row = index.one("SELECT submission FROM lease WHERE worker = ?", worker)
            if row is not None:
                _end(index, row[0], fault=fault)
        return row is not None

    def retry(self) -> None:
        """End the postponement of every submission, for example after a fault was repaired."""
        with self._store.transaction() as index:
            _end_lost(index)
            index.connection.execute("UPDATE lease SET expires = 0 WHERE NOT held")

    def finish(self, claim: Claim, result: Result) -> bool:
        """Write a result; False, and nothing is written, if the claim is no longer current."""
        with self._store.transaction() as index:
            if not _is_current(index, claim):
                return False
            self._store.record("result", claim.id, result)
        return True

    def count(self, what: Counted) -> int:
        """How many there are of something in the queue."""
        statement = _COUNTED[what]
        values = uptime() if "?1" in statement else ()
        [(count,)] = self._store.query(f"SELECT {statement}", *values)
        return int(count)

    def places(self) -> dict[str, int]:
        """The place of each job and submission that waits, from 1: first come, first served."""
        return {id: place for place, (id,) in enumerate(self._store.query(_WAITING), start=1)}


def retry_seconds(faults: int) -> float:
    """How long a submission is postponed after its n-th fault."""
    if faults <= 1:
        return 0.0
    return min(RETRY_SECONDS * 2.0 ** min(faults - 2, 20), LONGEST_RETRY_SECONDS)


def _end_lost(index: Index) -> None:
    """End the claims that have expired."""
    lost = f"SELECT submission, worker FROM lease WHERE held AND NOT ({_HELD})"
    for id, worker in index.connection.execute(lost, uptime()).fetchall():
        # It keeps its worker, who may be slow, and finish before anyone claims it again.
        _end(index, id, worker, fault="its scorer stopped, or could not reach the board")


def _end(index: Index, id: str, worker: str = "", *, fault: str = "") -> None:
    """End a claim, which `worker` may still finish; after a fault, its submission is postponed."""
    boot, at = uptime()
    (faults,) = index.one("SELECT faults FROM lease WHERE submission = ?", id) or (0,)
    faults += bool(fault)
    text = " ".join(fault.split())[:MAX_FAULT]
    index.connection.execute(
        "UPDATE lease SET worker = ?, held = 0, faults = ?, fault = coalesce(nullif(?, ''), fault),"
        " boot = ?, expires = ? WHERE submission = ?",
        (worker, faults, text, boot, at + retry_seconds(faults) if fault else 0.0, id),
    )


def _is_current(index: Index, claim: Claim) -> bool:
    row = index.one("SELECT worker, attempt FROM lease WHERE submission = ?", claim.id)
    return row == (claim.worker, claim.attempt)
