"""`EntryRow`: an entrant as pages and ranking need it; `Copies`: whose runs act like earlier ones.

The order is that in which submissions were received, not scored: whoever copies a policy and is
scored first has copied nevertheless. The board's own reference rows are no source of copies.

Runs are alike if their actions on the board's states are exactly equal. Results of earlier
versions have sketches of 68 numbers instead, which are compared as those versions did: of half h of
their states (inside and outside the training cube), with K = 32 features,

    m_hk   moments of the error a − a*        ν_h   their mean variance        u_h   scale
    alike if mean_k (m_hk − m'_hk)² ≤ ALIKE min(u_h, u'_h)² + 2 (ν_h + ν'_h)
             and u_h, u'_h differ by at most a tenth, for both h
"""

from __future__ import annotations

import base64
import functools
import json
import sqlite3
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from leaderboard.documents.result import METRICS, Estimate, RunScore, Scores

SCHEMA = """
CREATE TABLE run (
  position INTEGER PRIMARY KEY, submission TEXT NOT NULL, sequence INTEGER NOT NULL,
  spec TEXT NOT NULL, actions TEXT NOT NULL, -- their digest, or a sketch
  first INTEGER -- sequence of the first submission with a run like it, if it is an earlier one
) STRICT;
CREATE INDEX run_actions ON run (spec, actions);
CREATE INDEX run_alike ON run (submission) WHERE first IS NOT NULL;
"""
FEATURES, ALIKE, SAME_SCALE = 32, 0.001, 0.9


@dataclass(frozen=True)
class Copies:
    """An earlier submission whose policies some runs of a submission act like.

    Attributes:
      id, key: of the earlier submission; of several, a run counts for the earliest.
      runs: number of such runs.
    """

    id: str
    key: str
    runs: int


def add_runs(
    connection: sqlite3.Connection, submission: str, sequence: int, runs: Iterable[RunScore]
) -> None:
    """Add the scored runs of a submission, and update the later ones that are like them."""
    for run in runs:
        actions = run.actions or run.sketch
        if run.spec is None or not actions:
            continue
        found = _runs_like(connection, run.spec, actions)
        earlier = [other for _, other in found if other < sequence]
        connection.execute(
            "INSERT INTO run (submission, sequence, spec, actions, first) VALUES (?, ?, ?, ?, ?)",
            (submission, sequence, run.spec, actions, min(earlier, default=None)),
        )
        connection.executemany(
            "UPDATE run SET first = min(coalesce(first, ?1), ?1) WHERE position = ?2",
            [(sequence, position) for position, other in found if other > sequence],
        )


def copies_of(
    connection: sqlite3.Connection, submission: str | None = None
) -> dict[str, tuple[Copies, ...]]:
    """The earlier submissions that each submission, or only this one, has runs like."""
    found: dict[str, list[Copies]] = defaultdict(list)
    for id, *copies in connection.execute(
        "SELECT run.submission, entry.id, entry.key, count(*) FROM run "
        "JOIN entry ON entry.sequence = run.first "
        "WHERE run.first IS NOT NULL AND (?1 IS NULL OR run.submission = ?1) "
        "GROUP BY run.submission, run.first ORDER BY run.submission, run.first",
        (submission,),
    ):
        found[id].append(Copies(*copies))
    return {id: tuple(each) for id, each in found.items()}


def _runs_like(connection: sqlite3.Connection, spec: str, actions: str) -> list[tuple[int, int]]:
    """Position and sequence of the runs on an instance that act like one."""
    if actions.startswith("sha256:"):
        return connection.execute(
            "SELECT position, sequence FROM run WHERE spec = ? AND actions = ?", (spec, actions)
        ).fetchall()
    rows = connection.execute(
        "SELECT position, sequence, actions FROM run "
        "WHERE spec = ? AND actions NOT LIKE 'sha256:%' ORDER BY position",
        (spec,),
    ).fetchall()
    alike = sketches_alike(actions, [row[2] for row in rows])
    return [row[:2] for row, is_alike in zip(rows, alike, strict=True) if is_alike]


def sketches_alike(one: str, others: list[str]) -> list[bool]:
    """Which sketches in base64 are like one; numbers that are not finite are like no others."""
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


Status = Literal["waiting", "scored", "rejected", "withdrawn"]


@dataclass(frozen=True)
class EntryRow:
    """One submission, as pages and ranking need it.

    Attributes:
      id: the submission's digest.
      sequence: number of the log entry that received it, and so the order of submission.
      received: time of that entry.
      status: a "withdrawn" one may have scores.
      code: of its rejection; empty if it was not rejected.
      runs: number of runs listed in the submission, failed ones included.
      steps: environment steps of all runs.
      reference: whether it is one of the board's own rows, "optimal" and "constant".
      scores: None if it was not scored.
      policies: number of runs with a policy.
      alike: earlier submissions with policies like this one's, the board's own rows excluded; empty
        before scoring.
      faults: how often a fault has ended its scoring while it waits, for example a killed scorer
        or a full disk; 0 in a read-only store, which does not know.
      fault: the last of them; empty if there is none.
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
    policies: int = 0
    alike: tuple[Copies, ...] = ()
    faults: int = 0
    fault: str = ""

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


def scores_text(scores: Scores) -> str:
    """Scores as lists of numbers without names, because rankings read thousands of them."""
    estimates = [getattr(scores, metric) for metric in METRICS] + list(scores.normalised_regret)
    return json.dumps([[each.value, each.low, each.high] for each in estimates])


@functools.lru_cache(maxsize=4096)  # frozen, and read again whenever the log grows
def scores_of(text: str) -> Scores:
    """The inverse of `scores_text`; not validated, because a valid `Result` was written."""
    estimates = [
        Estimate.model_construct(value=value, low=low, high=high)
        for value, low, high in json.loads(text)
    ]
    count = len(METRICS)
    named = dict(zip(METRICS, estimates[:count], strict=True))
    return Scores.model_construct(None, **named, normalised_regret=tuple(estimates[count:]))
