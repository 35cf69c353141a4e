"""`findings`: what a study found, as a table with a verdict and a sentence in each row.

A change or a metric counts if its 95 % interval excludes the neutral value, 0 or for a ratio 1; it
is an indication if it rests on fewer than `ENOUGH_RUNS` pairs of runs or lives. Any other is open,
which does not mean that there is no effect.

    section      tasks, comparison, caveats, offline, streams, stream_changes, stream_caveats
    algorithm, class_name    what it is about; "" where it is about several
    question, verdict        together they choose the sentence, see `sentences`
    value, low, high, runs   the number it rests on, its interval, and its runs, pairs or lives
    sentence     for people
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import pandas as pd

from sme_registry.io.markup import conjunction, plural, signed
from sme_registry.studies.report.analysis import ENOUGH_RUNS, Analysis
from sme_registry.studies.report.classes import ALL, AXES, SEVERAL
from sme_registry.studies.report.frames import frame
from sme_registry.studies.report.life_findings import stream_findings
from sme_registry.studies.report.sentences import (
    THRESHOLDS,
    Found,
    between,
    change_text,
    ends_text,
    few_runs,
    finding,
    missing_runs,
    numbers_of,
)
from sme_registry.studies.report.tables import OFFLINE_INTERVAL, training_data

COLUMNS = (
    "section:str algorithm:str class_name:str question:str verdict:str value low high runs:Int64 "
    "sentence:str"
)
_WD, _OOD = "wd_regret", "ood_regret"
_CHANCE = 0.05  # share of 95 % intervals that exclude 0 without an effect
_NEAR = THRESHOLDS["near"]

Rows = Sequence[Any]  # of a table, as named tuples


def findings(analysis: Analysis) -> pd.DataFrame:
    """The findings of a study, from its tables."""
    parts: list[Iterable[dict[str, Any]]] = []
    if analysis.classes:
        parts += [_tasks(analysis), _comparison(analysis), _caveats(analysis)]
    if not analysis.tables["offline"].empty:
        parts.append(_offline(analysis))
    if analysis.streams:
        parts.append(stream_findings(analysis))
    return frame([row for part in parts for row in part], COLUMNS)


def _tasks(analysis: Analysis) -> Found:
    """Which property of the task breaks each learner, and how sure that is."""
    for name in analysis.learners:
        contrasts = _contrasts(analysis, name, _WD)
        if not contrasts:
            yield finding("tasks", "contrasts", "none", algorithm=name, first=analysis.base)
            continue
        base = _level(analysis, analysis.base, name)
        if base is not None and base.iqm >= THRESHOLDS["unlearnt"]:
            yield finding("tasks", "first class", "unlearnt", algorithm=name, value=base.iqm)
        worst = _largest(c for c in contrasts if c.verdict == "worse")
        if worst is None:
            yield from _no_worst(name, contrasts)
        else:
            yield from _worst(analysis, name, contrasts, worst)


def _no_worst(name: str, contrasts: Rows) -> Found:
    """What is known of a learner that no class was shown to make worse."""
    yield finding("tasks", "worst", "none_shown", algorithm=name)
    yield from _others(name, "better", [c for c in contrasts if c.verdict == "better"])
    highest = max((c.high for c in contrasts if not math.isnan(c.high)), default=None)
    if highest is not None:
        yield finding("tasks", "highest", "open", algorithm=name, value=highest)
    single = _largest(c for c in contrasts if math.isnan(c.high))
    if single is not None:
        at = {"class_name": single.class_name, "value": single.change}
        yield finding("tasks", "single", "open", algorithm=name, **at)


def _worst(analysis: Analysis, name: str, contrasts: Rows, worst: Any) -> Found:
    """The largest change for the worse, its certainty, and the other changes."""
    numbers = {"algorithm": name, **numbers_of(worst)}
    larger = _of_each_axis(c for c in contrasts if c.change > worst.change)
    severity = _severity(worst.change)
    yield finding(
        "tasks", "worst", severity, **numbers, base=worst.base, level=worst.level,
        most="" if larger else " most", comma="" if larger else ",", property=_property(worst),
        change=change_text(worst),
    )  # fmt: skip
    if larger:
        yield finding("tasks", "larger", "open", algorithm=name, listed=_listed(larger))
    rivals = _of_each_axis(c for c in contrasts if c.axis != worst.axis and not c.high < worst.low)
    axes = {c.axis for c in contrasts}
    yield finding(
        "tasks", "certainty", _certainty(worst, rivals, axes), **numbers, listed=_listed(rivals),
        pairs=plural(worst.pairs, "pair"), enough=ENOUGH_RUNS,
    )  # fmt: skip
    yield from _position(analysis, name, worst)
    worse = _of_each_axis(c for c in contrasts if c.verdict == "worse" and c.axis != worst.axis)
    yield from _others(name, "worse", [c for c in worse if c.enough_pairs])
    yield from _others(name, "indication", [c for c in worse if not c.enough_pairs])
    still_open = [c for c in _of_each_axis(contrasts) if c.verdict != "worse" and c not in larger]
    yield from _others(name, "open", still_open)
    outside = _contrasts(analysis, name, _OOD)
    far = _largest(c for c in outside if c.verdict == "worse")
    if far is not None:
        larger = _of_each_axis(c for c in outside if c.change > far.change)
        yield finding(
            "tasks", "out of distribution", "worse", algorithm=name, **numbers_of(far),
            property="the same property" if far.axis == worst.axis else _property(far),
            costs="costs" if larger else "costs most", listed=_listed([far]),
        )  # fmt: skip
        if larger:
            yield finding("tasks", "larger", "open", algorithm=name, listed=_listed(larger))


def _others(name: str, verdict: str, contrasts: Rows) -> Found:
    if contrasts:
        yield finding("tasks", "other axes", verdict, algorithm=name, listed=_listed(contrasts))


def _severity(change: float) -> str:
    if change >= THRESHOLDS["broken"]:
        return "broken"
    return "hurt" if change >= THRESHOLDS["hurt"] else "slightly_hurt"


def _certainty(worst: Any, rivals: Rows, axes: set[str]) -> str:
    """Whether the intervals of other axes allow a larger change, if there are others."""
    if not worst.enough_pairs:
        return "indication"
    if rivals:
        return "rivals"
    return "only_axis" if len(axes) == 1 else "certain"


def _position(analysis: Analysis, name: str, worst: Any) -> Found:
    """Where the worst level is among the constant's, which is 1, and the linear policy's."""
    at, base = _level(analysis, worst.class_name, name), _level(analysis, analysis.base, name)
    linear = math.nan if at is None else at.linear
    about = {"algorithm": name, "class_name": worst.class_name, "value": worst.level}
    if worst.level > 2.0 - THRESHOLDS["unlearnt"]:
        yield finding("tasks", "position", "worse_than_constant", **about)
    elif worst.level >= THRESHOLDS["unlearnt"]:
        yield finding("tasks", "position", "like_constant", **about)
    elif not math.isnan(linear):
        verdict = "worse_than_linear" if worst.level > linear else "better_than_linear"
        yield finding("tasks", "position", verdict, **about, linear=linear)
    if base is not None and linear - base.linear > THRESHOLDS["hurt"]:
        yield finding(
            "tasks", "linear policy", "harder_to_fit", **about | {"value": linear}, base=base.linear
        )


def _comparison(analysis: Analysis) -> Found:
    """The best learner over all classes among those with equal data, and its rivals."""
    rows = analysis.tables["aggregates"]
    rows = rows[(rows.group == ALL) & (rows.metric == _WD) & (rows.statistic == "iqm")]
    compared = list(rows[rows.algorithm.isin(analysis.learners)].itertuples())
    of_all = dict(zip(analysis.runs.algorithm, analysis.runs.steps.tolist(), strict=True))
    steps = {row.algorithm: of_all[row.algorithm] for row in compared}
    if len(set(steps.values())) > 1:
        listed = ", ".join(f"{name} {count:,}" for name, count in steps.items())
        yield finding("comparison", "training steps", "differ", listed=listed)
    data = training_data(analysis.runs)
    for shared in dict.fromkeys(data[row.algorithm] for row in compared):
        alike = [row for row in compared if data[row.algorithm] == shared]
        if len(alike) > 1:
            best = max(alike, key=lambda row: row.value)
            nu, transitions = shared or (math.nan, 0)
            of_data = f" of those with {transitions:,} transitions of ν = {nu:g},"
            yield finding(
                "comparison", "best", "best", algorithm=best.algorithm, value=best.value,
                low=best.low, high=best.high, runs=best.fewest_runs, interval=ends_text(best),
                classes=plural(best.classes, "class", "classes"), data=of_data if shared else "",
            )  # fmt: skip
            yield from _rivals(analysis, best.algorithm, {row.algorithm for row in alike})


def _rivals(analysis: Analysis, best: str, among: set[str]) -> Found:
    rows = analysis.tables["improvements"]
    for row in rows[(rows.group == ALL) & (rows.metric == _WD)].itertuples():
        if best not in (row.first, row.second) or not {row.first, row.second} <= among:
            continue
        numbers = {"value": row.probability, "low": row.low, "high": row.high}
        if row.second == best:
            ends = {"low": 1.0 - row.high, "high": 1.0 - row.low}
            numbers = {"value": 1.0 - row.probability, **ends}
        verdict = "open"
        if numbers["low"] > THRESHOLDS["probability"]:
            verdict = "better" if row.fewest_runs >= ENOUGH_RUNS else "indication"
        yield finding(
            "comparison", "rival", verdict, algorithm=best, runs=row.fewest_runs, **numbers,
            other=row.first if row.second == best else row.second, interval=between(**numbers),
        )  # fmt: skip


def _caveats(analysis: Analysis) -> Found:
    """What limits all findings on single tasks."""
    rows, missing = analysis.tables["contrasts"], analysis.tables["missing"]
    rows = rows[rows.algorithm.isin(analysis.learners)]
    planned, failed = len(analysis.runs) + len(missing), int((missing.error != "").sum())
    yield from missing_runs("caveats", len(missing), planned, failed)
    if not rows.empty and rows.pairs.min() < ENOUGH_RUNS:
        yield few_runs("caveats", int(rows.pairs.min()), "pair of runs", "pairs of runs")
    intervals = int(((rows.metric == _WD) & rows.low.notna()).sum())
    if intervals > 1:
        value = max(1, round(_CHANCE * intervals))
        yield finding("caveats", "chance", "expected", value=value, intervals=intervals)
    init = {name: info.setting["policy_init"] for name, info in analysis.classes.items()}
    other = [
        name for name, info in analysis.classes.items()
        if info.axis != "policy_init" and init[name] != init[analysis.base]
    ]  # fmt: skip
    if other:
        yield finding("caveats", "policy_init", "differs", listed=conjunction(other))


def _offline(analysis: Analysis) -> Found:
    """Whether each learner reaches or surpasses the policy that made its data."""
    rows = list(analysis.tables["offline"].itertuples())
    data = training_data(analysis.runs)
    example, nu = next((name, source[0]) for name, source in data.items() if source)
    yield finding("offline", "example", "nu", algorithm=example, value=nu)
    yield _behaviour(rows)
    for name in dict.fromkeys(row.learner for row in rows):
        yield from _learner(analysis, name, [row for row in rows if row.learner == name])
    few, most = min(row.runs for row in rows), max(row.runs for row in rows)
    yield finding(
        "offline", "offline runs", "few" if few < ENOUGH_RUNS else "enough", runs=few,
        count=(f"{few} to " if few < most else "") + plural(most, "run"), near=_NEAR,
        enough=ENOUGH_RUNS, interval_runs=OFFLINE_INTERVAL,
    )  # fmt: skip


def _behaviour(rows: Rows) -> dict[str, Any]:
    """The behaviour policies compared with 1 − ν/6, which independent uniform actions give."""
    places = list({(row.class_name, row.nu): row for row in reversed(rows)}.values())[::-1]
    off = [row.behaviour_similarity - (1.0 - row.nu / 6.0) for row in places]
    far = [row for row, difference in zip(places, off, strict=True) if abs(difference) > _NEAR]
    worst = max(range(len(off)), key=lambda i: abs(off[i]))
    return finding(
        "offline", "behaviour", "far" if far else "near", value=off[worst],
        where=_at(places[worst]), near=len(places) - len(far), count=len(places),
        places=_places(far),
    )  # fmt: skip


def _learner(analysis: Analysis, name: str, rows: Rows) -> Found:
    near = [row for row in rows if abs(row.improvement) <= _NEAR]
    verdict = "near_at_some" if near else "near_at_none"
    farthest = max(rows, key=lambda row: abs(row.improvement))
    yield finding(
        "offline", "imitation", "imitates" if len(near) == len(rows) else verdict, algorithm=name,
        **numbers_of(farthest), places=_places(near), where=_at(farthest),
    )  # fmt: skip
    by_verdict: dict[str, list[Any]] = {}
    for row in rows:
        if row.runs > 1:
            by_verdict.setdefault(row.verdict, []).append(row)
        elif row.improvement > _NEAR:
            by_verdict.setdefault("single_above", []).append(row)
    if not by_verdict.keys() & {"above", "above_few"}:
        yield finding("offline", "improvement", "none", algorithm=name)
    for verdict, places in by_verdict.items():
        low, high = (signed(f(row.improvement for row in places), 3) for f in (min, max))
        yield finding(
            "offline", "improvement", verdict, algorithm=name, places=_places(places),
            by=low if low == high else f"{low} to {high}",
        )  # fmt: skip
    yield from _depth(analysis, name, rows)


def _depth(analysis: Analysis, name: str, rows: Rows) -> Found:
    """Whether a learner collapses on the deepest class, if classes differ in depth."""
    classes = dict.fromkeys(analysis.tables["offline"].class_name)
    depth = {each: float(analysis.classes[each].setting["complexity"]) for each in classes}
    if len(set(depth.values())) < 2:
        return
    deepest = max(depth, key=lambda each: depth[each])
    rows = [row for row in rows if row.class_name == deepest]
    about = {"algorithm": name, "class_name": deepest}
    if not rows:
        yield finding("offline", "depth", "no_runs", **about)
        return
    constant = [row for row in rows if row.similarity <= row.constant_similarity + _NEAR]
    below = [
        row for row in rows
        if row.improvement <= -THRESHOLDS["collapse"] and row not in constant
    ]  # fmt: skip
    lowest = min(rows, key=lambda row: row.improvement)
    how = [f"at ν = {_nus(constant)} it is at most {_NEAR} better than the constant ½"] * bool(
        constant
    ) + [
        f"at ν = {_nus(below)} it is better than the constant ½, but {THRESHOLDS['collapse']} or "
        "more below its data"
    ] * bool(below)
    few = any(row.runs < ENOUGH_RUNS for row in (*constant, *below))
    yield finding(
        "offline", "depth", "collapses" if how else "holds", **about, value=lowest.improvement,
        runs=sum(row.runs for row in rows), nus=plural(len(rows), "value"),
        count=plural(sum(row.runs for row in rows), "run"), near=_NEAR, where=_at(lowest),
        how=", and ".join(how), few=" With so few runs this is an indication." * few,
    )  # fmt: skip


def _contrasts(analysis: Analysis, algorithm: str, metric: str) -> Rows:
    """Rows of the contrasts, with the setting of their class."""
    rows = analysis.tables["contrasts"]
    rows = rows[(rows.algorithm == algorithm) & (rows.metric == metric)]
    setting = rows.class_name.map({name: c.label for name, c in analysis.classes.items()})
    return list(rows.assign(setting=setting).itertuples())


def _level(analysis: Analysis, class_name: str, algorithm: str) -> Any | None:
    """The row of an algorithm's WD regret on a class."""
    rows = analysis.tables["levels"]
    place = (rows.class_name == class_name) & (rows.algorithm == algorithm) & (rows.metric == _WD)
    return next(rows[place].itertuples(), None)


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
    if contrast.axis in AXES:
        return AXES[contrast.axis][1]
    if contrast.axis == SEVERAL:
        return f"several axes at once ({contrast.setting})"
    return contrast.axis or f"the class {contrast.class_name}"


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
