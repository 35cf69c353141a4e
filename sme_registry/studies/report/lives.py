"""The tables of a study's streams; the life is the unit, and the number of runs that of its lives.

Columns of each table, those that name the row first; class_name and algorithm are not repeated.

    stream_metrics           region, metric: runs, iqm, low, high; of the whole life
    stream_visit_metrics     region, visit, phase, metric: runs, iqm, low, high; at its end
    stream_matrices          region, visit, phase: runs, iqm, low, high of normalised regret; visit
                             is NA for the initial policy
    stream_contrasts         as `contrasts`, in WD, from the plan's first stream; axis: `TASKS`
                             where two streams differ in nothing else, or `SCHEDULE`
    stream_differences       as `differences`, in WD
    stream_references        reference, region, metric: value, the median over the lives' streams
    stream_regret            lifetime: median, q25, q75 of the regret until then; fresh: the median
                             of fresh agents', and frozen: of the same agents if they stop learning
                             after visit 0; NaN without them; runs
    stream_reference_regret  reference, lifetime: median over the lives' streams, in expectation
    stream_learning_curves   as `learning_curves`, on the task in force, not smoothed
    stream_counts            lives, fresh_agents: finished; planned_lives, planned_fresh_agents;
                             failed: of both; a fresh agent that several lives have counts for each
    stream_missing           run, phase: NA for a life; error: "" if it has not failed; key of its
                             cell
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sme_registry.evaluation import retention
from sme_registry.evaluation.dynamic_regret import DynamicRegret, reference_regret
from sme_registry.evaluation.streams import StreamReport
from sme_registry.spec import StudyPlan
from sme_registry.statistics import Array
from sme_registry.studies.engine.result import CellResult
from sme_registry.studies.report.analysis import (
    CONTRASTS,
    DIFFERENCES,
    INTERVAL,
    LEARNING_CURVES,
    PLACE,
    PLACE_COLUMNS,
    Analysis,
    Metric,
    contrasts,
    differences,
    learning_curves,
    missing_runs,
    summary,
    table,
)
from sme_registry.studies.report.frames import (
    FinishedLife,
    finished_lives,
    frame,
    ordered,
    stream_frames,
)

WITHIN, OUTSIDE = "WD", "OOD"
_VISITED = "regret on the visited phase"
_LESS_IS_BETTER = ("forgetting", "plasticity_ratio", "plasticity_difference")
_RETENTION = {
    key: Metric(key, label, 1 if key in _LESS_IS_BETTER else -1)
    for key, label in retention.METRICS.items()
}
OF_TRAINING = (
    Metric("learning_transfer", "learning transfer", -1),
    Metric("online_regret", "online regret", 1, 3),
    Metric("frozen_online_regret", f"online regret, {retention.LABELS['frozen_agent']}", 1, 3),
)
METRICS = (Metric("visited_regret", _VISITED, 1), *_RETENTION.values(), *OF_TRAINING)
BY_VISIT = (
    Metric("normalised_regret", _VISITED, 1),
    *(_RETENTION[key] for key in retention.BY_VISIT),
    *OF_TRAINING,
)
_AT = "region:str visit:int64 phase:int64 metric:str"
_POINTS = 201  # of a curve of regret
_EPISODES = 1000  # in which the reference agents act, over all draws of a stream
_INITIAL = -1

Costs = Mapping[tuple[str, str], Sequence[DynamicRegret]]
"""(class, reference) → the expected dynamic regret of a reference agent in each draw."""


def lives_of(
    plan: StudyPlan, finished: Mapping[str, CellResult]
) -> tuple[tuple[FinishedLife, ...], dict[str, pd.DataFrame]]:
    """The finished lives, and their frames by the names of the tables."""
    lives = finished_lives(plan, finished) if plan.streams else []
    frames = stream_frames(lives)._asdict() if plan.streams else {}
    return tuple(lives), {f"stream_{name}": each for name, each in frames.items()}


@table("stream_missing", f"{PLACE_COLUMNS} run:int64 phase:Int64 error:str key:str")
def _missing(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    return missing_runs(analysis, streams=True)


@table(
    "stream_counts",
    f"{PLACE_COLUMNS} lives:int64 fresh_agents:int64 planned_lives:int64 "
    "planned_fresh_agents:int64 failed:int64",
)
def _counts(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    """How many lives and fresh agents have finished, are planned, and failed."""
    counts: dict[tuple[str, str], list[int]] = defaultdict(lambda: [0, 0, 0, 0])
    for planned in ordered(analysis.plan):
        if planned.in_stream:
            count = counts[planned.class_name, planned.algorithm]
            kind = 0 if planned.phase is None else 1
            count[kind] += planned.cell.digest in analysis.cells
            count[2 + kind] += 1
    missing = analysis.tables["stream_missing"]
    failed = missing[missing.error != ""].groupby(PLACE).size()
    return ((*place, *count, failed.get(place, 0)) for place, count in counts.items())


@table("stream_metrics", f"{PLACE_COLUMNS} region:str metric:str {INTERVAL}")
def _metrics(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    return _summary(analysis, analysis.tables["stream_lives"], ["region"], METRICS)


@table("stream_visit_metrics", f"{PLACE_COLUMNS} {_AT} {INTERVAL}")
def _visit_metrics(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    visits = analysis.tables["stream_visits"]
    return _summary(analysis, visits, ["region", "visit", "phase"], BY_VISIT)


@table("stream_matrices", "")
def _matrices(analysis: Analysis) -> pd.DataFrame:
    """The IQM over lives of the retention matrices."""
    rows = analysis.tables["stream_retention"]
    rows = rows.assign(visit=rows.visit.fillna(_INITIAL).astype("int64"))
    rows = _summary(analysis, rows, ["region", "visit", "phase"], BY_VISIT[:1])
    matrices = frame([*rows], f"{PLACE_COLUMNS} {_AT} {INTERVAL}").drop(columns="metric")
    return matrices.assign(visit=matrices.visit.astype("Int64").replace(_INITIAL, pd.NA))


@table("stream_contrasts", CONTRASTS)
def _contrasts(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    axes = {name: info.axis for name, info in analysis.streams.items()}
    return contrasts(_within(analysis), axes, analysis.bootstrap, METRICS)


@table("stream_differences", DIFFERENCES)
def _differences(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    pairs = itertools.combinations(analysis.stream_algorithms, 2)
    draws = analysis.bootstrap.draws
    return differences(_within(analysis), pairs, METRICS, draws, "stream_digest")


@table("stream_references", "class_name:str reference:str region:str metric:str value")
def _references(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    """The reference agents in each stream, which need no training: medians over its draws."""
    values: dict[tuple[str, ...], dict[str, float]] = defaultdict(dict)
    for life in analysis.lives:
        for region in (*life.report.regions, life.report.ood):
            for name, reference in region.references.items():
                for metric in _RETENTION:
                    value = reference.final(metric)
                    if value is not None:
                        at = life.planned.class_name, name, region.name, metric
                        values[at][life.report.stream_digest] = value
    for where, each in values.items():
        yield (*where, float(np.median([*each.values()])))
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


@table("stream_learning_curves", LEARNING_CURVES)
def _learning_curves(analysis: Analysis) -> pd.DataFrame:
    return learning_curves(analysis.tables["stream_curves"], _within(analysis), lambda _: 1)


def _summary(
    analysis: Analysis, rows: pd.DataFrame, at: list[str], metrics: Sequence[Metric]
) -> Iterator[tuple[Any, ...]]:
    """All metrics of an algorithm in a stream, of one seed."""
    return summary(
        rows, at, metrics, analysis.bootstrap, lambda name, algorithm, *_: (algorithm, name, *at)
    )


def _within(analysis: Analysis) -> pd.DataFrame:
    """One row per life: its metrics in WD."""
    lives = analysis.tables["stream_lives"]
    return lives[lives.region == WITHIN].reset_index(drop=True)


def reference_costs(lives: Sequence[FinishedLife]) -> Costs:
    """The expected dynamic regret of the reference agents in the streams of these lives."""
    streams: dict[str, dict[str, StreamReport]] = {}
    for life in lives:
        of_class = streams.setdefault(life.planned.class_name, {})
        if life.report.reference_regret or life.report.stream_digest not in of_class:
            of_class[life.report.stream_digest] = life.report
    costs: dict[tuple[str, str], list[DynamicRegret]] = {}
    for class_name, of_class in streams.items():
        for one in of_class.values():
            for name, log in _untrained(one, -(-_EPISODES // len(of_class))).items():
                costs.setdefault((class_name, name), []).append(log)
    return costs


def _untrained(life: StreamReport, episodes: int) -> dict[str, DynamicRegret]:
    """The reference agents of a life's stream, which lives of older versions do not have."""
    recorded = {k: log for k, log in life.reference_regret.items() if k not in retention.TRAINED}
    return recorded or reference_regret(life.stream, episodes=episodes)


def regret(lives: Sequence[FinishedLife]) -> pd.DataFrame:
    """The dynamic regret until points of the life, next to that of fresh agents."""
    columns = f"{PLACE_COLUMNS} lifetime median q25 q75 fresh frozen runs:int64"
    tables = [frame([], columns)]
    groups: dict[tuple[str, str], list[FinishedLife]] = defaultdict(list)
    for life in lives:
        groups[life.planned.class_name, life.planned.algorithm].append(life)
    for place, group in groups.items():
        logs = [log for life in group if (log := life.report.dynamic_regret) is not None]
        if not logs:
            continue
        references = [life.report.reference_regret for life in group]
        beside = {
            column: [each[name] for each in references if name in each]
            for column, name in (("fresh", "fresh_agents"), ("frozen", "frozen_agent"))
        }
        x = np.linspace(0.0, min(log.lifetime[-1] for log in logs), _POINTS)
        q25, median, q75 = np.quantile(_until(logs, x), [0.25, 0.5, 0.75], axis=0)
        table = {
            "class_name": place[0], "algorithm": place[1], "lifetime": x, "median": median,
            "q25": q25, "q75": q75, "runs": len(logs),
        }  # fmt: skip
        for column, agents in beside.items():
            table[column] = np.median(_until(agents, x), axis=0) if agents else math.nan
        tables.append(pd.DataFrame(table))
    return pd.concat(tables, ignore_index=True)


def _until(logs: Sequence[DynamicRegret], lifetime: Array) -> Array:
    """`[n, X]` regret of each life until these lifetimes."""
    return np.array([log.until(lifetime) for log in logs])
