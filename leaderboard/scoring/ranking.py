"""`ranking`: a board's entries in order of a metric, with the ranks that their intervals allow.

    first = 1 + ranked entries whose interval lies wholly below
    last  = N − ranked entries whose interval lies wholly above

Entries are ranked if they are scored with enough runs. By OOD decay, they must also have learned
with certainty: the constant policy loses nothing outside, because it has learned nothing. The
reference rows are listed among the others without a rank.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from leaderboard.documents.result import Metric, Scores
from leaderboard.errors import NotPublishable
from leaderboard.store import EntryRow

NotRanked = Literal["", "reference", "too_few_runs", "not_learned"]

REFERENCES = {"optimal": 0.0, "constant": 1.0}  # N_m of each reference row, by its method's name
TOLERANCE = 1e-6
LEARNED = 0.5  # the largest upper bound of N₀ of an entry ranked by OOD decay

REASONS: dict[str, str] = {
    "reference": "reference row",
    "too_few_runs": "too few runs in a class",
    "not_learned": f"WD regret not certainly below {LEARNED:g}",
}


@dataclass(frozen=True)
class RankedRow:
    """A row of the ranking.

    Attributes:
      entry: the entry; its scores are never null here.
      first, last: the best and the worst rank that the intervals allow; None if not ranked.
      reason: why it is not ranked, a key of `REASONS`; empty if it is.
    """

    entry: EntryRow
    first: int | None
    last: int | None
    reason: NotRanked

    @property
    def ranks(self) -> str:
        """`3`, or `2–5` if the intervals allow several ranks; empty without one."""
        if self.first is None:
            return ""
        return str(self.first) if self.last == self.first else f"{self.first}–{self.last}"


def ranking(entries: list[EntryRow], metric: Metric) -> list[RankedRow]:
    """Every scored entry that is not withdrawn, ordered by its score, the best first.

    Lower is better in every metric; equal scores are in order of submission.
    """
    scored = [
        (getattr(entry.scores, metric), entry, _reason(entry, entry.scores, metric))
        for entry in entries
        if entry.status == "scored" and entry.scores is not None
    ]
    scored.sort(key=lambda row: (row[0].value, row[1].sequence))
    ranked = [estimate for estimate, _, reason in scored if not reason]
    ends = np.array([each.ends for each in ranked]).reshape(-1, 2)
    first, last = rank_ranges(ends[:, 0], ends[:, 1])
    ranges = zip(first.tolist(), last.tolist(), strict=True)
    rows = []
    for _, entry, reason in scored:
        best, worst = (None, None) if reason else next(ranges)
        rows.append(RankedRow(entry, best, worst, reason))
    return rows


def rank_ranges(
    low: npt.ArrayLike, high: npt.ArrayLike
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The best and the worst rank that each entry's interval allows; lower scores are better.

    Args:
      low: `[N]` lower ends.
      high: `[N]` upper ends, none below its lower end.

    Returns:
      `first` and `last`, `[N]` each, 1 ≤ first ≤ last ≤ N. In O(N log N).
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    first = 1 + np.searchsorted(np.sort(high), low, side="left")
    last = np.searchsorted(np.sort(low), high, side="right")
    return first.astype(np.int64), last.astype(np.int64)


def refuse_unpublishable(entries: list[EntryRow]) -> None:
    """Refuse to publish numbers of a board whose reference rows do not have their known scores.

    Raises:
      NotPublishable: a reference row is missing or not scored, or differs from 0 or 1 by more than
        1e-6.
    """
    for name, regret in REFERENCES.items():
        rows = [entry for entry in entries if entry.reference and entry.method == name]
        scored = [row.scores for row in rows if row.status == "scored" and row.scores is not None]
        if not scored:
            status = rows[-1].status if rows else "missing"
            advice = (
                "Create the board again with `sme-leaderboard init`: a rejection is final"
                if status == "rejected"
                else "Wait for the running `serve`, or run `sme-leaderboard score` on the board"
                if status == "waiting"
                else "Run `sme-leaderboard score` on the board"
            )
            raise NotPublishable(
                f"reference row {name!r}: {status}: must be scored before the board publishes any "
                f"number. {advice}.",
                waiting=status == "waiting",
            )
        for scores in scored:
            for field, value, expected in _known_scores(scores, regret):
                if not abs(value - expected) <= TOLERANCE:
                    raise NotPublishable(
                        f"reference row {name!r}: {field}={value!r}: must be {expected:g} within "
                        f"{TOLERANCE:g}. Scoring is faulty here, so the board publishes no number. "
                        "Compare the versions in this result with those of another machine."
                    )


def _known_scores(scores: Scores, regret: float) -> Iterator[tuple[str, float, float]]:
    """Field, value and expected value of a reference row with this regret in every region.

    Excludes the similarity loss: the constant policy's similarity differs between regions.
    """
    for region, estimate in enumerate(scores.normalised_regret):
        yield f"normalised_regret.{region}", estimate.value, regret
    yield "wd_regret", scores.wd_regret.value, regret
    yield "ood_regret", scores.ood_regret.value, regret
    yield "ood_decay", scores.ood_decay.value, 0.0
    yield "regret_slope", scores.regret_slope.value, 0.0


def _reason(entry: EntryRow, scores: Scores, metric: Metric) -> NotRanked:
    if entry.reference:
        return "reference"
    if not entry.enough_runs:
        return "too_few_runs"
    if metric == "ood_decay" and scores.wd_regret.ends[1] > LEARNED:
        return "not_learned"
    return ""
