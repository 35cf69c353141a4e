"""`Analysis`: a study's finished runs and its tables, and what tables are made of.

The run is the unit, or in streams the life: its regions and evaluations are no further evidence.
Missing runs are part of no number but counts.

Of streams there are also, with the columns that name the row first, the tables

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
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sme_registry import statistics
from sme_registry.evaluation import retention
from sme_registry.evaluation.dynamic_regret import DynamicRegret, reference_regret
from sme_registry.evaluation.streams import StreamReport
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.statistics import Array, Statistic
from sme_registry.studies.report.design import (
    WITHIN,
    ClassInfo,
    Group,
    Metric,
    StreamInfo,
    metrics_of,
)
from sme_registry.studies.report.frames import FinishedLife, frame
from sme_registry.studies.result import CellResult

# With fewer runs an interval is an indication only: docs/results/interval_coverage.py measures how
# often it covers the truth.
ENOUGH_RUNS = 5
OFFLINE_INTERVAL = 4  # with fewer runs a mean improvement has no interval at all
PLACE = ["class_name", "algorithm"]
PLACE_COLUMNS = "class_name:str algorithm:str "
INTERVAL = "runs:int64 iqm low high"
CURVES = {"episode_return": "return, % of optimum", "regret": "mean regret per step"}


@dataclass(frozen=True)
class Bootstrap:
    """Intervals as a function of the plan's digest and of their table and row."""

    digest: str
    draws: int = statistics.DRAWS

    def seed(self, *place: str) -> str:
        return " ".join((self.digest, *place))

    def interval(
        self, classes: Mapping[str, Array], *place: str, statistic: Statistic = statistics.iqm
    ) -> tuple[float, float]:
        """The interval over classes of `[n, 1]` runs each; NaN if any has a single run."""
        if min(map(len, classes.values())) == 1:
            return math.nan, math.nan
        seed = self.seed(*place)
        low, high = statistics.stratified_bootstrap(classes, self.draws, seed, statistic)
        return float(low[0]), float(high[0])


class RunKind(NamedTuple):
    """The runs on single tasks, or the lives in streams with their metrics in WD: a row each."""

    streams: bool
    runs: pd.DataFrame
    classes: Mapping[str, ClassInfo | StreamInfo]  # the others are compared with the first
    algorithms: tuple[str, ...]
    metrics: tuple[Metric, ...]
    instance: str  # the column that says on which instance a run is

    @property
    def prefix(self) -> str:
        """Of the names of its tables."""
        return "stream_" if self.streams else ""


@dataclass(frozen=True, eq=False)
class Analysis:
    """A study's finished runs, lives and tables, which the module `tables` documents.

    `cells` and `models` are by the digests of cells, `classes` and `streams` by name, the first one
    first. `places` has a row for each planned cell; its state is `finished`, `failed`, `missing`,
    or `left out` where no run of its class and algorithm has ended. `algorithms` have a finished
    run on a single task; `learners` are those of them that learn; `coloured` are all that learn,
    so that a method has one colour in every figure of a study.
    """

    file: StudyFile
    cells: Mapping[str, CellResult]
    places: pd.DataFrame
    models: Mapping[str, Path]
    bootstrap: Bootstrap
    classes: Mapping[str, ClassInfo]
    streams: Mapping[str, StreamInfo]
    algorithms: tuple[str, ...]
    learners: tuple[str, ...]
    coloured: tuple[str, ...]
    groups: tuple[Group, ...]
    runs: pd.DataFrame
    lives: tuple[FinishedLife, ...]
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)

    @property
    def plan(self) -> StudyPlan:
        return self.file.plan

    @property
    def base(self) -> str:
        """The name of the first class; "" where the plan has none."""
        return next(iter(self.classes), "")

    @functools.cached_property
    def reference_costs(self) -> Costs:
        return reference_costs(self.lives)

    @property
    def stream_algorithms(self) -> tuple[str, ...]:
        present = {life.planned.algorithm for life in self.lives}
        return tuple(a.name for a in self.plan.algorithms if a.name in present)

    @property
    def parts(self) -> tuple[RunKind, ...]:
        metrics = metrics_of("run", self.runs)
        tasks = RunKind(False, self.runs, self.classes, self.algorithms, metrics, "spec_digest")
        if not self.streams:
            return (tasks,)
        lives = self.rows("stream_lives", region=WITHIN).reset_index(drop=True)
        algorithms, metrics = self.stream_algorithms, metrics_of("life")
        return tasks, RunKind(True, lives, self.streams, algorithms, metrics, "stream_digest")

    def rows(self, table: str, **values: str) -> pd.DataFrame:
        """The rows of a table that have these values."""
        rows = self.tables[table]
        for column, value in values.items():
            rows = rows[rows[column] == value]
        return rows

    def missing(self, *, streams: bool) -> pd.DataFrame:
        places = self.places
        return places[(places.streams == streams) & places.state.isin(["missing", "failed"])]

    def counts(self, *, streams: bool) -> Counter[str]:
        """How many runs are in each state; of streams those that differ: lives share others."""
        places = self.places[self.places.streams == streams]
        return Counter((places.drop_duplicates("key") if streams else places).state)

    @property
    def _counts(self) -> Counter[str]:
        return self.counts(streams=False) + self.counts(streams=True)

    @property
    def planned(self) -> int:
        """How many runs the plan has, lives and fresh agents included."""
        return self._counts.total()

    @property
    def finished(self) -> int:
        return self._counts["finished"]

    @property
    def requested(self) -> int:
        """How many runs have finished or are missing; others are left out."""
        return self.planned - self._counts["left out"]


class TableMaker(NamedTuple):
    """A table of every study with its kind of runs; of those with rows if `optional`."""

    columns: str
    make: Callable[..., Any]
    optional: bool
    both: bool


TABLES: dict[str, TableMaker] = {}
Make = Callable[..., Any]


def table(
    name: str, columns: str, *, optional: bool = False, both: bool = False
) -> Callable[[Make], Make]:
    """Register a function of the analysis, and with `both` of a `RunKind`, that makes a table."""

    def register(make: Make) -> Make:
        TABLES[name] = TableMaker(columns, make, optional, both)
        return make

    return register


def with_tables(analysis: Analysis) -> Analysis:
    """The analysis, with every registered table of the kinds of tasks that its plan has."""
    parts = analysis.parts
    for name, entry in TABLES.items():
        if entry.both:
            rows = {f"{part.prefix}{name}": entry.make(analysis, part) for part in parts}
        else:
            wanted = analysis.streams or not name.startswith("stream_")
            rows = {name: entry.make(analysis)} if wanted else {}
        for key, content in rows.items():
            is_frame = isinstance(content, pd.DataFrame)
            analysis.tables[key] = content if is_frame else frame([*content], entry.columns)
    return analysis


def summary(
    rows: pd.DataFrame,
    by: Sequence[str],
    metrics: Sequence[Metric],
    bootstrap: Bootstrap,
    seed: Callable[..., Sequence[str]],
    *,
    place: Sequence[str] = PLACE,
    statistic: Statistic = statistics.iqm,
    fewest: int = 1,
) -> Iterator[tuple[Any, ...]]:
    """A statistic over runs of each metric, for each place and value of the columns `by`.

    A row has the number of runs that have the metric, the statistic, and its 95 % interval from
    `fewest` runs on. `seed` is called with the place, the metric and the values of `by`.
    """
    for at, of_place in rows.groupby([*place], sort=False):
        groups = of_place.groupby([*by], sort=False, dropna=False) if by else [((), of_place)]
        for where, group in groups:
            for metric in metrics:
                values = group[[metric.key]].dropna().to_numpy(dtype=np.float64)
                if not len(values):
                    continue
                ends = math.nan, math.nan
                if len(values) >= fewest:
                    text = seed(*at, metric.key, *where)
                    ends = bootstrap.interval({"": values}, *text, statistic=statistic)
                yield (
                    *at, *where, metric.key, len(values), float(statistic(values)[0]), *ends
                )  # fmt: skip


def change_verdict(worsening: float, low: float, high: float, *, enough: bool = True) -> str:
    """The one rule: open unless the interval excludes 0; an indication without enough pairs."""
    if not (low > 0.0 or high < 0.0):
        return "open"
    if not enough:
        return "indication"
    return "worse" if worsening > 0 else "better"


def by_place(rows: pd.DataFrame) -> dict[tuple[str, str], pd.DataFrame]:
    return dict(iter(rows.groupby(PLACE, sort=False)))


def training_data(runs: pd.DataFrame) -> dict[str, tuple[float, int] | None]:
    """Each algorithm's data as (ν, transitions); None where it learns online or not at all."""
    return {
        row.algorithm: None if math.isnan(row.nu) else (row.nu, int(row.transitions))
        for row in runs.drop_duplicates("algorithm").itertuples()
    }


def counted(places: pd.DataFrame, **properties: pd.Series) -> pd.DataFrame:
    """How many planned cells have each property, by class and algorithm."""
    counts = places[PLACE].assign(**properties).groupby(PLACE, sort=False).sum()
    return counts.astype("int64").reset_index()


_AT = "region:str visit:int64 phase:int64 metric:str"
_POINTS = 201  # of a curve of regret
_EPISODES = 1000  # in which the reference agents act, over all draws of a stream

Costs = Mapping[tuple[str, str], Sequence[DynamicRegret]]
"""(class, reference) → the expected dynamic regret of a reference agent in each draw."""


@table("stream_counts", "")
def _counts(analysis: Analysis) -> pd.DataFrame:
    places = analysis.places[analysis.places.streams]
    fresh, finished = places.phase.notna(), places.state == "finished"
    return counted(
        places,
        lives=finished & ~fresh,
        fresh_agents=finished & fresh,
        planned_lives=~fresh,
        planned_fresh_agents=fresh,
        failed=places.state == "failed",
    )


@table("stream_metrics", f"{PLACE_COLUMNS} region:str metric:str {INTERVAL}")
def _metrics(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    return _summary(analysis, analysis.tables["stream_lives"], ["region"], metrics_of("life"))


@table("stream_visit_metrics", f"{PLACE_COLUMNS} {_AT} {INTERVAL}")
def _visit_metrics(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    visits = analysis.tables["stream_visits"]
    return _summary(analysis, visits, ["region", "visit", "phase"], metrics_of("visit"))


@table("stream_matrices", "")
def _matrices(analysis: Analysis) -> pd.DataFrame:
    rows = analysis.tables["stream_retention"]
    of_phases = metrics_of("visit", rows.columns)
    summaries = _summary(analysis, rows, ["region", "visit", "phase"], of_phases)
    columns = f"{PLACE_COLUMNS} {_AT} {INTERVAL}".replace("visit:int64", "visit:Int64")
    return frame([*summaries], columns).drop(columns="metric")


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


@table("stream_regret", "")
def regret(analysis: Analysis) -> pd.DataFrame:
    """The dynamic regret until points of the life, next to that of fresh agents."""
    columns = f"{PLACE_COLUMNS} lifetime median q25 q75 fresh frozen runs:int64"
    tables = [frame([], columns)]
    groups: dict[tuple[str, str], list[StreamReport]] = defaultdict(list)
    for life in analysis.lives:
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
