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
import itertools
import math
from collections.abc import Iterable
from typing import Any

import pandas as pd

from sme_registry.io.markup import conjunction, fixed, plural, signed
from sme_registry.studies.report.analysis import ENOUGH_RUNS, Analysis
from sme_registry.studies.report.classes import ALL, SEVERAL, axis_label
from sme_registry.studies.report.frames import frame
from sme_registry.studies.report.life_findings import stream_findings
from sme_registry.studies.report.sentences import (
    THRESHOLDS,
    Found,
    Rows,
    change_text,
    ends_text,
    few_runs,
    finding,
    missing_runs,
)
from sme_registry.studies.report.tables import OFFLINE_INTERVAL, training_data

COLUMNS = (
    "section:str algorithm:str class_name:str question:str verdict:str value low high runs:Int64 "
    "sentence:str"
)
_WD, _OOD = "wd_regret", "ood_regret"
_CHANCE = 0.05  # share of 95 % intervals that exclude 0 without an effect
_UNLEARNT, _NEAR = THRESHOLDS["unlearnt"], THRESHOLDS["near"]


def findings(analysis: Analysis) -> pd.DataFrame:
    """The findings of a study, from its tables."""
    parts: list[Found] = []
    if analysis.classes:
        parts += [_tasks(analysis), _comparison(analysis), _caveats(analysis)]
    if not analysis.tables["offline"].empty:
        parts.append(_offline(analysis))
    if analysis.streams:
        parts.append(stream_findings(analysis))
    return frame([row for part in parts for row in part], COLUMNS)


# Single tasks


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
        at = of_class.get(worst.class_name)
        yield from _position(about, worst, at)
        if base is not None and at is not None and at.linear - base.linear > THRESHOLDS["hurt"]:
            text = f"The linear policy had {fixed(base.linear)} on the first class, so the optimum "
            text += "itself is harder to fit."
            place = {"class_name": worst.class_name, "value": at.linear}
            yield about("linear policy", "harder_to_fit", text, **place)
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
    highest = max((c.high for c in contrasts if not math.isnan(c.high)), default=None)
    if highest is not None:
        text = f"The highest end of an interval is {signed(highest)}."
        yield about("highest", "open", text, value=highest)
    single = _largest(c for c in contrasts if math.isnan(c.high))
    if single is not None:
        text = (
            "A single pair of runs has no interval; the largest change of such a pair is "
            f"{signed(single.change)} ({single.class_name})."
        )
        yield about("single", "open", text, class_name=single.class_name, value=single.change)


def _worst(about: Any, name: str, contrasts: Rows, worst: Any) -> Found:
    """The largest change for the worse, and its certainty."""
    larger = _of_each_axis(c for c in contrasts if c.change > worst.change)
    size = [worst.change >= THRESHOLDS["broken"], worst.change >= THRESHOLDS["hurt"], True]
    severity = ("broken", "hurt", "slightly_hurt")[size.index(True)]
    is_hurt = severity.replace("_", " ") + ("" if larger else " most")
    text = (
        f"{name} is {is_hurt} by {_property(worst)}: on {worst.class_name} its WD regret rises "
        f"from {fixed(worst.base)} to {fixed(worst.level)}, by {change_text(worst)}."
    )
    yield about("worst", severity, text, worst)
    yield from _larger(about, larger)
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


def _larger(about: Any, larger: Rows) -> Found:
    if larger:
        yield about("larger", "open", f"Larger still, but not certain: {_listed(larger)}.")


def _position(about: Any, worst: Any, at: Any) -> Found:
    """Where the worst level is among the constant's, which is 1, and the linear policy's."""
    level, linear = worst.level, math.nan if at is None else at.linear
    constant, than = "the constant action ½, which has 1", "worse" if level > linear else "better"
    if level > 2.0 - _UNLEARNT:
        verdict, text = "worse_than_constant", f"worse than {constant}"
    elif level >= _UNLEARNT:
        verdict, text = "like_constant", f"about as good as {constant}"
    elif math.isnan(linear):
        return
    else:
        verdict = f"{than}_than_linear"
        text = f"better than {constant}, and {than} than the linear policy fitted to the optimum, "
        text += f"which has {fixed(linear)}"
    text = f"At {fixed(level)} it is {text}."
    yield about("position", verdict, text, class_name=worst.class_name, value=level)


def _other_axes(about: Any, contrasts: Rows, worst: Any) -> Found:
    worse = _of_each_axis(c for c in contrasts if c.verdict == "worse" and c.axis != worst.axis)
    still_open = [
        c for c in _of_each_axis(contrasts) if c.verdict != "worse" and c.change <= worst.change
    ]
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
    """The largest change for the worse out of distribution."""
    far = _largest(c for c in contrasts if c.verdict == "worse")
    if far is not None:
        larger = _of_each_axis(c for c in contrasts if c.change > far.change)
        what = "the same property" if far.axis == worst.axis else _property(far)
        costs = "costs" if larger else "costs most"
        text = f"Out of distribution, {what} {costs}: {_listed([far])}."
        yield about("out of distribution", "worse", text, far)
        yield from _larger(about, larger)


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


def _caveats(analysis: Analysis) -> Found:
    """What limits all findings on single tasks."""
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


# Learning from data


def _offline(analysis: Analysis) -> Found:
    """Whether each learner reaches or surpasses the policy that made its data."""
    about = functools.partial(finding, "offline")
    rows = list(analysis.tables["offline"].itertuples())
    data = training_data(analysis.runs)
    example, nu = next((name, source[0]) for name, source in data.items() if source)
    yield about(
        "example", "nu",
        f"An algorithm here is a learner with its data: {example} learnt from data of ν = {nu:g}. "
        "The behaviour policy that makes the data takes (1 − α) a* + α ã, where α is drawn from "
        "U(0, ν) at each step and ã is the action of a second network.",
        algorithm=example, value=nu,
    )  # fmt: skip
    yield _behaviour(rows)
    for name in dict.fromkeys(row.learner for row in rows):
        of_learner = [row for row in rows if row.learner == name]
        yield _imitation(name, of_learner)
        yield from _improvement(name, of_learner)
        yield from _depth(analysis, name, of_learner)
    few, most = min(row.runs for row in rows), max(row.runs for row in rows)
    verdict = "few" if few < ENOUGH_RUNS else "enough"
    text = (
        "Each result rests on its own interval, and one in twenty intervals excludes 0 by chance."
    )
    if few < ENOUGH_RUNS:
        text = f"With fewer than {ENOUGH_RUNS} runs a result is an indication at most, and with "
        text += f"fewer than {OFFLINE_INTERVAL} it has no interval."
    count = (f"{few} to " if few < most else "") + plural(most, "run")
    text = f"Each learner has {count} per class and ν. “Close” means within {_NEAR} of r̃. {text}"
    yield about("offline runs", verdict, text, runs=few)


def _behaviour(rows: Rows) -> dict[str, Any]:
    """The behaviour policies compared with 1 − ν/6, which independent uniform actions give."""
    places = list({(row.class_name, row.nu): row for row in reversed(rows)}.values())[::-1]
    off = [row.behaviour_similarity - (1.0 - row.nu / 6.0) for row in places]
    far = [row for row, difference in zip(places, off, strict=True) if abs(difference) > _NEAR]
    value, worst = max(zip(off, places, strict=True), key=lambda pair: abs(pair[0]))
    verdict, text = "near", "everywhere."
    if far:
        verdict, text = "far", (
            f"in {len(places) - len(far)} of {len(places)} cases, but not at {_places(far)}. A "
            "single second network may be closer to the optimum, or further away, than "
            "independent uniform actions are."
        )  # fmt: skip
    text = f"The behaviour policies are close to 1 − ν/6 {text}"
    largest = f"The largest difference is {signed(value, 3)} ({_at(worst)})."
    return finding("offline", "behaviour", verdict, f"{text} {largest}", value=value)


def _imitation(name: str, rows: Rows) -> dict[str, Any]:
    near = [row for row in rows if abs(row.improvement) <= _NEAR]
    farthest = max(rows, key=lambda row: abs(row.improvement))
    verdict, text = "near_at_none", f"{name} is close to the behaviour policy nowhere."
    if len(near) == len(rows):
        verdict = "imitates"
        text = f"{name} imitates: its mean is close to the behaviour policy's everywhere."
    elif near:
        verdict = "near_at_some"
        text = f"{name} is close to the behaviour policy at {_places(near)}."
    largest = f"The largest difference is {signed(farthest.improvement, 3)} ({_at(farthest)})."
    return finding(
        "offline", "imitation", verdict, f"{text} {largest}", farthest,
        algorithm=name, value=farthest.improvement,
    )  # fmt: skip


def _improvement(name: str, rows: Rows) -> Found:
    """Where a learner surpasses its data, and where it falls behind them."""
    hint, few = "A single run, which is only a hint, is", "There are indications (all of few runs)"
    begins = {
        "above": "It surpasses", "above_few": f"{few} that it surpasses",
        "below": "It falls behind", "below_few": f"{few} that it falls behind",
        "single_above": f"{hint} above",
    }  # fmt: skip
    by_verdict: dict[str, list[Any]] = {}
    for row in rows:
        if row.runs > 1:
            by_verdict.setdefault(row.verdict, []).append(row)
        elif row.improvement > _NEAR:
            by_verdict.setdefault("single_above", []).append(row)
    if not by_verdict.keys() & {"above", "above_few"}:
        text = "It was not shown to surpass its data at any ν."
        yield finding("offline", "improvement", "none", text, algorithm=name)
    for verdict, places in by_verdict.items():
        low, high = (signed(f(row.improvement for row in places), 3) for f in (min, max))
        by = low if low == high else f"{low} to {high}"
        text = f"Whether it is above or below its data is open at {_places(places)}."
        if verdict in begins:
            text = f"{begins[verdict]} its data at {_places(places)}, by {by}."
        yield finding("offline", "improvement", verdict, text, algorithm=name)


def _depth(analysis: Analysis, name: str, rows: Rows) -> Found:
    """Whether a learner collapses on the deepest class, if classes differ in depth."""
    classes = dict.fromkeys(analysis.tables["offline"].class_name)
    depth = {c: float(analysis.classes[c].setting["complexity"]) for c in classes}
    if len(set(depth.values())) < 2:
        return
    deepest = max(depth, key=lambda name: depth[name])
    about = functools.partial(finding, "offline", "depth", algorithm=name, class_name=deepest)
    rows = [row for row in rows if row.class_name == deepest]
    if not rows:
        yield about("no_runs", f"{name} has no finished run on the deepest class, {deepest}.")
        return
    collapse, reasons = THRESHOLDS["collapse"], []
    constant = [row for row in rows if row.similarity <= row.constant_similarity + _NEAR]
    below = [row for row in rows if row.improvement <= -collapse and row not in constant]
    if constant:
        reasons.append(f"at ν = {_nus(constant)} it is at most {_NEAR} better than the constant ½")
    if below:
        text = "it is better than the constant ½, but"
        reasons.append(f"at ν = {_nus(below)} {text} {collapse} or more below its data")
    lowest, runs = min(rows, key=lambda row: row.improvement), sum(row.runs for row in rows)
    verdict, does, text = "collapses", "collapses", f"{', and '.join(reasons)}."
    if any(row.runs < ENOUGH_RUNS for row in (*constant, *below)):
        text += " With so few runs this is an indication."
    if not reasons:
        verdict, does = "holds", "does not collapse"
        text = f"its mean is more than {_NEAR} above that of the constant ½ everywhere; compared "
        text += (
            f"with its data, it is {signed(lowest.improvement, 3)} at the lowest ({_at(lowest)})."
        )
    of = f"{plural(len(rows), 'value')} of ν, {plural(runs, 'run')}"
    text = f"{name} {does} on the deepest class, {deepest} ({of}): {text}"
    yield about(verdict, text, value=lowest.improvement, runs=runs)


# Words


def _contrasts(analysis: Analysis, algorithm: str, metric: str) -> Rows:
    """Rows of the contrasts, with the setting of their class."""
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


def _at(row: Any) -> str:
    return f"{row.class_name}, ν = {row.nu:g}"


def _nus(rows: Rows) -> str:
    return ", ".join(f"{row.nu:g}" for row in rows)


def _places(rows: Rows) -> str:
    """`shallow (ν = 0, 0.5), deep (ν = 1)`."""
    grouped = itertools.groupby(rows, key=lambda row: row.class_name)
    return ", ".join(f"{name} (ν = {_nus(list(at))})" for name, at in grouped)
