"""`ranking`: a board's entries in order of a metric, with the ranks that their intervals allow.

    first = 1 + ranked entries whose interval lies wholly below
    last  = N − ranked entries whose interval lies wholly above

Entries are ranked if they are scored with enough runs, are no copy of earlier entries of other
keys, and are the latest of their key with their method's name and version, and with their
policies. The reference rows are listed among the others without a rank.

A decay below 0 is no merit, and one can be bought by acting worse inside the cube. Entries are
therefore ranked by OOD decay only if they have learned with certainty, and by

    max(0, D, D of every ranked entry that is at least as good in every region)

so that no entry stands above one that beats it everywhere. Ties are in order of the mean
normalised regret over all regions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from leaderboard.documents.result import REFERENCES, Estimate, Metric, Scores
from leaderboard.documents.submission import skeleton
from leaderboard.errors import NotPublishable
from leaderboard.store import EntryRow

NotRanked = Literal["", "reference", "too_few_runs", "copy", "superseded", "not_learned"]

TOLERANCE = 1e-6
LEARNED = 0.5  # the largest upper bound of N₀ of an entry ranked by OOD decay
AS_GOOD = 0.02
"""By how much N_m may be above another entry's and still count as at least as good.

Scores are estimates on states that differ between policies: of two policies that act alike, each
is better in some region by chance, by less than this on boards of 2,000 states in each region.
"""

REASONS: dict[str, str] = {
    "reference": "reference row",
    "too_few_runs": "too few runs on an instance or in a class",
    "copy": "at least half of its policies are copies of earlier entries of other keys",
    "superseded": "a later entry of its key has its method and version, or its policies",
    "not_learned": f"WD regret not certainly below {LEARNED:g}",
}
_Numbers = npt.NDArray[np.float64]
_BLOCK = 2**18  # pairs of entries compared at once, few enough for a processor cache


@dataclass(frozen=True)
class RankedRow:
    """A row of the ranking."""

    entry: EntryRow  # with scores
    first: int | None  # the best and the worst rank that the intervals allow; None if not ranked
    last: int | None
    reason: NotRanked  # why it is not ranked, a key of `REASONS`; empty if it is
    value: Estimate  # what it is ordered by: its score, or what the head of this module says

    @property
    def ranks(self) -> str:
        """`3`, or `2–5` if the intervals allow several ranks; empty without one."""
        if self.first is None:
            return ""
        return str(self.first) if self.last == self.first else f"{self.first}–{self.last}"

    def shown(self, metric: Metric) -> Estimate:
        """The score in a table: what the row ranks by, or the entry's own if it has no rank."""
        own: Estimate = getattr(self.entry.scores, metric)
        return own if self.first is None else self.value


def ranking(entries: list[EntryRow], metric: Metric) -> list[RankedRow]:
    """Every scored entry that is not withdrawn, ordered by its score, the best first.

    Lower is better in every metric; equal scores are in order of submission, equal decays in that
    of the mean regret over all regions.
    """
    history = superseded(entries)
    scored = [
        (entry, entry.scores, _reason(entry, entry.scores, metric, history))
        for entry in sorted(entries, key=lambda entry: entry.sequence)
        if entry.status == "scored" and entry.scores is not None
    ]
    ends = np.array(
        [(getattr(scores, metric).value, *getattr(scores, metric).ends) for _, scores, _ in scored]
    ).reshape(-1, 3)
    ranked = np.array([not reason for *_, reason in scored], dtype=bool)
    level = np.zeros(len(scored))
    if metric == "ood_decay":
        regions = _regret([scores for _, scores, _ in scored])
        ends = np.maximum(ends, 0.0)
        ends[ranked] = not_above_the_better(ends[ranked], regions[ranked])
        level = regions.mean(axis=1)
    first, last = np.zeros((2, len(scored)), dtype=np.int64)
    first[ranked], last[ranked] = rank_ranges(ends[ranked, 1], ends[ranked, 2])
    rows = []
    for i in np.lexsort((level, ends[:, 0])):
        entry, scores, reason = scored[i]
        best, worst = (None, None) if reason else (int(first[i]), int(last[i]))
        value, low, high = ends[i].tolist()
        if getattr(scores, metric).interval is None:
            low = high = None
        rows.append(
            RankedRow(entry, best, worst, reason, Estimate(value=value, low=low, high=high))
        )
    return rows


def superseded(entries: list[EntryRow]) -> set[str]:
    """Ids of the entries that are history: their key has a later one like them.

    Like them is one with the same method name and version, up to look-alike spelling, or with the
    same policies. Only an entry that can be ranked supersedes others.
    """
    latest: set[tuple[str, ...]] = set()
    history = set()
    for entry in sorted(entries, key=lambda entry: -entry.sequence):
        if entry.status != "scored" or _own_reason(entry):
            continue
        alike = {
            (entry.key, "method", skeleton(entry.method), *map(skeleton, entry.version.split("."))),
            (entry.key, "policies", entry.origin),
        }
        if alike & latest:
            history.add(entry.id)
        else:
            latest |= alike
    return history


def not_above_the_better(decay: _Numbers, regret: _Numbers) -> _Numbers:
    """Decays lifted to those of the entries that are at least as good in every region.

    Of `[N, K]` values and interval ends, and `[N, M + 1]` N_m of each region, of which another
    entry's is at least as good up to `AS_GOOD` above. In O(N² M), 0.3 s for 5,000 entries.
    """
    lifted = decay.copy()
    orders = np.argsort(-decay, axis=0, kind="stable")  # the largest first
    rows = max(1, _BLOCK // max(1, len(decay)))
    for start in range(0, len(decay), rows):
        block = slice(start, start + rows)
        better = np.ones((len(decay[block]), len(decay)), dtype=bool)
        for N in regret.T:
            better &= N[None, :] <= N[block, None] + AS_GOOD
        for column, order in enumerate(orders.T):
            largest = better[:, order].argmax(axis=1)  # each entry is as good as itself
            lifted[block, column] = decay[order[largest], column]
    return lifted


def _regret(scores: list[Scores]) -> _Numbers:
    """`[N, M + 1]` N_m of each entry and region, WD first."""
    rows = [[each.value for each in one.normalised_regret] for one in scores]
    return np.array(rows).reshape(len(rows), -1)


def rank_ranges(
    low: npt.ArrayLike, high: npt.ArrayLike
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The best and worst rank, in [1, N], that each of N intervals allows; in O(N log N)."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    first = 1 + np.searchsorted(np.sort(high), low, side="left")
    last = np.searchsorted(np.sort(low), high, side="right")
    return first.astype(np.int64), last.astype(np.int64)


def refuse_unpublishable(entries: list[EntryRow]) -> None:
    """Refuse (`NotPublishable`) a board whose reference rows do not have their known scores."""
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

    Excludes what follows from the similarity, where the constant policy's differs between regions.
    """
    for region, estimate in enumerate(scores.normalised_regret):
        yield f"normalised_regret.{region}", estimate.value, regret
    yield "wd_regret", scores.wd_regret.value, regret
    yield "ood_regret", scores.ood_regret.value, regret
    if not regret:
        yield "ood_decay", scores.ood_decay.value, 0.0
    yield "regret_slope", scores.regret_slope.value, 0.0


def _own_reason(entry: EntryRow) -> NotRanked:
    """Why a scored entry has no rank by any metric, whatever later entries there are."""
    if entry.reference:
        return "reference"
    if not entry.enough_runs:
        return "too_few_runs"
    return "copy" if entry.is_copy else ""


def _reason(entry: EntryRow, scores: Scores, metric: Metric, history: set[str]) -> NotRanked:
    reason = _own_reason(entry)
    if reason:
        return reason
    if entry.id in history:
        return "superseded"
    if metric == "ood_decay" and scores.wd_regret.ends[1] > LEARNED:
        return "not_learned"
    return ""
