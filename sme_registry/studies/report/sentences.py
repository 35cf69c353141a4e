"""What findings are made of: thresholds, rows, and parts of sentences."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from sme_registry.diagnosis.questions import THRESHOLDS as DIAGNOSIS
from sme_registry.io.markup import fixed, plural, signed
from sme_registry.studies.report.analysis import ENOUGH_RUNS
from sme_registry.studies.report.tables import OFFLINE_INTERVAL

THRESHOLDS = {
    "unlearnt": DIAGNOSIS["unlearnt"],  # normalised regret, at least: almost nothing was learnt
    "broken": 0.2,  # change of normalised regret, at least
    "hurt": 0.05,  # at least; a smaller one hurts slightly
    "probability": 0.5,  # of improvement, for the better of two algorithms
    "enough_runs": float(ENOUGH_RUNS),  # with fewer runs or pairs a change is an indication
    "interval_runs": float(OFFLINE_INTERVAL),  # with fewer an improvement has no interval
    "near": 0.02,  # difference of r̃, at most: as good as
    "collapse": 0.1,  # of r̃ below the behaviour policy, at least
}

Found = Iterator[dict[str, Any]]
Rows = Sequence[Any]  # of a table, as named tuples


def finding(
    section: str, question: str, verdict: str, sentence: str, row: Any = None, **columns: Any
) -> dict[str, Any]:
    """A row of findings; those columns that `row`, of any table, has are taken from it."""
    result = {
        "section": section, "question": question, "verdict": verdict, "sentence": sentence,
        "algorithm": "", "class_name": "", "value": math.nan, "low": math.nan, "high": math.nan,
        "runs": None,
    }  # fmt: skip
    taken: dict[str, tuple[str, ...]] = {
        name: (name,) for name in ("class_name", "algorithm", "low", "high")
    }
    taken |= {"runs": ("pairs", "fewest_runs", "runs"), "value": ("change", "iqm", "value")}
    for column, names in taken.items():
        known = [getattr(row, name) for name in names if hasattr(row, name)]
        result[column] = known[0] if known else result[column]
    return result | columns


def missing_runs(section: str, counts: Counter[str]) -> Found:
    missing = counts["missing"] + counts["failed"]
    if missing:
        because = f", {counts['failed']:,} of them because they failed" if counts["failed"] else ""
        text = f"{missing:,} of {plural(counts['finished'] + missing, 'run')} are missing{because}."
        text += " No number includes them; the table of runs lists them."
        yield finding(section, "missing runs", "missing", text, value=missing)


def few_runs(section: str, fewest: int, one: str, many: str) -> Found:
    if fewest < ENOUGH_RUNS:
        yield finding(
            section, "few runs", "few",
            f"Some numbers rest on {plural(fewest, one, many)}. The 95 % bootstrap interval of 2 "
            "runs covers the truth in only 32–62 % of cases, of 3 runs in 48–86 %, depending on "
            "their distribution, and of 4 or more in 94–98 %. With fewer than "
            f"{plural(ENOUGH_RUNS, one, many)}, this report calls a change an indication at most.",
            runs=fewest,
        )  # fmt: skip


def change_text(row: Any) -> str:
    """The change of a row with its interval and the number of pairs."""
    if math.isnan(row.low):
        return f"{signed(row.change)}, a single pair, no interval"
    ends = f"95 % interval {signed(row.low)} to {signed(row.high)}"
    return f"{signed(row.change)}, {ends}, {plural(row.pairs, 'pair')}"


def lives_text(row: Any) -> str:
    if math.isnan(row.low):
        return " (a single life, no interval)"
    ends = f"95 % interval {fixed(row.low)} to {fixed(row.high)}"
    return f" ({ends}, {plural(row.runs, 'life', 'lives')})"


def ends_text(row: Any) -> str:
    return "" if math.isnan(row.low) else f" ({fixed(row.low)} to {fixed(row.high)})"


def side(row: Any, neutral: float) -> str:
    return "above" if row.low > neutral else "below" if row.high < neutral else "open"


def indication(row: Any) -> str:
    return "" if row.runs >= ENOUGH_RUNS else " (an indication)"
