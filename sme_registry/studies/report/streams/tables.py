"""Tables of the streams of a study: functions from finished lives and their frames to frames.

The life is the unit: its visits, regions and phases are no further evidence. Each life may be in
another draw of its stream, so intervals are over draws and seeds. Ends that are unknown are NaN.
The number of runs of a metric is that of the lives that have it.

Columns of each table, those that name the row first; class_name and algorithm are not repeated.
Names of the CSV files begin with `stream_`.

    metrics             region, metric: runs, iqm, low, high; of the whole life
    visit_metrics       region, visit, phase, metric: runs, iqm, low, high; at the end of the visit
    matrices            region, visit, phase: runs, iqm, low, high of normalised regret; visit is NA
                        for the initial policy
    contrasts           as in `report.tables`, in WD, from the plan's first stream; axis: `TASKS`
                        where two streams differ in nothing else, or `SCHEDULE`
    differences         as in `report.tables`, in WD
    references          reference, region, metric: value, the median over the lives' streams
    regret              lifetime: median, q25, q75 of the regret until then; fresh: the median of
                        fresh agents', and frozen: of the same agents if they stop
                        learning after visit 0; NaN without them; runs
    reference_regret    reference, lifetime: median over the lives' streams, in expectation
    learning_curves     as in `report.tables`, on the task in force, not smoothed
    counts              lives, fresh_agents: finished; planned_lives, planned_fresh_agents; failed:
                        of both; a fresh agent that several lives have counts for each
    missing             run, phase: NA for a life; error: "" if it has not failed; key: its cell's
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from sme_registry import statistics
from sme_registry.evaluation import retention
from sme_registry.evaluation.dynamic_regret import DynamicRegret, reference_regret
from sme_registry.evaluation.stream_report import StreamReport
from sme_registry.spec import StreamSpec, StudyPlan
from sme_registry.statistics import Array
from sme_registry.studies.engine.result import CellResult
from sme_registry.studies.report.frames import frame, ordered
from sme_registry.studies.report.streams.frames import Life, StreamFrames
from sme_registry.studies.report.tables import PLACE, Bootstrap, Metric, by_place

WITHIN, OUTSIDE = "WD", "OOD"
TASKS, SCHEDULE = "tasks", "schedule"
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
_PLACE = "class_name:str algorithm:str"
_INTERVAL = "runs:int64 iqm low high"
_POINTS = 201  # of a curve of regret
_EPISODES = 1000  # in which the reference agents act, over all draws of a stream
_INITIAL = -1

Costs = Mapping[tuple[str, str], Sequence[DynamicRegret]]
"""(class, reference) → the expected dynamic regret of a reference agent in each draw."""


@dataclass(frozen=True)
class StreamInfo:
    """A class of streams of the plan."""

    name: str
    stream: StreamSpec
    axis: str

    @property
    def related(self) -> bool:
        """Whether all phases are rotations of one task."""
        return len({phase.spec.derive(rotation=0.0) for phase in self.stream.phases}) == 1


def stream_infos(plan: StudyPlan) -> dict[str, StreamInfo]:
    """Every class of streams of the plan, by name."""
    infos: dict[str, StreamInfo] = {}
    for member in plan.streams:
        stream = member.instances[0]
        base = next(iter(infos.values()), None)
        alike = base is not None and stream.switches == base.stream.switches
        axis = "" if base is None else TASKS if alike else SCHEDULE
        infos[member.name] = StreamInfo(member.name, stream, axis)
    return infos


def metrics(lives: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """The IQM over lives of every metric, in each region."""
    rows = _summary(lives, ["region"], METRICS, bootstrap)
    return frame([*rows], f"{_PLACE} region:str metric:str {_INTERVAL}")


def visit_metrics(visits: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """The IQM over lives of every metric by visit, in each region."""
    rows = _summary(visits, ["region", "visit", "phase"], BY_VISIT, bootstrap)
    return frame([*rows], f"{_PLACE} region:str visit:int64 phase:int64 metric:str {_INTERVAL}")


def matrices(retention: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """The IQM over lives of the retention matrices."""
    numbered = retention.assign(visit=retention.visit.fillna(_INITIAL).astype("int64"))
    of = (Metric("normalised_regret", "normalised regret", 1),)
    rows = _summary(numbered, ["region", "visit", "phase"], of, bootstrap)
    columns = f"{_PLACE} region:str visit:int64 phase:int64 metric:str {_INTERVAL}"
    table = frame([*rows], columns).drop(columns="metric")
    return table.assign(visit=table.visit.astype("Int64").replace(_INITIAL, pd.NA))


def _summary(
    rows: pd.DataFrame, at: list[str], metrics: Sequence[Metric], bootstrap: Bootstrap
) -> Iterator[tuple[Any, ...]]:
    """Class, algorithm, the values of `at`, metric, lives, IQM and interval, in the rows' order."""
    keys = [metric.key for metric in metrics]
    for place, group in by_place(rows).items():
        wide = group.pivot(index="run", columns=at, values=keys)
        estimates = _estimates(wide, bootstrap, *reversed(place), *at)
        for where in dict.fromkeys(group[at].itertuples(index=False, name=None)):
            for key in keys:
                found = estimates.get((key, *where))
                if found is not None:
                    yield (*place, *where, key, *found)


def _estimates(
    wide: pd.DataFrame, bootstrap: Bootstrap, *place: str
) -> dict[Any, tuple[int, float, float, float]]:
    """Lives, IQM and interval of each column that has values; lives without one do not count."""
    alike: dict[tuple[bool, ...], list[Any]] = {}
    for column in wide.columns:
        alike.setdefault(tuple(wide[column].notna()), []).append(column)
    found = {}
    for known, columns in alike.items():
        if any(known):
            values = {"": wide.loc[list(known), columns].to_numpy(dtype=np.float64)}
            ends = statistics.stratified_bootstrap(values, bootstrap.draws, bootstrap.seed(*place))
            middle = statistics.iqm(values[""])
            for column, *numbers in zip(columns, middle, *ends, strict=True):
                value, low, high = map(float, numbers)
                found[column] = (sum(known), value, low, high)
    return found


def reference_costs(lives: Sequence[Life]) -> Costs:
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


def references(lives: Sequence[Life], costs: Costs) -> pd.DataFrame:
    """The reference agents in each stream, which need no training: medians over its draws."""
    values: dict[tuple[str, ...], dict[str, float]] = {}
    for life in lives:
        for region in (*life.report.regions, life.report.ood):
            for name, reference in region.references.items():
                for metric in _RETENTION:
                    value = reference.final(metric)
                    if value is not None:
                        at = life.planned.class_name, name, region.name, metric
                        values.setdefault(at, {})[life.report.stream_digest] = value
    rows = [(*at, float(np.median([*each.values()]))) for at, each in values.items()]
    rows += [
        (*place, WITHIN, "online_regret", float(np.median([log.online_regret for log in logs])))
        for place, logs in costs.items()
    ]
    return frame(rows, "class_name:str reference:str region:str metric:str value")


def regret(lives: Sequence[Life]) -> pd.DataFrame:
    """The dynamic regret until points of the life, next to that of fresh agents."""
    columns = f"{_PLACE} lifetime median q25 q75 fresh frozen runs:int64"
    tables = [frame([], columns)]
    for place, group in _groups(lives).items():
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


def reference_curves(costs: Costs) -> pd.DataFrame:
    """The dynamic regret of reference agents until points of the life, if there is any."""
    tables = [frame([], "class_name:str reference:str lifetime median")]
    for (class_name, reference), logs in costs.items():
        if max(log.dynamic_regret for log in logs) > 0.0:
            x = np.linspace(0.0, logs[0].lifetime[-1], _POINTS)
            median = np.median(_until(logs, x), axis=0)
            at = {"class_name": class_name, "reference": reference}
            tables.append(pd.DataFrame({**at, "lifetime": x, "median": median}))
    return pd.concat(tables, ignore_index=True)


def _until(logs: Sequence[DynamicRegret], lifetime: Array) -> Array:
    """`[n, X]` regret of each life until these lifetimes."""
    return np.array([log.until(lifetime) for log in logs])


def counts(
    plan: StudyPlan, finished: Mapping[str, CellResult], missing: pd.DataFrame
) -> pd.DataFrame:
    """How many lives and fresh agents have finished, are planned, and failed."""
    tallies: dict[tuple[str, str], list[int]] = {}
    for planned in ordered(plan):
        if planned.in_stream:
            tally = tallies.setdefault((planned.class_name, planned.algorithm), [0, 0, 0, 0])
            kind = 0 if planned.phase is None else 1
            tally[kind] += planned.cell.digest in finished
            tally[2 + kind] += 1
    failed = missing[missing.error != ""].groupby(PLACE).size()
    rows = [(*place, *tally, failed.get(place, 0)) for place, tally in tallies.items()]
    names = ("lives", "fresh_agents", "planned_lives", "planned_fresh_agents", "failed")
    return frame(rows, " ".join([_PLACE, *(f"{name}:int64" for name in names)]))


def missing(
    plan: StudyPlan,
    finished: Mapping[str, CellResult],
    errors: Mapping[str, str],
    requested: Collection[str] | None = None,
) -> pd.DataFrame:
    """The requested lives and fresh agents that have not finished; see `tables.missing`."""
    rows = [
        (each.class_name, each.algorithm, each.run, each.phase, errors.get(key, ""), key)
        for each in plan.cells
        if each.in_stream
        and (key := each.cell.digest) not in finished
        and (requested is None or key in requested or key in errors)
    ]
    return frame(rows, f"{_PLACE} run:int64 phase:Int64 error:str key:str")


def within(frames: StreamFrames) -> pd.DataFrame:
    """One row per life: its metrics in WD."""
    return frames.lives[frames.lives.region == WITHIN].reset_index(drop=True)


def _groups(lives: Sequence[Life]) -> dict[tuple[str, str], list[Life]]:
    groups: dict[tuple[str, str], list[Life]] = {}
    for life in lives:
        groups.setdefault((life.planned.class_name, life.planned.algorithm), []).append(life)
    return groups
