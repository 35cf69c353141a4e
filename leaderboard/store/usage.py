"""`Usage`: what a key has uploaded and submitted, and the size of all artefacts, for the quotas."""

from __future__ import annotations

from leaderboard.store.database import Database


class Usage:
    """The usage of one board."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def uploaded_bytes(self, key: str, since: str) -> int:
        """Bytes that a key has uploaded since a time in the form of `submission.now()`."""
        with self._database.reading() as index:
            return index.number(
                "SELECT (SELECT coalesce(sum(size), 0) FROM object WHERE key = ?1 AND received >= "
                "?2) + (SELECT coalesce(sum(size), 0) FROM upload WHERE key = ?1 AND time >= ?2)",
                *(key, since),
            )

    def submission_times(self, key: str, since: str) -> list[str]:
        """When each submission of a key since a time was received, in order."""
        with self._database.reading() as index:
            rows = index.connection.execute(
                "SELECT received FROM entry WHERE key = ? AND received >= ? ORDER BY received",
                (key, since),
            )
            return [received for (received,) in rows]

    def total_bytes(self) -> int:
        """Bytes of all artefacts."""
        with self._database.reading() as index:
            return index.number(
                "SELECT (SELECT coalesce(sum(size), 0) FROM object)"
                " + (SELECT coalesce(sum(size), 0) FROM upload)"
            )
