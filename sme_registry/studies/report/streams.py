"""The tables of a study's streams; `tables` has those that they share with single tasks.

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

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sme_registry.evaluation import retention
from sme_registry.evaluation.dynamic_regret import DynamicRegret, reference_regret
from sme_registry.evaluation.streams import StreamReport
from sme_registry.statistics import Array
from sme_registry.studies.report.analysis import (
    INTERVAL,
    PLACE_COLUMNS,
    Analysis,
    summary,
    table,
)
from sme_registry.studies.report.design import WITHIN, Metric, metrics_of
from sme_registry.studies.report.frames import FinishedLife, frame, ordered

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
    of_phases = metrics_of("visit", rows.columns)
    rows = _summary(analysis, rows, ["region", "visit", "phase"], of_phases)
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
