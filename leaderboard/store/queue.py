"""`Queue`: the submissions that wait to be scored, and the scorers that have claimed them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from leaderboard.documents.result import Result
from leaderboard.store.database import Database
from leaderboard.store.index import Index

LEASE_SECONDS = 60.0
ATTEMPTS = 5

_CLAIMABLE = (
    "FROM entry LEFT JOIN lease ON submission = id "
    "WHERE status = 'waiting' AND (submission IS NULL OR boot <> ? OR expires <= ?)"
)


@dataclass(frozen=True)
class Claim:
    """The right to write one submission's result until another scorer claims it.

    Attributes:
      id: the submission's.
      worker: the scorer's name.
      attempt: number of claims of this submission, this one included.
      seconds: how long the claim holds without a heartbeat.
    """

    id: str
    worker: str
    attempt: int
    seconds: float


class Queue:
    """The queue of one board."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def claim(self, worker: str, *, seconds: float = LEASE_SECONDS) -> Claim | None:
        """Claim the oldest submission that waits and is not claimed.

        A claim holds for `seconds` of the machine's uptime, whatever its clock is set to;
        `heartbeat` renews it. A submission whose claims were lost five times is rejected with
        `scoring_failed`. Reference rows are retried indefinitely: it is the machine that failed,
        and without them the board shows no scores.

        Args:
          worker: the scorer's name, unique among those running.
          seconds: how long the claim holds without a heartbeat.

        Returns:
          The claim; None if there is nothing to claim now.

        Raises:
          BoardError: the index cannot be written.
        """
        with self._database.transaction() as index:
            while True:
                row = index.one(
                    "SELECT id, reference, coalesce(attempt, 0), "
                    f"coalesce(lost, 0) + (worker IS NOT NULL) {_CLAIMABLE} "
                    "ORDER BY sequence LIMIT 1",
                    *_uptime(),
                )
                if row is None:
                    return None
                id, reference, attempts, lost = row
                if lost >= ATTEMPTS and not reference:
                    self._database.record("result", id, self._scoring_failed(id))
                    continue
                boot, at = _uptime()
                index.connection.execute(
                    "REPLACE INTO lease VALUES (?, ?, ?, ?, ?, ?)",
                    (id, worker, attempts + 1, lost, boot, at + seconds),
                )
                return Claim(id, worker, attempts + 1, seconds)

    def heartbeat(self, claim: Claim) -> bool:
        """Renew a claim.

        Returns:
          False if it is lost: the submission was claimed again, finished or withdrawn.
        """
        boot, at = _uptime()
        with self._database.transaction() as index:
            if not _is_current(index, claim):
                return False
            index.connection.execute(
                "UPDATE lease SET boot = ?, expires = ? WHERE submission = ?",
                (boot, at + claim.seconds, claim.id),
            )
        return True

    def release(self, claim: Claim) -> None:
        """Return a claim for reasons outside the submission; it does not count as lost."""
        with self._database.transaction() as index:
            if _is_current(index, claim):
                index.connection.execute(
                    "UPDATE lease SET worker = NULL, expires = 0 WHERE submission = ?", (claim.id,)
                )

    def abandon(self, worker: str) -> None:
        """Declare a scorer dead: its claim counts as lost and can be claimed at once."""
        with self._database.transaction() as index:
            index.connection.execute("UPDATE lease SET expires = 0 WHERE worker = ?", (worker,))

    def finish(self, claim: Claim, result: Result) -> bool:
        """Write a result, unless the submission was claimed again since.

        Returns:
          False if the claim is no longer current; then nothing is written.

        Raises:
          ValueError: the result is of another submission, suite or protocol.
          BoardError: it cannot be written.
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

    def done(self) -> int:
        """Number of submissions with a result or a withdrawal."""
        return self._count("FROM entry WHERE status <> 'waiting'")

    def failed(self) -> int:
        """Number of submissions rejected because all their claims were lost."""
        return self._count("FROM entry WHERE code = 'scoring_failed'")

    def claimable(self) -> int:
        """Number of waiting submissions that are not claimed."""
        return self._count(_CLAIMABLE, *_uptime())

    def _count(self, clauses: str, *values: Any) -> int:
        with self._database.reading() as index:
            return index.number(f"SELECT count(*) {clauses}", *values)

    def _scoring_failed(self, id: str) -> Result:
        return Result(
            submission=id,
            suite=self._database.document.suite.digest,
            protocol=self._database.document.protocol.digest,
            status="rejected",
            code="scoring_failed",
            message=f"the scorer failed {ATTEMPTS} times on this submission. "
            "Run `sme-leaderboard check` on it, then contact the board's owner.",
        )


def _is_current(index: Index, claim: Claim) -> bool:
    return (
        index.one(
            "SELECT 1 FROM lease WHERE submission = ? AND worker = ? AND attempt = ?",
            *(claim.id, claim.worker, claim.attempt),
        )
        is not None
    )


def _uptime() -> tuple[str, float]:
    """The machine's boot id, and seconds since boot: setting the clock changes neither."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
    return (boot.read_text().strip() if boot.exists() else ""), time.clock_gettime(clock)
