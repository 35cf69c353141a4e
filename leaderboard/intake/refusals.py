"""`Refusals`: the submissions that a server has refused within a day.

They count towards their key's quota, because checking one costs time, and a refusal that can no
longer change is repeated without a check.
"""

from __future__ import annotations

import datetime
import threading
from collections import Counter
from typing import Any

from leaderboard.documents.submission import Envelope, utc
from leaderboard.errors import Rejection
from leaderboard.intake.uploads import quota_window

KEPT = 10_000
"""Refusals; about 10 MB. Keys cost nothing, so whoever wants the oldest forgotten can have it."""

_UNCOUNTED = ("quota", "withdrawn", "wrong_board")
"""Refusals that a stranger can cause who sends a public document again, and that cost nothing."""

_PASSING = ("artefact_missing", "stale_time")
"""Refusals of a document that may be accepted later."""


class Refusals:
    """The refusals of one server, at most `KEPT`; for any number of threads."""

    def __init__(self, kept: int = KEPT) -> None:
        self._kept = kept
        self._lock = threading.Lock()
        self._times: list[tuple[str, str]] = []  # key and time, oldest first
        self._counts: Counter[str] = Counter()
        self._final: dict[str, Rejection] = {}

    def add(self, envelope: Envelope[Any], rejection: Rejection, at: datetime.datetime) -> None:
        """Remember the refusal of a submission at a time."""
        if rejection.code in _UNCOUNTED:
            return
        with self._lock:
            self._times.append((envelope.key, utc(at)))
            self._counts[envelope.key] += 1
            for key, _ in self._times[: -self._kept]:
                self._counts -= Counter([key])
            del self._times[: -self._kept]
            if rejection.code not in _PASSING:
                self._final[envelope.id] = rejection
            while len(self._final) > self._kept:
                del self._final[next(iter(self._final))]

    def repeat(self, id: str) -> None:
        """Raise the rejection of a submission that was refused for good."""
        with self._lock:
            rejection = self._final.get(id)
        if rejection is not None:
            raise Rejection(rejection.code, rejection.message)

    def times(self, key: str, at: datetime.datetime) -> list[str]:
        """When submissions of a key were refused within the day before `at`, in order."""
        since, until = quota_window(at)
        with self._lock:
            if key not in self._counts:
                return []
            return [time for each, time in self._times if each == key and since < time <= until]
