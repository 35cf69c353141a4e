"""`findings`: what a study found, as a table with a verdict and a sentence in each row.

A change or a metric counts if its 95 % interval excludes the neutral value: 0, or 1 for a ratio, or
½ for a probability. Any other is open, which does not mean that there is no effect. A verdict that
rests on fewer than `ENOUGH_RUNS` runs, pairs of runs or lives ends with `_few`: an indication.

    section      tasks, comparison, caveats, offline, streams, stream_changes, stream_caveats
    algorithm, class_name    what it is about; "" where it is about several
    question, verdict        what was asked, and the answer
    value, low, high, runs   the number it rests on, its interval, and its runs, pairs or lives
    sentence     for people
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import pandas as pd

from sme_registry.diagnosis.questions import THRESHOLDS as DIAGNOSIS
from sme_registry.io.markup import conjunction, fixed, plural, signed
from sme_registry.studies.report.analysis import (
    ENOUGH_RUNS,
    OFFLINE_INTERVAL,
    PLACE,
    Analysis,
    RunKind,
    change_verdict,
    training_data,
)
from sme_registry.studies.report.design import (
    ALL,
    METRICS,
    SEVERAL,
    TASKS,
    WITHIN,
    axis_label,
    setting_label,
)
from sme_registry.studies.report.frames import frame
from sme_registry.studies.report.texts import implementation_caveats, steps_caveats

COLUMNS = (
    "section:str algorithm:str class_name:str question:str verdict:str value low high runs:Int64 "
    "sentence:str"
)
THRESHOLDS = {
    "unlearnt": DIAGNOSIS["unlearnt"],  # normalised regret, at least: almost nothing was learnt
    "stuck": 0.8,  # normalised regret of a run, at least, where another has at most half of it
    "broken": 0.2,  # change of normalised regret, at least
    "hurt": 0.05,  # at least; a smaller one hurts slightly
    "enough_runs": float(ENOUGH_RUNS),  # with fewer runs or pairs a verdict is an indication
    "interval_runs": float(OFFLINE_INTERVAL),  # with fewer an improvement has no interval
    "near": 0.02,  # difference of r̃, at most: as good as
}
_CHANCE = 0.05  # share of 95 % intervals that exclude 0 without an effect
# The columns of other tables from which those of a finding are taken.
_TAKEN = {
    "algorithm": ("algorithm", "first"),
    "class_name": ("class_name",),
    "value": ("change", "difference", "probability", "iqm", "value"),
    "low": ("low",),
    "high": ("high",),
    "runs": ("pairs", "fewest_runs", "runs"),
}
# What an agent does if a metric of its life is above the neutral value, below it, or open.
_LIVES = {
    "forgetting": (
        "forgets", "is better on earlier phases than ever before", "was not shown to forget",
    ),
    "plasticity_ratio": (
        "ends its visits worse than a fresh agent", "ends its visits better than a fresh agent",
        "was shown to end its visits neither worse nor better than a fresh agent",
    ),
    "forward_transfer": (
        "is better on phases before their first visit than before training",
        "is worse on phases before their first visit than before training",
        "was shown neither better nor worse on phases before their first visit",
    ),
    "learning_transfer": (
        "has less regret during its visits than a fresh agent",
        "has more regret during its visits than a fresh agent",
        "was shown neither ahead of nor behind a fresh agent in its visits",
    ),
}  # fmt: skip
_OFFLINE = {
    "near": "is as good as the policy that made its data",
    "above": "surpasses its data",
    "above_few": "surpasses its data in every run",
    "below": "falls behind its data",
    "below_few": "falls behind its data in every run",
    "open": "was shown neither above nor below its data",
    "like_constant": "is no better than the constant ½",
}

Found = Iterator[dict[str, Any]]


def findings(analysis: Analysis) -> pd.DataFrame:
    """The findings of a study, from its tables."""
    found = itertools.chain(
        *(_task(analysis, name) for name in analysis.learners),
        _comparison(analysis),
        _offline(analysis),
        _lives(analysis),
        _changes(analysis),
        *(_caveats(analysis, part) for part in analysis.parts),
    )
    return frame([*found], COLUMNS)


def finding(
    section: str, question: str, verdict: str, sentence: str, row: Any = None, **columns: Any
) -> dict[str, Any]:
    """A row of findings; those columns that `row`, of any table, has are taken from it."""
    result = {"algorithm": "", "class_name": "", "section": section, "question": question}
    for column, names in _TAKEN.items():
        known = [getattr(row, name) for name in names if hasattr(row, name)]
        result |= {column: known[0]} if known else {}
    if verdict.endswith("_few"):
        sentence += f" An indication: it rests on fewer than {ENOUGH_RUNS} runs."
    return result | {"verdict": verdict, "sentence": sentence} | columns


def _direction(row: Any) -> str:
    """`worse`, `better` or `open`, however few the pairs of a contrast are."""
    return change_verdict(row.change * METRICS[row.metric].worse, row.low, row.high)


def _of_few(verdict: str, runs: int) -> str:
    return verdict if verdict == "open" or runs >= ENOUGH_RUNS else f"{verdict}_few"


def _task(analysis: Analysis, name: str) -> Found:
    """Which property of the task breaks a learner, and how sure that is."""
    place = {"algorithm": name, "metric": "wd_regret"}
    yield from _worst(analysis, name, "wd_regret")
    for row in analysis.rows("levels", class_name=analysis.base, **place).itertuples():
        if row.iqm >= THRESHOLDS["unlearnt"]:
            yield finding(
                "tasks", "first class", "unlearnt",
                f"{name} has learnt almost nothing on the first class: its WD regret there is "
                f"{fixed(row.iqm)}, and the constant action's is 1. What was not learnt cannot "
                "break, so the contrasts need a longer budget.",
                row,
            )  # fmt: skip
    order = {
        "worse": "is higher", "better": "is lower", "open": "was shown neither higher nor lower"
    }  # fmt: skip
    contrasts = analysis.rows("contrasts", **place).itertuples()
    by_change = sorted(contrasts, key=lambda row: -row.change)
    ordered = [
        *(row for row in by_change if _direction(row) == "worse"),
        *(row for row in reversed(by_change) if _direction(row) == "better"),
        *(row for row in by_change if _direction(row) == "open"),
    ]
    largest = {_cause(row): row for row in reversed(ordered)}
    for row in reversed(largest.values()):
        yield finding(
            "tasks", "axis", _of_few(_direction(row), row.pairs),
            f"Its WD regret {order[_direction(row)]} {_where(analysis, row)}: {_change(row)}.",
            row,
        )  # fmt: skip
    yield from _worst(analysis, name, "ood_regret")


def _cause(row: Any) -> str:
    """Its axis; its class, where it differs in none or several."""
    return str(row.class_name if row.axis in ("", SEVERAL) else row.axis)


def _worst(analysis: Analysis, name: str, metric: str) -> Found:
    """The largest rise of a kind of regret that is shown, and whether others may be larger.

    Without one, the largest fall.
    """
    regret = METRICS[metric].label
    contrasts = [*analysis.rows("contrasts", algorithm=name, metric=metric).itertuples()]
    worse = [row for row in contrasts if _direction(row) == "worse"]
    better = [row for row in contrasts if _direction(row) == "better"]
    if not worse and better:
        best = min(better, key=lambda row: row.change)
        yield finding(
            "tasks", f"worst {regret}", _of_few("easier", best.pairs),
            f"The {regret} of {name} falls most {_where(analysis, best)}: from {fixed(best.base)} "
            f"on {analysis.base} to {fixed(best.level)}, by {_change(best)}. No class was shown to "
            "raise it.",
            best,
        )  # fmt: skip
        return
    if not worse:
        text = f"No class was shown to change the {regret} of {name}"
        text += f" from that on {analysis.base}, which does not show that none does."
        if contrasts:
            yield finding("tasks", f"worst {regret}", "none_shown", text, algorithm=name)
        return
    worst = max(worse, key=lambda row: row.change)
    severity = "slightly_hurt"
    if worst.change >= THRESHOLDS["hurt"]:
        severity = "broken" if worst.change >= THRESHOLDS["broken"] else "hurt"
    yield finding(
        "tasks", f"worst {regret}", _of_few(severity, worst.pairs),
        f"{name} is {severity.replace('_', ' ')} by {_property(analysis, worst)}: on "
        f"{worst.class_name} its {regret} rises from {fixed(worst.base)} to {fixed(worst.level)}, "
        f"by {_change(worst)}.",
        worst,
    )  # fmt: skip
    rivals = [row for row in contrasts if _cause(row) != _cause(worst) and not row.high < worst.low]
    verdict, text = "certain", "No interval allows as large a change by another axis."
    if rivals:
        names = dict.fromkeys(_property(analysis, row) for row in rivals)
        verdict = "rivals"
        text = f"The intervals also allow as large a change by {conjunction([*names])}."
    yield finding("tasks", f"certainty of {regret}", _of_few(verdict, worst.pairs), text, worst)


def _comparison(analysis: Analysis) -> Found:
    """The best learner over all classes among those with equal data, and how sure that is."""
    over_all = {"group": ALL, "metric": "wd_regret"}
    rows = analysis.rows("aggregates", **over_all, statistic="iqm").itertuples()
    learners = [row for row in rows if row.algorithm in analysis.learners]
    data = training_data(analysis.runs)
    best: set[str] = set()
    for source in dict.fromkeys(data[row.algorithm] for row in learners):
        alike = [row for row in learners if data[row.algorithm] == source]
        if len(alike) == 1:
            continue
        row = max(alike, key=lambda row: row.value)  # of 1 − regret
        row = row._replace(value=1 - row.value, low=1 - row.high, high=1 - row.low)
        best.add(name := row.algorithm)
        of_data = f" of those with data of ν = {source[0]:g}" if source else ""
        yield finding(
            "comparison", "best", _of_few("best", row.fewest_runs),
            f"Over the {plural(row.classes, 'class', 'classes')} on which all have runs, {name} "
            f"has the lowest WD regret{of_data}: {fixed(row.value)} {_interval(row)}, where 0 is "
            "the optimum and 1 the constant ½.",
            row,
        )  # fmt: skip
    for row in analysis.rows("improvements", **over_all).itertuples():
        if {row.first, row.second} & best and {row.first, row.second} <= {*analysis.learners}:
            yield finding(
                "comparison", "improvement", _side(row, row.fewest_runs, 0.5),
                f"A run of {row.first} beats one of {row.second} with probability "
                f"{fixed(row.probability)} {_interval(row)}.",
                row,
            )  # fmt: skip


def _offline(analysis: Analysis) -> Found:
    """Where each offline learner is as good as the policy that made its data, or better."""
    near = THRESHOLDS["near"]
    for learner, table in analysis.tables["offline"].groupby("learner", sort=False):
        like_constant = table.similarity <= table.constant_similarity + near
        cases = {verdict: table.verdict == verdict for verdict in _OFFLINE}
        cases |= {"near": table.improvement.abs() <= near, "like_constant": like_constant}
        for verdict, selected in cases.items():
            rows = table[selected]
            if not rows.empty:
                at = ", ".join(
                    f"{name} (ν = {', '.join(f'{nu:g}' for nu in of_class.nu)})"
                    for name, of_class in rows.groupby("class_name", sort=False)
                )
                low, high = (signed(f(rows.improvement), 3) for f in (min, max))
                by = low if low == high else f"{low} to {high}"
                text = f"{learner} {_OFFLINE[verdict]} at {at}: r̃ − r̃ of the data is {by}."
                yield finding("offline", "data", verdict, text, algorithm=learner)


def _lives(analysis: Analysis) -> Found:
    """What each agent forgets in each stream, how its visits end, and what transfers."""
    for name in analysis.streams:
        metrics = [*analysis.rows("stream_metrics", class_name=name, region=WITHIN).itertuples()]
        for key, does in _LIVES.items():
            of_metric = [row for row in metrics if row.metric == key]
            for row in sorted(of_metric, key=lambda row: -row.iqm):
                verdict = _side(row, row.runs, METRICS[key].neutral)
                words = dict(zip(("above", "below", "open"), does, strict=True))
                text = f"{row.algorithm} {words[verdict.removesuffix('_few')]}: "
                lives = plural(row.runs, "life", "lives")
                text += f"{METRICS[key].label} {fixed(row.iqm)} {_interval(row, lives)}."
                yield finding("streams", METRICS[key].label, verdict, text, row)
            if key == "forgetting":
                yield from _forgets_more(analysis, name)
        for row in metrics:
            if row.metric == "visited_regret" and row.iqm >= THRESHOLDS["unlearnt"]:
                text = f"{row.algorithm} has learnt almost nothing: its regret at the end of a "
                text += f"visit is {fixed(row.iqm)}. It has little to forget or to lose."
                yield finding("streams", METRICS[row.metric].label, "unlearnt", text, row)


def _forgets_more(analysis: Analysis, name: str) -> Found:
    rows = analysis.rows("stream_differences", class_name=name, metric="forgetting")
    for row in rows.itertuples():
        verdict = _side(row, row.pairs, 0.0)
        text = f"Whether {row.first} or {row.second} forgets more is open"
        if verdict != "open":
            than = "more" if row.low > 0.0 else "less"
            text = f"{row.first} forgets {than} than {row.second}"
        pairs = _interval(row, plural(row.pairs, "pair"))
        text += f": the difference is {signed(row.difference)} {pairs}."
        yield finding("streams", "forgets more", verdict, text, row)


def _changes(analysis: Analysis) -> Found:
    """What streams that differ from the first in their tasks alone change for each algorithm."""
    if not analysis.streams:
        return
    rows = analysis.rows("stream_contrasts", axis=TASKS)
    rows = rows[rows.metric.isin(_LIVES)]
    base = next(iter(analysis.streams.values()))
    for name, of_class in rows.groupby("class_name", sort=False):
        info = analysis.streams[name]
        verdict, text = "other", f"{name} differs from {base.name} in its tasks alone."
        if info.related and not base.related and info.stream.kinds == base.stream.kinds:
            verdict = "related"
            text += (
                f" Its phases are rotations of one task, those of {base.name} are not, so the "
                "changes are those that relatedness makes."
            )
        yield finding("stream_changes", "relatedness", verdict, text, class_name=name)
        for row in of_class.itertuples():
            metric = METRICS[row.metric].label
            text = f"{row.algorithm}: {metric} is {_direction(row)}, {fixed(row.base)} → "
            text += f"{fixed(row.level)}, by {_change(row)}."
            verdict = _of_few(_direction(row), row.pairs)
            yield finding("stream_changes", metric, verdict, text, row)


def _caveats(analysis: Analysis, part: RunKind) -> Found:
    """Why the numbers of runs, or of lives, say less than they seem to."""
    section, counts = f"{part.prefix}caveats", analysis.counts(streams=part.streams)
    if missing := counts["missing"] + counts["failed"]:
        text = f"{missing:,} of {plural(counts['finished'] + missing, 'run')} are missing, "
        text += f"{counts['failed']:,} of them because they failed. No number includes them."
        yield finding(section, "missing runs", "missing", text, value=missing)
    if part.runs.empty:
        return
    of_place = part.runs.groupby(PLACE)
    few = of_place.size().min()
    if few < ENOUGH_RUNS:
        yield finding(
            section, "few runs", "few",
            f"Some numbers rest on {plural(few, 'run')}. The 95 % bootstrap interval of a class "
            "of three runs contains the truth in only 64–85 % of cases, depending on their "
            "distribution, of five in 80–95 %, of ten in 93–97 %. With fewer than "
            f"{ENOUGH_RUNS}, this report calls a result an indication at most.",
            runs=few,
        )  # fmt: skip
    if not part.streams:
        yield from _stuck(part.runs)
    if (of_place[part.instance].nunique() < of_place.size()).any():
        yield finding(
            section, "instances", "repeat",
            "Several runs of an algorithm share a draw of their task or stream. They are not "
            "independent draws, so the intervals are too narrow for other draws.",
        )  # fmt: skip
    intervals = int(analysis.tables[f"{part.prefix}contrasts"].low.notna().sum())
    if intervals > 1:
        value = max(1, round(_CHANCE * intervals))
        yield finding(
            section, "chance", "expected",
            f"There are {intervals} contrasts, each with its own interval. If nothing had an "
            f"effect, about {value} of them would exclude 0 by chance.",
            value=value,
        )  # fmt: skip
    learners = analysis.stream_algorithms if part.streams else analysis.learners
    for text in implementation_caveats(analysis.plan, learners):
        yield finding(section, "implementations", "differ", text)
    yield from _without_fresh(analysis, section) if part.streams else _unlike(analysis, section)


def _stuck(runs: pd.DataFrame) -> Found:
    """Runs that learnt nothing where others of the same class and algorithm did."""
    for (class_name, name), group in runs.groupby(PLACE, sort=False):
        stuck = group[group.wd_regret >= max(THRESHOLDS["stuck"], 2.0 * group.wd_regret.min())]
        if not stuck.empty:
            numbers = conjunction([f"run {run}" for run in stuck.run])
            yield finding(
                "caveats", "stuck runs", "stuck",
                f"{name} on {class_name}: {plural(len(stuck), 'run')} of {len(group)} learnt "
                f"nothing ({numbers}: WD regret {fixed(stuck.wd_regret.min())} or more) where "
                f"another ended at {fixed(group.wd_regret.min())}. Runs of two kinds make "
                "intervals less certain than 95 %.",
                algorithm=name, class_name=class_name, value=stuck.wd_regret.min(),
                runs=len(group),
            )  # fmt: skip


def _unlike(analysis: Analysis, section: str) -> Found:
    """In what else algorithms and classes differ."""
    for text in steps_caveats(analysis.plan, analysis.learners):
        yield finding(section, "training steps", "differ", text)
    init = {name: info.setting["policy_init"] for name, info in analysis.classes.items()}
    other = [
        name
        for name, info in analysis.classes.items()
        if info.axis != "policy_init" and init[name] != init[analysis.base]
    ]
    if other:
        yield finding(
            section, "policy_init", "differs",
            f"The policy_init of {conjunction(other)} also differs from the first class’s, as deep "
            "tasks require. The contrasts include its effect.",
        )  # fmt: skip


def _without_fresh(analysis: Analysis, section: str) -> Found:
    count = sum(life.fresh_agents < len(life.planned.cell.fresh) for life in analysis.lives)
    if count:
        text = f"{plural(count, 'life has', 'lives have')} not all of their fresh agents yet: no "
        text += "number on plasticity or learning transfer includes them."
        yield finding(section, "fresh agents", "missing", text, value=count)


def _property(analysis: Analysis, contrast: Any) -> str:
    """What differs between the classes of a contrast: `reward interval k`."""
    if contrast.axis == SEVERAL:
        return f"several axes at once ({analysis.classes[contrast.class_name].label})"
    return axis_label(contrast.axis) or f"the class {contrast.class_name}"


def _where(analysis: Analysis, contrast: Any) -> str:
    """The class of a contrast by its value: `where minimum reward r_min is 0 (class r_min-0)`."""
    name, axis = contrast.class_name, contrast.axis
    info = analysis.classes[name]
    if axis not in info.setting:
        return f"on {name} ({info.label})" if info.label else f"on {name}"
    value = setting_label(axis, info.setting[axis], with_symbol=False)
    return f"where {axis_label(axis)} is {value} (class {name})"


def _side(row: Any, runs: int, neutral: float) -> str:
    side = "above" if row.low > neutral else "below" if row.high < neutral else "open"
    return _of_few(side, runs)


def _change(row: Any) -> str:
    return f"{signed(row.change)} {_interval(row, plural(row.pairs, 'pair'))}"


def _interval(row: Any, *counts: str) -> str:
    known = f"95 % interval {fixed(row.low)} to {fixed(row.high)}"
    return f"({', '.join(('no interval' if math.isnan(row.low) else known, *counts))})"
