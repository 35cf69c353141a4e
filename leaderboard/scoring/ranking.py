"""Who is how good, and how certainly: entries in order of a metric, with the ranks left open.

    first = 1 + ranked entries whose interval lies wholly below
    last  = N − ranked entries whose interval lies wholly above

Ranked is what was scored with enough runs, and by decay only what has certainly learned: the
constant policy loses nothing outside, because it has nothing. The reference rows stand among the
others without a rank.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from leaderboard.documents.result import Estimate, Scores
from leaderboard.errors import NotPublishable
from leaderboard.scoring.metrics import rank_ranges
from leaderboard.store import EntryRow

Metric = Literal["wd_regret", "ood_regret", "ood_decay"]

REFERENCES = {"optimal": 0.0, "constant": 1.0}  # N_m of each reference row, by its method's name
TOLERANCE = 1e-6
LEARNED = 0.5  # the greatest N₀ that an entry ranked by decay may have

IS_REFERENCE = "reference"
TOO_FEW_RUNS = "too few runs"
NOT_LEARNED = f"WD regret not certainly below {LEARNED:g}"


@dataclass(frozen=True)
class RankedRow:
    """A row of the ranking.

    Attributes:
      entry: with its scores; never null here.
      first, last: the best and the worst rank that the intervals leave open; None where the entry
        is not ranked.
      reason: why it is not; empty where it is.
    """

    entry: EntryRow
    first: int | None
    last: int | None
    reason: str


def ranking(entries: list[EntryRow], metric: Metric) -> list[RankedRow]:
    """Every entry that has scores and stands, in order of its score, the best first.

    Args:
      entries: of a board, in any order.
      metric: "wd_regret" (N₀), "ood_regret" (N̄) or "ood_decay" (N̄ − N₀); lower is better.

    Returns:
      The rows; those with equal scores in the order in which they were received.
    """
    scored = [
        (_estimate(entry.scores, metric), entry, _reason(entry, entry.scores, metric))
        for entry in entries
        if entry.status == "scored" and entry.scores is not None
    ]
    scored.sort(key=lambda row: (row[0].value, row[1].sequence))
    ranked = [estimate for estimate, _, reason in scored if not reason]
    first, last = rank_ranges([one.low for one in ranked], [one.high for one in ranked])
    ranges = iter(zip(first.tolist(), last.tolist(), strict=True))
    rows = []
    for _, entry, reason in scored:
        best, worst = (None, None) if reason else next(ranges)
        rows.append(RankedRow(entry, best, worst, reason))
    return rows


def refuse_unpublishable(entries: list[EntryRow]) -> None:
    """Refuse to show any number of a board whose reference rows are not what they must be.

    Raises:
      NotPublishable: one is missing or not scored, or leaves 0 or 1 by more than 1e-6.
    """
    for name, regret in REFERENCES.items():
        rows = [entry for entry in entries if entry.reference and entry.method == name]
        found = [row.scores for row in rows if row.status == "scored" and row.scores is not None]
        if not found:
            status = rows[-1].status if rows else "missing"
            advice = (
                "Make the board anew, with `sme-leaderboard init`: a rejection is for good"
                if status == "rejected"
                else "Run `sme-leaderboard score` on the board"
            )
            raise NotPublishable(
                f"reference row {name!r}: {status}: must be scored before anything of this board "
                f"is shown. {advice}."
            )
        for scores in found:
            for what, value, expected in _to_hold(scores, regret):
                if not abs(value - expected) <= TOLERANCE:
                    raise NotPublishable(
                        f"reference row {name!r}: {what}={value!r}: must be {expected:g} within "
                        f"{TOLERANCE:g}. The scoring here is at fault, so nothing of this board "
                        "is shown. Compare the versions in its result with another machine's."
                    )


def _to_hold(scores: Scores, regret: float) -> Iterator[tuple[str, float, float]]:
    """What, how much, and how much it must be, of a reference row with this regret everywhere.

    Excludes the similarity loss: the constant policy's similarity differs between regions.
    """
    for region, estimate in enumerate(scores.normalised_regret):
        yield f"normalised_regret.{region}", estimate.value, regret
    yield "wd_regret", scores.wd_regret.value, regret
    yield "ood_regret", scores.ood_regret.value, regret
    yield "ood_decay", scores.ood_decay.value, 0.0
    yield "regret_slope", scores.regret_slope.value, 0.0


def _estimate(scores: Scores, metric: Metric) -> Estimate:
    estimate: Estimate = getattr(scores, metric)
    return estimate


def _reason(entry: EntryRow, scores: Scores, metric: Metric) -> str:
    """Why an entry is not ranked; empty where it is."""
    if entry.reference:
        return IS_REFERENCE
    if not entry.enough_runs:
        return TOO_FEW_RUNS
    if metric == "ood_decay" and scores.wd_regret.high > LEARNED:
        return NOT_LEARNED
    return ""
