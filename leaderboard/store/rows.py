"""`EntryRow`: an entrant as pages and ranking need it; what rows of all tracks have in common."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from typing import Literal

from leaderboard.documents.result import METRICS, Estimate, Scores
from leaderboard.store.copies import Copies

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
