"""`Analysis`: a study's finished runs and its tables, and what tables are made of.

The run is the unit, or in streams the life: its regions and evaluations are no further evidence.
Missing runs are part of no number but counts.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sme_registry import statistics
from sme_registry.evaluation.dynamic_regret import DynamicRegret
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.spec.study import PlannedCell
from sme_registry.statistics import Array, Statistic
from sme_registry.studies.engine.result import CellResult
from sme_registry.studies.report.design import (
    WITHIN,
    ClassInfo,
    Group,
    Metric,
    StreamInfo,
    metrics_of,
)
from sme_registry.studies.report.frames import FinishedLife, frame

# With fewer runs an interval is an indication only. Of normal, exponential and two-humped runs, a
# 95 % interval of one class covers the truth in 32–62 % of cases with 2 runs, in 48–86 % with 3, in
# 94–98 % with 4 to 10.
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
    axes: Mapping[str, str]  # of each class; the first is that which others are compared with
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

    `cells`, `errors` and `models` are by the digests of cells, `classes` and `streams` by name, the
    first one first. `algorithms` have a finished run on a single task; `learners` are those of them
    that learn. `reference_costs` are by class of streams and reference, one for each draw.
    """

    file: StudyFile
    cells: Mapping[str, CellResult]
    errors: Mapping[str, str]
    requested_cells: Collection[str] | None
    models: Mapping[str, Path]
    bootstrap: Bootstrap
    classes: Mapping[str, ClassInfo]
    streams: Mapping[str, StreamInfo]
    algorithms: tuple[str, ...]
    learners: tuple[str, ...]
    groups: tuple[Group, ...]
    runs: pd.DataFrame
    offline_runs: pd.DataFrame
    lives: tuple[FinishedLife, ...]
    reference_costs: Mapping[tuple[str, str], Sequence[DynamicRegret]]
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)

    @property
    def plan(self) -> StudyPlan:
        return self.file.plan

    @property
    def base(self) -> str:
        """The name of the first class; "" where the plan has none."""
        return next(iter(self.classes), "")

    @property
    def stream_algorithms(self) -> tuple[str, ...]:
        present = {life.planned.algorithm for life in self.lives}
        return tuple(a.name for a in self.plan.algorithms if a.name in present)

    @property
    def parts(self) -> tuple[RunKind, ...]:
        axes = {name: info.axis for name, info in self.classes.items()}
        metrics = metrics_of("run", self.runs)
        tasks = RunKind(False, self.runs, axes, self.algorithms, metrics, "spec_digest")
        if not self.streams:
            return (tasks,)
        lives = self.tables["stream_lives"]
        lives = lives[lives.region == WITHIN].reset_index(drop=True)
        axes = {name: info.axis for name, info in self.streams.items()}
        metrics = metrics_of("life")
        return tasks, RunKind(True, lives, axes, self.stream_algorithms, metrics, "stream_digest")

    def state(self, key: str) -> str:
        """Of a cell by its digest: `finished`, `failed`, `missing`, or `left out` by `--only`."""
        if key in self.cells:
            return "finished"
        if key in self.errors:
            return "failed"
        requested = self.requested_cells is None or key in self.requested_cells
        return "missing" if requested else "left out"

    def missing(self, *, streams: bool) -> list[PlannedCell]:
        """The requested cells that have not finished."""
        cells = [cell for cell in self.plan.cells if cell.in_stream == streams]
        return [c for c in cells if self.state(c.cell.digest) in ("missing", "failed")]

    def counts(self, *, streams: bool) -> Counter[str]:
        """How many runs are in each state; of streams those that differ: lives share others."""
        keys = [cell.cell.digest for cell in self.plan.cells if cell.in_stream == streams]
        return Counter(self.state(key) for key in (dict.fromkeys(keys) if streams else keys))

    @property
    def planned(self) -> int:
        """How many runs the plan has, lives and fresh agents included."""
        return (self.counts(streams=False) + self.counts(streams=True)).total()

    @property
    def finished(self) -> int:
        return sum(self.counts(streams=streams)["finished"] for streams in (False, True))

    @property
    def requested(self) -> int:
        """How many runs have finished or are missing; `--only` may have left out others."""
        return self.planned - sum(self.counts(streams=s)["left out"] for s in (False, True))

    @property
    def seconds(self) -> float:
        """CPU time of all finished runs."""
        return sum(result.timing.total for result in self.cells.values())


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
        for where, group in of_place.groupby([*by], sort=False) if by else [((), of_place)]:
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


def change_verdict(worsening: float, low: float, high: float) -> str:
    """`worse` or `better` where the interval of a change excludes 0, else `open`."""
    if not (low > 0.0 or high < 0.0):
        return "open"
    return "worse" if worsening > 0 else "better"


def by_place(rows: pd.DataFrame) -> dict[tuple[str, str], pd.DataFrame]:
    return dict(iter(rows.groupby(PLACE, sort=False)))


def training_data(runs: pd.DataFrame) -> dict[str, tuple[float, int] | None]:
    """Each algorithm's data as (ν, transitions); None where it learns online or not at all."""
    return {
        row.algorithm: None if math.isnan(row.nu) else (row.nu, int(row.transitions))
        for row in runs.drop_duplicates("algorithm").itertuples()
    }
