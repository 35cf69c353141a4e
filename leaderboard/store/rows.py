"""`EntryRow`: an entrant as pages and ranking need it; `Copies`: what it copies."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Literal

import numpy as np

from leaderboard.documents.result import Scores

FEATURES, ALIKE, SAME_SCALE = 32, 0.001, 0.9

Status = Literal["waiting", "scored", "rejected", "withdrawn"]


@dataclass(frozen=True)
class Copies:
    """An earlier submission whose policies some runs of a submission act like."""

    id: str
    key: str
    runs: int  # of which each counts for the earliest submission that it is like


@dataclass(frozen=True)
class EntryRow:
    """One submission, as pages and ranking need it."""

    id: str
    sequence: int  # of the log entry that received it, and so the order of submission
    received: str
    status: Status  # a "withdrawn" one may have scores
    code: str  # of its rejection; empty if it was not rejected
    method: str
    version: str
    family: str
    knowledge: str
    submitter: str
    key: str
    code_link: str | None
    runs: int  # listed in the submission, failed ones included
    steps: int  # of all runs
    enough_runs: bool
    oracle_like: bool
    reference: bool  # whether it is one of the board's own rows, "optimal" and "constant"
    scores: Scores | None
    policies: int = 0  # runs with a policy
    alike: tuple[Copies, ...] = ()  # the board's own rows excluded; empty before scoring
    faults: int = 0  # that have ended its scoring while it waits; 0 in a read-only store
    fault: str = ""  # the last of them

    @property
    def copy_of(self) -> tuple[Copies, ...]:
        """Earlier submissions of other keys, the one with the most runs first."""
        others = (each for each in self.alike if each.key != self.key)
        return tuple(sorted(others, key=lambda each: -each.runs))

    @property
    def copied_runs(self) -> int:
        """Number of runs that behave like runs of earlier submissions of other keys."""
        return sum(each.runs for each in self.copy_of)

    @property
    def is_copy(self) -> bool:
        """Whether at least half of its policies are copied, and so it has no rank."""
        return self.copied_runs > 0 and 2 * self.copied_runs >= self.policies

    @property
    def origin(self) -> str:
        """The id of the submission that first had at least half of its policies; mostly its own."""
        first = max(self.alike, key=lambda each: each.runs, default=None)
        return self.id if first is None or 2 * first.runs < self.policies else first.id

    @property
    def steps_per_run(self) -> int:
        """Mean environment steps of the listed runs, rounded."""
        return round(self.steps / max(1, self.runs))


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
