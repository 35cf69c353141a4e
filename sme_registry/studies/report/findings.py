"""Which property of the task breaks an algorithm, and how sure are we? The tables in words.

What is said follows from the contrasts of normalised regret within distribution. A change is
`shown` where its 95 % interval leaves out 0 and there are `ENOUGH_RUNS` pairs, an `indication`
where there are fewer, and otherwise open: no sentence turns an open one into "has no effect".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sme_registry.diagnosis.questions import THRESHOLDS
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import ALL, AXES
from sme_registry.studies.report.tables import ENOUGH_RUNS, training_data

Contrast = Any  # a row of the table, as a named tuple
Aggregate = Any

WD, OOD = "wd_regret", "ood_regret"
_NOT_LEARNT = THRESHOLDS["unlearnt"]  # of the constant's regret: nothing to speak of was learnt
_BROKEN, _HURT = 0.2, 0.05  # of the constant's regret: how much is called what


@dataclass(frozen=True)
class Finding:
    """What is said of an algorithm.

    Attributes:
      algorithm: its name.
      headline: the answer, one sentence or two.
      points: what else there is to it, and how sure it is.
    """

    algorithm: str
    headline: str
    points: tuple[str, ...]


def findings(analysis: Analysis) -> list[Finding]:
    """The answer for each algorithm that learns."""
    return [_finding(analysis, algorithm) for algorithm in analysis.learners]


def caveats(analysis: Analysis) -> list[str]:
    """What holds for everything that is said: how many runs, how many comparisons."""
    done, missing = len(analysis.runs), len(analysis.missing)
    said = []
    if missing:
        failed = int((analysis.missing.error != "").sum())
        why = f", of which {failed} failed" if failed else ""
        said.append(
            f"{missing} of the plan's {done + missing} runs are not there yet{why}. They are in no "
            "number, and the table of runs names them."
        )
    pairs = [
        row.pairs for row in analysis.contrasts.itertuples() if row.algorithm in analysis.learners
    ]
    if pairs and min(pairs) < ENOUGH_RUNS:
        said.append(
            f"Some contrasts rest on as few as {min(pairs)} {_plural(min(pairs), 'pair')} of runs. "
            "A 95 % bootstrap interval of 2 runs holds the truth in only 32–62 % of cases and of 3 "
            "in 48–86 %, depending on how runs spread; from 4 on in 94–98 %. Under "
            f"{ENOUGH_RUNS} pairs, this report calls a change an indication at most."
        )
    contrasts = [
        row
        for row in analysis.contrasts.itertuples()
        if row.metric == WD and not math.isnan(row.low)
    ]
    contrasts = [row for row in contrasts if row.algorithm in analysis.learners]
    if len(contrasts) > 1:
        said.append(
            f"There are {len(contrasts)} contrasts within distribution, each with an interval of "
            f"its own: were there no effects at all, about {max(1, round(0.05 * len(contrasts)))} "
            "of them would still leave out 0 by chance."
        )
    if any("policy_init" in _differing(analysis, name) for name in analysis.classes):
        said.append(
            "Some classes also have another policy_init than the first, which their depth asks "
            "for; that is part of their contrasts."
        )
    return said


def comparison(analysis: Analysis) -> str:
    """Which does best over all classes of those with equal data, and whether that is settled."""
    data = training_data(analysis.runs)
    rows = [
        row
        for row in analysis.aggregates.itertuples()
        if (row.group, row.metric, row.statistic) == (ALL, WD, "iqm")
        and row.algorithm in analysis.learners
    ]
    said = [_budgets(analysis, [row.algorithm for row in rows])]
    for equal in dict.fromkeys(data[row.algorithm] for row in rows):
        own = [row for row in rows if data[row.algorithm] == equal]
        if len(own) > 1:
            said.append(_best(analysis, own, equal))
    return " ".join(filter(None, said))


def _best(analysis: Analysis, rows: Sequence[Aggregate], data: tuple[float, int] | None) -> str:
    """Which of some algorithms does best."""
    best = max(rows, key=lambda row: row.value)
    among = f"of those on {data[1]:,} transitions of ν = {data[0]:g}, " if data else ""
    text = (
        f"Over the {best.classes} {_plural(best.classes, 'class', 'classes')} where all have runs, "
        f"{among}{best.algorithm} scores highest within distribution: {best.value:.2f}"
        f"{_interval(best.low, best.high)}, where 1 is the optimum and 0 the constant ½."
    )
    names = {row.algorithm for row in rows}
    for row in analysis.improvements.itertuples():
        pair = {row.first, row.second}
        if (row.group, row.metric) != (ALL, WD) or best.algorithm not in pair:
            continue
        other = (pair - {best.algorithm}).pop()
        if other not in names:
            continue
        value, low, high = row.probability, row.low, row.high
        if row.first == other:
            value = 1.0 - value
            low, high = 1.0 - high, 1.0 - low
        if not low > 0.5:
            sure = ", which leaves open which of the two is better"
        else:
            sure = "" if row.fewest_runs >= ENOUGH_RUNS else ", an indication from few runs"
        text += (
            f" A run of it beats one of {other} with probability {value:.2f}"
            f"{_interval(low, high)}{sure}."
        )
    return text


def _budgets(analysis: Analysis, algorithms: Sequence[str]) -> str:
    """How long each of some algorithms was trained, where that differs."""
    steps = {run.algorithm: run.steps for run in analysis.runs.itertuples()}
    alike: dict[int, list[str]] = {}
    for name in algorithms:
        alike.setdefault(steps[name], []).append(name)
    if len(alike) < 2:
        return ""
    (first, names), *others = alike.items()
    text = f"{_and(names)} {_plural(len(names), 'was', 'were')} trained for {first:,} steps"
    return text + "".join(f", {_and(names)} for {count:,}" for count, names in others) + "."


def _finding(analysis: Analysis, algorithm: str) -> Finding:
    rows = _rows(analysis, algorithm, WD)
    if not rows:
        return Finding(
            algorithm,
            f"Nothing can be said of {algorithm} yet: it has no runs of one number on the first "
            f"class, {analysis.base}, and on another.",
            (),
        )
    points = []
    base = _level(analysis, analysis.base, algorithm)
    if base is not None and base.iqm >= _NOT_LEARNT:
        points.append(
            f"It has learnt next to nothing on the first class itself: its normalised regret there "
            f"is {base.iqm:.2f}, and the constant action's 1. What has not been learnt cannot "
            "break, so the contrasts say little: they need a longer budget."
        )
    worse = [row for row in rows if row.verdict == "worse"]
    if not worse:
        better = [row for row in rows if row.verdict == "better"]
        found = f"; {_listed(analysis, better)} lower it" if better else ""
        ends = [row.high for row in rows if not math.isnan(row.high)]
        still = ": the intervals say what is still possible" if ends else ""
        headline = (
            f"No class has been shown to make {algorithm} worse within distribution{found}. "
            f"That is no proof of the contrary{still}."
        )
        if ends:
            points.append(f"The largest upper end is {_signed(max(ends))}.")
        alone = [row for row in rows if math.isnan(row.high)]
        if alone:
            most = max(alone, key=lambda row: row.change)
            points.append(
                "A single pair of runs has no interval; the largest change of such a pair is "
                f"{_signed(most.change)} ({most.class_name})."
            )
        return Finding(algorithm, headline, tuple(points))
    top = max(worse, key=lambda row: row.change)
    larger = _larger(rows, top)
    headline = (
        f"{algorithm} is {_verb(top.change, most=not larger)} by {_property(analysis, top)}: on "
        f"{top.class_name} its normalised regret within distribution goes from {top.base:.2f} to "
        f"{top.level:.2f}, a change of {_signed(top.change)} (95 % interval {_signed(top.low)} to "
        f"{_signed(top.high)}, {top.pairs} pairs of runs).{_uncertain(analysis, larger)}"
    )
    points += [_certainty(analysis, top, rows), _severity(analysis, top)]
    others = [row for row in _worst_of_each_axis(worse) if row.axis != top.axis]
    settled = [row for row in others if row.enough_pairs]
    if settled:
        points.append(f"It is also made worse by {_listed(analysis, settled)}.")
    if len(settled) < len(others):
        few = [row for row in others if not row.enough_pairs]
        points.append(
            f"There are indications, no more, that it is made worse by {_listed(analysis, few)}."
        )
    still_open = [
        row for row in _worst_of_each_axis(rows) if row.verdict != "worse" and row not in larger
    ]
    if still_open:
        points.append(
            f"Not shown to make it worse: {_listed(analysis, still_open)}. Where an interval is "
            "wide, that is for want of runs."
        )
    outside = [row for row in _rows(analysis, algorithm, OOD) if row.verdict == "worse"]
    if outside:
        far = max(outside, key=lambda row: row.change)
        larger = _larger(_rows(analysis, algorithm, OOD), far)
        costs = "makes it worse" if larger else "costs it most"
        if far.axis == top.axis:
            text = f"Out of distribution the same property {costs}"
        else:
            text = f"Out of distribution it is {_property(analysis, far)} that {costs}"
        points.append(f"{text}: {_listed(analysis, [far])}.{_uncertain(analysis, larger)}")
    return Finding(algorithm, headline, tuple(filter(None, points)))


def _larger(rows: Iterable[Contrast], top: Contrast) -> list[Contrast]:
    """What costs more than the largest change that is certain, of each axis its worst."""
    return _worst_of_each_axis(row for row in rows if row.change > top.change)


def _uncertain(analysis: Analysis, larger: Sequence[Contrast]) -> str:
    return f" Larger still, but not certain: {_listed(analysis, larger)}." if larger else ""


def _severity(analysis: Analysis, top: Contrast) -> str:
    """Where the policies end up, between the references."""
    level = _level(analysis, top.class_name, top.algorithm)
    linear = level.linear if level is not None else None
    if top.level > 2.0 - _NOT_LEARNT:
        return f"At {top.level:.2f} it is worse than the constant action ½, which scores 1."
    if top.level >= _NOT_LEARNT:
        return f"At {top.level:.2f} it is about where the constant action ½ is, which scores 1."
    if linear is None:
        return ""
    relation = "worse" if top.level > linear else "still better"
    text = (
        f"At {top.level:.2f} it is {relation} than the linear policy fitted to the optimum, which "
        f"has {linear:.2f} there, and better than the constant ½, which has 1."
    )
    before = _level(analysis, analysis.base, top.algorithm)
    if before is not None and linear - before.linear > _HURT:
        text += (
            f" The linear policy's own regret rises from {before.linear:.2f}: the optimum itself "
            "is harder to fit there."
        )
    return text


def _certainty(analysis: Analysis, top: Contrast, rows: Sequence[Contrast]) -> str:
    """How sure it is that this is the worst."""
    if not top.enough_pairs:
        return (
            f"How sure? Not very: {top.pairs} pairs of runs are few, and this is an indication, "
            f"not a finding. {ENOUGH_RUNS} or more would settle more."
        )
    rivals = _worst_of_each_axis(
        row
        for row in rows
        if row.axis != top.axis and (math.isnan(row.high) or row.high >= top.low)
    )
    if rivals:
        return (
            "How sure? That it hurts, its interval shows. That nothing else hurts more is not "
            f"settled: no interval rules it out of {_listed(analysis, rivals)}."
        )
    if len({row.axis for row in rows}) == 1:
        return "How sure? That it hurts, its interval shows; no other axis was varied."
    return (
        f"How sure? Its interval begins at {_signed(top.low)}, above where every other axis' "
        "ends, so that among the axes varied here it is the worst."
    )


def _level(analysis: Analysis, class_name: str, algorithm: str) -> Any:
    for row in analysis.levels.itertuples():
        if (row.class_name, row.algorithm, row.metric) == (class_name, algorithm, WD):
            return row
    return None


def _rows(analysis: Analysis, algorithm: str, metric: str) -> list[Contrast]:
    return [
        row
        for row in analysis.contrasts.itertuples()
        if (row.algorithm, row.metric) == (algorithm, metric)
    ]


def _worst_of_each_axis(rows: Iterable[Contrast]) -> list[Contrast]:
    """For each axis the class that costs most, dearest axis first."""
    found: dict[str, Contrast] = {}
    for row in sorted(rows, key=lambda row: row.change, reverse=True):
        found.setdefault(row.axis or row.class_name, row)
    return list(found.values())


def _listed(analysis: Analysis, rows: Sequence[Contrast]) -> str:
    """`complexity L (complexity-10: +0.13, interval +0.12 to +0.15)`, …"""
    parts = []
    for row in rows:
        interval = (
            "a single pair, no interval"
            if math.isnan(row.low)
            else f"interval {_signed(row.low)} to {_signed(row.high)}"
        )
        few = "" if row.enough_pairs or math.isnan(row.low) else f", only {row.pairs} pairs"
        parts.append(
            f"{_property(analysis, row)} ({row.class_name}: {_signed(row.change)}, {interval}{few})"
        )
    return ", ".join(parts)


def _property(analysis: Analysis, row: Contrast) -> str:
    """What the class changes, as a reader calls it."""
    if row.axis in AXES:
        return AXES[row.axis][1]
    label = analysis.classes[row.class_name].label
    return f"several axes at once ({label})" if label else f"the class {row.class_name}"


def _differing(analysis: Analysis, class_name: str) -> list[str]:
    """Fields in which a class differs from the first, besides the one it is contrasted by."""
    info, base = analysis.classes[class_name], analysis.classes[analysis.base]
    return [name for name in AXES if info.setting[name] != base.setting[name] and name != info.axis]


def _verb(change: float, *, most: bool) -> str:
    verb = "broken" if change >= _BROKEN else "hurt"
    return f"{verb}{' most' if most else ''}{'' if change >= _HURT else ', though little,'}"


def _interval(low: float, high: float) -> str:
    return "" if math.isnan(low) else f" ({low:.2f} to {high:.2f})"


def _signed(value: float) -> str:
    """`+0.44`, `−0.02`, `0.00`."""
    text = f"{value:+.2f}"
    return "0.00" if text in ("+0.00", "-0.00") else text.replace("-", "−")


def _and(names: Sequence[str]) -> str:
    """`PPO, TD3 and SAC`."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def _plural(count: int, one: str, many: str = "") -> str:
    return one if count == 1 else many or f"{one}s"
