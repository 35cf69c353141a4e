"""A study's streams: their tables, and what is found in them.

The life is the unit, and the number of runs that of its lives. Columns of each table, those that
name the row first; class_name and algorithm are not repeated.
stream_contrasts, stream_differences and stream_learning_curves are as those of single tasks, in WD:
an axis is `TASKS` where two streams differ in nothing else, or `SCHEDULE`; curves are not smoothed.

    stream_missing           run, phase: NA for a life; error; key of its cell
    stream_counts            lives, fresh_agents: finished; planned_lives, planned_fresh_agents;
                             failed: of both; a fresh agent that several lives have counts for each
    stream_metrics           region, metric: runs, iqm, low, high; of the whole life
    stream_visit_metrics     region, visit, phase, metric: runs, iqm, low, high; at its end
    stream_matrices          region, visit, phase: runs, iqm, low, high of normalised regret; visit
                             is NA for the initial policy
    stream_references        reference, region, metric: value, the median over the lives' streams
    stream_regret            lifetime: median, q25, q75 of the regret until then; fresh: the median
                             of fresh agents', and frozen: of the same agents if they stop learning
                             after visit 0; NaN without them; runs
    stream_reference_regret  reference, lifetime: median over the lives' streams, in expectation
"""

from __future__ import annotations

import functools
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sme_registry.evaluation import retention
from sme_registry.evaluation.dynamic_regret import DynamicRegret, reference_regret
from sme_registry.evaluation.streams import StreamReport
from sme_registry.io.markup import fixed, plural, signed
from sme_registry.statistics import Array
from sme_registry.studies.report.analysis import (
    ENOUGH_RUNS,
    INTERVAL,
    PLACE_COLUMNS,
    Analysis,
    by_place,
    summary,
    table,
)
from sme_registry.studies.report.design import TASKS, WITHIN, Metric, metrics_of
from sme_registry.studies.report.findings import (
    THRESHOLDS,
    Found,
    Rows,
    change_text,
    few_runs,
    finder,
    finding,
    indication,
    lives_text,
    missing_runs,
    side,
)
from sme_registry.studies.report.frames import FinishedLife, frame, ordered

_UNLEARNT = THRESHOLDS["unlearnt"]
_CONTRASTED = {
    "forgetting": "forgetting",
    "plasticity_ratio": "the plasticity ratio",
    "forward_transfer": "forward transfer",
    "learning_transfer": "learning transfer",
}
_AT = "region:str visit:int64 phase:int64 metric:str"
_POINTS = 201  # of a curve of regret
_EPISODES = 1000  # in which the reference agents act, over all draws of a stream
_INITIAL = -1

Costs = Mapping[tuple[str, str], Sequence[DynamicRegret]]
"""(class, reference) → the expected dynamic regret of a reference agent in each draw."""


@table(
    "stream_counts",
    f"{PLACE_COLUMNS} lives:int64 fresh_agents:int64 planned_lives:int64 "
    "planned_fresh_agents:int64 failed:int64",
)
def _counts(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    states: dict[tuple[str, str], list[tuple[bool, str]]] = defaultdict(list)
    for planned in ordered(analysis.plan):
        if planned.in_stream:
            state = planned.phase is not None, analysis.state(planned.cell.digest)
            states[planned.class_name, planned.algorithm].append(state)
    for at, of_place in states.items():
        finished = (of_place.count((fresh, "finished")) for fresh in (False, True))
        fresh = sum(fresh for fresh, _ in of_place)
        failed = sum(state == "failed" for _, state in of_place)
        yield (*at, *finished, len(of_place) - fresh, fresh, failed)


@table("stream_metrics", f"{PLACE_COLUMNS} region:str metric:str {INTERVAL}")
def _metrics(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    return _summary(analysis, analysis.tables["stream_lives"], ["region"], metrics_of("life"))


@table("stream_visit_metrics", f"{PLACE_COLUMNS} {_AT} {INTERVAL}")
def _visit_metrics(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    visits = analysis.tables["stream_visits"]
    return _summary(analysis, visits, ["region", "visit", "phase"], metrics_of("visit"))


@table("stream_matrices", "")
def _matrices(analysis: Analysis) -> pd.DataFrame:
    """The IQM over lives of the retention matrices."""
    rows = analysis.tables["stream_retention"]
    rows = rows.assign(visit=rows.visit.fillna(_INITIAL).astype("int64"))
    rows = _summary(analysis, rows, ["region", "visit", "phase"], metrics_of("visit")[:1])
    matrices = frame([*rows], f"{PLACE_COLUMNS} {_AT} {INTERVAL}").drop(columns="metric")
    return matrices.assign(visit=matrices.visit.astype("Int64").replace(_INITIAL, pd.NA))


@table("stream_references", "class_name:str reference:str region:str metric:str value")
def _references(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    """The reference agents in each stream, which need no training: medians over its draws."""
    values: dict[tuple[str, ...], dict[str, float]] = defaultdict(dict)
    for life in analysis.lives:
        for region in (*life.report.regions, life.report.ood):
            for name, reference in region.references.items():
                for metric in retention.METRICS:
                    value = reference.final(metric)
                    if value is not None:
                        at = life.planned.class_name, name, region.name, metric
                        values[at][life.report.stream_digest] = value
    for where, of_streams in values.items():
        yield (*where, float(np.median([*of_streams.values()])))
    for place, logs in analysis.reference_costs.items():
        regret = float(np.median([log.online_regret for log in logs]))
        yield (*place, WITHIN, "online_regret", regret)


@table("stream_regret", "")
def _regret(analysis: Analysis) -> pd.DataFrame:
    return regret(analysis.lives)


@table("stream_reference_regret", "class_name:str reference:str lifetime median")
def _reference_regret(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    """The dynamic regret of reference agents until points of the life, if there is any."""
    for place, logs in analysis.reference_costs.items():
        if max(log.dynamic_regret for log in logs) > 0.0:
            x = np.linspace(0.0, logs[0].lifetime[-1], _POINTS)
            for point in zip(x, np.median(_until(logs, x), axis=0), strict=True):
                yield (*place, *point)


def _summary(
    analysis: Analysis, rows: pd.DataFrame, at: list[str], metrics: Sequence[Metric]
) -> Iterator[tuple[Any, ...]]:
    return summary(
        rows, at, metrics, analysis.bootstrap, lambda name, algorithm, *_: (algorithm, name, *at)
    )


def reference_costs(lives: Sequence[FinishedLife]) -> Costs:
    """The expected dynamic regret of the reference agents in the streams of these lives."""
    streams: dict[str, dict[str, StreamReport]] = defaultdict(dict)
    for life in lives:
        of_class, report = streams[life.planned.class_name], life.report
        if report.reference_regret or report.stream_digest not in of_class:
            of_class[report.stream_digest] = report
    costs: dict[tuple[str, str], list[DynamicRegret]] = defaultdict(list)
    for class_name, of_class in streams.items():
        for report in of_class.values():
            logs = report.reference_regret.items()
            untrained = {name: log for name, log in logs if name not in retention.TRAINED}
            if not untrained:  # a life of an older version
                episodes = -(-_EPISODES // len(of_class))
                untrained = reference_regret(report.stream, episodes=episodes)
            for name, log in untrained.items():
                costs[class_name, name].append(log)
    return costs


def regret(lives: Sequence[FinishedLife]) -> pd.DataFrame:
    """The dynamic regret until points of the life, next to that of fresh agents."""
    columns = f"{PLACE_COLUMNS} lifetime median q25 q75 fresh frozen runs:int64"
    tables = [frame([], columns)]
    groups: dict[tuple[str, str], list[StreamReport]] = defaultdict(list)
    for life in lives:
        if life.report.dynamic_regret is not None:
            groups[life.planned.class_name, life.planned.algorithm].append(life.report)
    for (name, algorithm), reports in groups.items():
        logs = [report.dynamic_regret for report in reports if report.dynamic_regret is not None]
        x = np.linspace(0.0, min(log.lifetime[-1] for log in logs), _POINTS)
        q25, median, q75 = np.quantile(_until(logs, x), [0.25, 0.5, 0.75], axis=0)
        curve: dict[str, Any] = {
            "class_name": name, "algorithm": algorithm, "lifetime": x, "median": median,
            "q25": q25, "q75": q75, "runs": len(logs),
        }  # fmt: skip
        for column, agent in (("fresh", "fresh_agents"), ("frozen", "frozen_agent")):
            beside = [r.reference_regret[agent] for r in reports if agent in r.reference_regret]
            curve[column] = np.median(_until(beside, x), axis=0) if beside else math.nan
        tables.append(pd.DataFrame(curve))
    return pd.concat(tables, ignore_index=True)[list(tables[0])]


def _until(logs: Sequence[DynamicRegret], lifetime: Array) -> Array:
    """`[n, X]` regret of each life until these lifetimes."""
    return np.array([log.until(lifetime) for log in logs])


@finder
def _stream_findings(analysis: Analysis) -> Found:
    if analysis.streams:
        yield from _streams(analysis)
        yield from _changes(analysis)
        yield from _caveats(analysis)


def _streams(analysis: Analysis) -> Found:
    rows = analysis.tables["stream_metrics"]
    of_place = by_place(rows[rows.region == WITHIN])
    for name, info in analysis.streams.items():
        lives = {
            algorithm: {row.metric: row for row in of_life.itertuples()}
            for (class_name, algorithm), of_life in of_place.items()
            if class_name == name
        }
        if not lives:
            continue
        metrics = [of_life["forgetting"] for of_life in lives.values() if "forgetting" in of_life]
        metrics.sort(key=lambda row: row.iqm, reverse=True)
        learnt = any(of_life["visited_regret"].iqm < _UNLEARNT for of_life in lives.values())
        yield from _forgets(analysis, name, metrics, learnt=learnt)
        for algorithm in [row.algorithm for row in metrics] or list(lives):
            yield from _life(lives[algorithm], single_visit=info.stream.visits == 1)
        incomplete = sum(
            life.planned.class_name == name and life.fresh_agents < len(life.planned.cell.fresh)
            for life in analysis.lives
        )
        if incomplete:
            yield finding(
                "streams", "fresh agents", "missing",
                f"{plural(incomplete, 'life has', 'lives have')} not all of their fresh agents "
                "yet: no number on plasticity or learning transfer includes them.",
                class_name=name, value=incomplete,
            )  # fmt: skip


def _forgets(analysis: Analysis, name: str, metrics: Rows, *, learnt: bool) -> Found:
    """Whether any agent forgets in a stream, and whether one forgets most."""
    if not metrics:
        text = f"In {name} each life has a single visit, so there is nothing to forget."
        yield finding("streams", "forgets", "single_visit", text, class_name=name)
        return
    verdict, first = _forgetting(metrics, learnt=learnt)
    rivals = list(_forgets_more(analysis, name, metrics))
    certain = first is metrics[0] and rivals and all(r["verdict"] == "more" for r in rivals)
    forgets = f"{first.algorithm} forgets{' most' if certain else ''}: at the end of the life, "
    value = f"{fixed(first.iqm)}{lives_text(first)}"
    below = f"performance on earlier phases is {fixed(first.iqm)} below its best{lives_text(first)}"
    sentences = {
        "forgets": f"{forgets}{below}.",
        "indication": f"there are indications that {forgets}{below}.",
        "none": f"no algorithm forgets: the largest value, that of {first.algorithm}, is {value}.",
        "unlearnt": "no algorithm has learnt enough to forget: each has learnt almost nothing in "
        "its visits.",
        "open": "no algorithm was shown to forget, and none was shown not to. The largest value is "
        f"that of {first.algorithm}, {value}.",
    }
    yield finding("streams", "forgets", verdict, f"In {name}, {sentences[verdict]}", first)
    if verdict in ("forgets", "indication"):
        most = metrics[0]
        if first is not most:
            value = f"{fixed(most.iqm)}{lives_text(most)}"
            text = f"The largest value, that of {most.algorithm}, is open: {value}."
            yield finding("streams", "largest forgetting", "open", text, most)
        yield from rivals


def _forgetting(metrics: Rows, *, learnt: bool) -> tuple[str, Any]:
    """The verdict on a stream, and the agent of which its sentence speaks."""
    above = [row for row in metrics if row.low > 0.0]
    if above:
        certain = [row for row in above if row.runs >= ENOUGH_RUNS]
        return ("forgets", certain[0]) if certain else ("indication", above[0])
    if not learnt:
        return "unlearnt", metrics[0]
    # Shown for each of them: the whole interval is not above 0.
    none = all(
        row.runs >= ENOUGH_RUNS and (row.high < 0.0 or row.low == row.high == 0.0)
        for row in metrics
    )
    return "none" if none else "open", metrics[0]


def _forgets_more(analysis: Analysis, name: str, metrics: Rows) -> Found:
    """The paired differences of the agent that forgets most from each other one."""
    rows = analysis.tables["stream_differences"]
    rows = rows[(rows.class_name == name) & (rows.metric == "forgetting")]
    most, *others = (row.algorithm for row in metrics)
    pairs = {frozenset((row.first, row.second)): row for row in rows.itertuples()}
    for other in others:
        row = pairs.get(frozenset((most, other)))
        if row is None:
            continue
        value, low, high = row.difference, row.low, row.high
        if row.first != most:
            value, low, high = -value, -high, -low
        verdict, begin = "open", f"{most}’s value is the largest, but {other} may forget more: the"
        if low > 0.0:
            verdict, begin = "more", f"{most} forgets more than {other}: the"
            if not row.enough_pairs:
                verdict = "indication"
                begin = f"There are indications of few pairs that {begin}"
        interval = "" if math.isnan(low) else f" ({fixed(low)} to {fixed(high)})"
        yield finding(
            "streams", "forgets more", verdict, f"{begin} difference is {signed(value)}{interval}.",
            row, algorithm=most, value=value, low=low, high=high,
        )  # fmt: skip


def _life(metrics: dict[str, Any], *, single_visit: bool) -> Found:
    visited = metrics["visited_regret"]
    name, unlearnt = visited.algorithm, visited.iqm >= _UNLEARNT
    about = functools.partial(finding, "streams", algorithm=name, class_name=visited.class_name)
    text = (
        f"{name} ({plural(visited.runs, 'life', 'lives')}): at the end of a visit its normalised "
        f"regret on the phase is {fixed(visited.iqm)}."
    )
    if unlearnt:
        text += (
            " It has learnt almost nothing, so it has little to forget and hardly any plasticity "
            "to lose."
        )
    yield about("life", "unlearnt" if unlearnt else "learnt", text, visited)
    if (row := metrics.get("forgetting")) is not None:
        text = f"Forgetting of {name}: {fixed(row.iqm)}{lives_text(row)}."
        yield about("forgetting", side(row, 0.0), text, row)
    if (row := metrics.get("plasticity_ratio")) is not None:
        verdict, few = side(row, 1.0), indication(row)
        sentences = {
            "above": f"{name} loses plasticity{few}",
            "below": f"{name} learns more than a fresh agent{few}",
            "open": f"for {name} no loss of plasticity was shown, and none excluded",
        }
        text = (
            f"Plasticity: {sentences[verdict]}: after a visit other than the first, its regret on "
            f"the phase is {fixed(row.iqm)} times a fresh agent’s{lives_text(row)}."
        )
        yield about("plasticity", verdict, text, row)
    elif single_visit:
        text = "Plasticity: a life of one visit is a fresh agent itself."
        yield about("plasticity", "single_visit", text)
    else:
        text = f"Plasticity: that of {name} is unknown, since no life has all of its fresh agents."
        yield about("plasticity", "unknown", text)
    if (row := metrics.get("forward_transfer")) is not None:
        verdict, before = side(row, 0.0), "than before training on phases before their first visit"
        sentences = {
            "above": f"{name} is better {before}{indication(row)}",
            "below": f"{name} is worse {before}{indication(row)}",
            "open": f"Whether {name} is better or worse {before} is open",
        }
        text = f"{sentences[verdict]}: forward transfer is {signed(row.iqm)}{lives_text(row)}."
        yield about("forward transfer", verdict, text, row)


def _changes(analysis: Analysis) -> Found:
    """What streams that differ from the first in their tasks alone change for each algorithm."""
    rows = analysis.tables["stream_contrasts"]
    rows = rows[(rows.axis == TASKS) & rows.metric.isin(_CONTRASTED)]
    base = analysis.streams[analysis.stream_base]
    for name, of_class in rows.groupby("class_name", sort=False):
        info = analysis.streams[name]
        verdict, text = "other", f"{name} differs from {base.name} in its tasks alone."
        if info.related and not base.related and info.stream.kinds == base.stream.kinds:
            verdict, text = "related", (
                f"The streams differ in their tasks alone. The phases of {name} are rotations of "
                f"one task, those of {base.name} are not, so the changes from {base.name} are "
                "those that relatedness makes."
            )  # fmt: skip
        yield finding("stream_changes", "relatedness", verdict, text, class_name=name)
        for row in of_class.itertuples():
            verdict, text = row.verdict, row.verdict
            if row.verdict == "open":
                text = "open, since the interval contains 0 or is unknown"
            elif not row.enough_pairs:
                verdict, text = f"{row.verdict}_few", f"{row.verdict}, an indication from few pairs"
            change = f"{fixed(row.base)} → {fixed(row.level)}, by {change_text(row)}"
            text = f"{row.algorithm}: {_CONTRASTED[row.metric]} is {text}, {change}."
            yield finding("stream_changes", "change", verdict, text, row)


def _caveats(analysis: Analysis) -> Found:
    yield from missing_runs("stream_caveats", analysis.counts(streams=True))
    lives = analysis.tables["stream_lives"]
    places = lives[lives.region == WITHIN].groupby(["class_name", "algorithm"])
    if len(places):
        yield from few_runs("stream_caveats", int(places.size().min()), "life", "lives")
    if (places.stream_digest.nunique() < places.size()).any():
        yield finding(
            "stream_caveats", "draws", "repeat",
            "Several lives of an algorithm share a draw of their stream. They are not independent "
            "draws of the tasks, so the intervals are too narrow for other draws.",
        )  # fmt: skip
