"""`findings`: what a study found, as a table with a verdict and a sentence in each row.

A change or a metric counts if its 95 % interval excludes the neutral value, 0 or for a ratio 1; it
is an indication if it rests on fewer than `ENOUGH_RUNS` pairs of runs or lives. Any other is open,
which does not mean that there is no effect.

    section      tasks, comparison, caveats, offline, streams, stream_changes, stream_caveats
    algorithm, class_name    what it is about; "" where it is about several
    question, verdict        what was asked, and the answer
    value, low, high, runs   the number it rests on, its interval, and its runs, pairs or lives
    sentence     for people
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import pandas as pd

from sme_registry.diagnosis.questions import THRESHOLDS as DIAGNOSIS
from sme_registry.io.markup import conjunction, fixed, plural, signed
from sme_registry.studies.report.analysis import (
    ENOUGH_RUNS,
    OFFLINE_INTERVAL,
    Analysis,
    training_data,
)
from sme_registry.studies.report.design import ALL, SEVERAL, axis_label
from sme_registry.studies.report.frames import frame

COLUMNS = (
    "section:str algorithm:str class_name:str question:str verdict:str value low high runs:Int64 "
    "sentence:str"
)
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
_WD, _OOD = "wd_regret", "ood_regret"
_CHANCE = 0.05  # share of 95 % intervals that exclude 0 without an effect
_UNLEARNT = THRESHOLDS["unlearnt"]


Found = Iterator[dict[str, Any]]
Finder = Callable[[Analysis], Found]
Rows = Sequence[Any]  # of a table, as named tuples
FINDERS: list[Finder] = []


def finder(find: Finder) -> Finder:
    """Register a function that finds something, in the order of the page."""
    FINDERS.append(find)
    return find


def findings(analysis: Analysis) -> pd.DataFrame:
    """The findings of a study, from its tables."""
    return frame([row for find in FINDERS for row in find(analysis)], COLUMNS)


@finder
def _tasks(analysis: Analysis) -> Found:
    """Which property of the task breaks each learner, and how sure that is."""
    levels = analysis.tables["levels"]
    for name in analysis.learners:
        about = functools.partial(finding, "tasks", algorithm=name)
        contrasts = _contrasts(analysis, name, _WD)
        if not contrasts:
            yield about(
                "contrasts", "none",
                f"{name} has no contrasts yet: no run on the first class, {analysis.base}, has a "
                "run of the same number on another class.",
            )  # fmt: skip
            continue
        rows = levels[(levels.algorithm == name) & (levels.metric == _WD)]
        of_class = {row.class_name: row for row in rows.itertuples()}
        base = of_class.get(analysis.base)
        if base is not None and base.iqm >= _UNLEARNT:
            yield about(
                "first class", "unlearnt",
                f"{name} has learnt almost nothing on the first class: its WD regret there is "
                f"{fixed(base.iqm)}, and the constant action's is 1. What was not learnt cannot "
                "break, so the contrasts need a longer budget.",
                value=base.iqm,
            )  # fmt: skip
        worst = _largest(c for c in contrasts if c.verdict == "worse")
        if worst is None:
            yield from _no_worst(about, name, contrasts)
            continue
        yield from _worst(about, name, contrasts, worst)
        yield from _other_axes(about, contrasts, worst)
        yield from _outside(about, _contrasts(analysis, name, _OOD), worst)


def _no_worst(about: Any, name: str, contrasts: Rows) -> Found:
    """What is known of a learner that no class was shown to make worse."""
    yield about(
        "worst", "none_shown",
        f"No class was shown to make {name} worse within distribution. That does not show that "
        "none does.",
    )  # fmt: skip
    better = [c for c in contrasts if c.verdict == "better"]
    if better:
        text = f"Its WD regret is lower than on the first class with {_listed(better)}."
        yield about("other axes", "better", text)


def _worst(about: Any, name: str, contrasts: Rows, worst: Any) -> Found:
    larger = _of_each_axis(c for c in contrasts if c.change > worst.change)
    size = [worst.change >= THRESHOLDS["broken"], worst.change >= THRESHOLDS["hurt"], True]
    severity = ("broken", "hurt", "slightly_hurt")[size.index(True)]
    is_hurt = severity.replace("_", " ") + ("" if larger else " most")
    text = (
        f"{name} is {is_hurt} by {_property(worst)}: on {worst.class_name} its WD regret rises "
        f"from {fixed(worst.base)} to {fixed(worst.level)}, by {change_text(worst)}."
    )
    yield about("worst", severity, text, worst)
    rivals = _of_each_axis(c for c in contrasts if c.axis != worst.axis and not c.high < worst.low)
    verdict = "certain"
    text = f"It is the worst of the axes varied here: its interval begins at {signed(worst.low)}, "
    text += "above the end of every other axis."
    if not worst.enough_pairs:
        verdict = "indication"
        text = f"This is an indication, not a finding: it rests on {plural(worst.pairs, 'pair')} "
        text += f"of runs, and {ENOUGH_RUNS} would be enough."
    elif rivals:
        verdict, text = "rivals", "The interval shows that it hurts, but not that it hurts most: "
        text += f"the intervals allow a larger change by {_listed(rivals)}."
    elif len({c.axis for c in contrasts}) == 1:
        verdict, text = "only_axis", "The interval shows that it hurts; no other axis was varied."
    yield about("certainty", verdict, text, worst)


def _other_axes(about: Any, contrasts: Rows, worst: Any) -> Found:
    worse = _of_each_axis(c for c in contrasts if c.verdict == "worse" and c.axis != worst.axis)
    still_open = _of_each_axis(c for c in contrasts if c.verdict != "worse")
    certain, few = ([c for c in worse if c.enough_pairs == enough] for enough in (True, False))
    if certain:
        yield about("other axes", "worse", f"Also worse by {_listed(certain)}.")
    if few:
        text = f"There are indications that it is made worse by {_listed(few)}."
        yield about("other axes", "indication", text)
    if still_open:
        text = f"Not shown to make it worse: {_listed(still_open)}."
        yield about("other axes", "open", f"{text} A wide interval means too few runs.")


def _outside(about: Any, contrasts: Rows, worst: Any) -> Found:
    far = _largest(c for c in contrasts if c.verdict == "worse")
    if far is not None:
        larger = _of_each_axis(c for c in contrasts if c.change > far.change)
        what = "the same property" if far.axis == worst.axis else _property(far)
        costs = "costs" if larger else "costs most"
        text = f"Out of distribution, {what} {costs}: {_listed([far])}."
        yield about("out of distribution", "worse", text, far)


@finder
def _comparison(analysis: Analysis) -> Found:
    """The best learner over all classes among those with equal data, and its rivals."""
    rows = analysis.tables["aggregates"]
    rows = rows[(rows.group == ALL) & (rows.metric == _WD) & (rows.statistic == "iqm")]
    compared = list(rows[rows.algorithm.isin(analysis.learners)].itertuples())
    of_all = dict(zip(analysis.runs.algorithm, analysis.runs.steps.tolist(), strict=True))
    steps = {row.algorithm: of_all[row.algorithm] for row in compared}
    if len(set(steps.values())) > 1:
        listed = ", ".join(f"{name} {count:,}" for name, count in steps.items())
        yield finding("comparison", "training steps", "differ", f"Training steps differ: {listed}.")
    data = training_data(analysis.runs)
    for shared in dict.fromkeys(data[row.algorithm] for row in compared):
        alike = [row for row in compared if data[row.algorithm] == shared]
        if len(alike) < 2:
            continue
        best = max(alike, key=lambda row: row.value)
        nu, transitions = shared or (math.nan, 0)
        of_data = f" of those with {transitions:,} transitions of ν = {nu:g}," if shared else ""
        yield finding(
            "comparison", "best", "best",
            f"Over the {plural(best.classes, 'class', 'classes')} on which all have runs,{of_data} "
            f"{best.algorithm} is best within distribution: {fixed(best.value)}{ends_text(best)}, "
            "where 1 is the optimum and 0 the constant ½.",
            best, class_name="",
        )  # fmt: skip
        yield from _rivals(analysis, best.algorithm, {row.algorithm for row in alike})


def _rivals(analysis: Analysis, best: str, among: set[str]) -> Found:
    rows = analysis.tables["improvements"]
    for row in rows[(rows.group == ALL) & (rows.metric == _WD)].itertuples():
        if best not in (row.first, row.second) or not {row.first, row.second} <= among:
            continue
        value, low, high, other = row.probability, row.low, row.high, row.second
        if row.second == best:
            value, low, high, other = 1.0 - value, 1.0 - high, 1.0 - low, row.first
        verdict, end = "open", ", so either may be better."
        if low > THRESHOLDS["probability"]:
            enough = row.fewest_runs >= ENOUGH_RUNS
            verdict = "better" if enough else "indication"
            end = "." if enough else ", an indication from few runs."
        numbers = {"value": value, "low": low, "high": high, "runs": row.fewest_runs}
        text = f"One of its runs beats one of {other} with probability {fixed(value)}"
        interval = "" if math.isnan(low) else f" ({fixed(low)} to {fixed(high)})"
        yield finding(
            "comparison", "rival", verdict, f"{text}{interval}{end}", algorithm=best, **numbers
        )


@finder
def _caveats(analysis: Analysis) -> Found:
    rows = analysis.tables["contrasts"]
    rows = rows[rows.algorithm.isin(analysis.learners)]
    yield from missing_runs("caveats", analysis.counts(streams=False))
    if not rows.empty:
        yield from few_runs("caveats", rows.pairs.min(), "pair of runs", "pairs of runs")
    intervals = int(((rows.metric == _WD) & rows.low.notna()).sum())
    if intervals > 1:
        value = max(1, round(_CHANCE * intervals))
        yield finding(
            "caveats", "chance", "expected",
            f"There are {intervals} contrasts within distribution, each with its own interval. If "
            f"nothing had an effect, about {value} of them would exclude 0 by chance.",
            value=value,
        )  # fmt: skip
    init = {name: info.setting["policy_init"] for name, info in analysis.classes.items()}
    other = [
        name
        for name, info in analysis.classes.items()
        if info.axis != "policy_init" and init[name] != init[analysis.base]
    ]
    if other:
        yield finding(
            "caveats", "policy_init", "differs",
            f"The policy_init of {conjunction(other)} also differs from the first class’s, as deep "
            "tasks require. The contrasts include its effect.",
        )  # fmt: skip


def _contrasts(analysis: Analysis, algorithm: str, metric: str) -> Rows:
    rows = analysis.tables["contrasts"]
    rows = rows[(rows.algorithm == algorithm) & (rows.metric == metric)]
    setting = rows.class_name.map({name: c.label for name, c in analysis.classes.items()})
    return list(rows.assign(setting=setting).itertuples())


def _largest(contrasts: Iterable[Any]) -> Any | None:
    return max(contrasts, key=lambda c: c.change, default=None)


def _of_each_axis(contrasts: Iterable[Any]) -> Rows:
    """For each axis the contrast with the largest change, in falling order."""
    largest: dict[str, Any] = {}
    for contrast in sorted(contrasts, key=lambda c: c.change, reverse=True):
        largest.setdefault(contrast.axis or contrast.class_name, contrast)
    return list(largest.values())


def _property(contrast: Any) -> str:
    """What differs between the classes of a contrast: `reward interval k`."""
    if contrast.axis == SEVERAL:
        return f"several axes at once ({contrast.setting})"
    return axis_label(contrast.axis) or f"the class {contrast.class_name}"


def _listed(contrasts: Rows) -> str:
    """`complexity L (complexity-10: +0.13, 95 % interval +0.12 to +0.15, 5 pairs)`, …"""
    return ", ".join(f"{_property(c)} ({c.class_name}: {change_text(c)})" for c in contrasts)


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
