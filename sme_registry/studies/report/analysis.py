"""`Analysis`: a study's finished runs and its tables, and what tables are made of.

A table is a function of the analysis, registered under its name with `table`. The run is the unit:
its regions and evaluations are no further evidence, and missing runs are part of no number but
counts. Of streams the life is the unit; each may be in another draw of its stream.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sme_registry import statistics
from sme_registry.evaluation.dynamic_regret import DynamicRegret
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.statistics import Array, Statistic
from sme_registry.studies.engine.result import CellResult
from sme_registry.studies.report.classes import ALL, ClassInfo, Group, StreamInfo
from sme_registry.studies.report.frames import FinishedLife, frame

# With fewer runs an interval is an indication only. Of normal, exponential and two-humped runs, a
# 95 % interval of one class covers the truth in 32–62 % of cases with 2 runs, in 48–86 % with 3, in
# 94–98 % with 4 to 10.
ENOUGH_RUNS = 5
PLACE = ["class_name", "algorithm"]
PLACE_COLUMNS = "class_name:str algorithm:str "
INTERVAL = "runs:int64 iqm low high"
CONTRASTS = (
    f"{PLACE_COLUMNS} metric:str axis:str base level change low high pairs:int64 enough_pairs:bool "
    "verdict:str"
)
DIFFERENCES = (
    "first:str second:str metric:str class_name:str first_level second_level difference low high "
    "pairs:int64 instances:int64 enough_pairs:bool verdict:str"
)
LEARNING_CURVES = f"{PLACE_COLUMNS} measure:str step:int64 median q25 q75 runs:int64 window:int64"
CURVES = {"episode_return": "return, % of optimum", "regret": "mean regret per step"}


@dataclass(frozen=True)
class Metric:
    """A column of runs or lives, and whether more of it is worse (+1) or less (−1)."""

    key: str
    label: str
    worse: int
    digits: int = 2  # of its values in tables


METRICS = (
    Metric("wd_regret", "WD regret", 1),
    Metric("ood_regret", "OOD regret", 1),
    Metric("ood_decay", "OOD decay", 1),
    Metric("final_return", "final return, % of optimum", -1, 1),
    Metric("online_regret", "online regret", 1),
)
# Of tasks with safety, or with distractors: columns that runs have where the plan has such tasks.
EXTENSION_METRICS = (
    Metric("wd_cost", "WD cost", 1, 3),
    Metric("wd_safe_regret", "WD safe regret", 1),
    Metric("online_cost", "online cost", 1, 3),
    Metric("distractor_regret", "regret with distractors outside their cube", 1),
    Metric("wd_invariance", "WD invariance", 1),
)
REGRET_METRICS = METRICS[:2]
AGENT_METRICS = (*REGRET_METRICS, METRICS[4])


def metrics_of(runs: pd.DataFrame) -> tuple[Metric, ...]:
    """The metrics that a study's runs have."""
    return (*METRICS, *(metric for metric in EXTENSION_METRICS if metric.key in runs.columns))


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
        low, high = statistics.stratified_bootstrap(
            classes, self.draws, self.seed(*place), statistic
        )
        return float(low[0]), float(high[0])


@dataclass(frozen=True, eq=False)
class Analysis:
    """A study's finished runs, lives and tables.

    Attributes:
      cells: finished cells of the plan, by digest.
      classes: every class of the plan, by name; the first one first. `streams` likewise.
      algorithms: those with a finished run on a single task, in the plan's order.
      learners: those of the algorithms that learn.
      groups: classes that are compared with each other.
      lives: the finished ones in streams; `stream_algorithms` have any.
      reference_costs: (class of streams, reference) → its expected regret in each draw.
      tables: every table by name; `tables` and `lives` document the columns.
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
    def stream_base(self) -> str:
        return next(iter(self.streams), "")

    @property
    def stream_algorithms(self) -> tuple[str, ...]:
        present = {life.planned.algorithm for life in self.lives}
        return tuple(each.name for each in self.plan.algorithms if each.name in present)

    @functools.cached_property
    def stream_cells(self) -> set[str]:
        """Digests of the different cells in streams: lives, and fresh agents that lives share."""
        return {planned.cell.digest for planned in self.plan.cells if planned.in_stream}

    @property
    def seconds(self) -> float:
        """CPU time of all finished runs."""
        of_streams = sum(self.cells[key].timing.total for key in sorted(self._finished_in_streams))
        return float(self.runs.seconds.sum()) + of_streams

    @property
    def _finished_in_streams(self) -> set[str]:
        return self.stream_cells & self.cells.keys()

    @property
    def finished(self) -> int:
        """How many runs have finished, lives and fresh agents included."""
        return len(self.runs) + len(self._finished_in_streams)

    @property
    def missing_in_streams(self) -> int:
        missing = self.tables.get("stream_missing")
        return 0 if missing is None else missing.key.nunique()

    @property
    def requested(self) -> int:
        """How many runs have finished or are missing; `--only` may have left out others."""
        return self.finished + len(self.tables["missing"]) + self.missing_in_streams

    @property
    def planned(self) -> int:
        """Runs of the plan: on single tasks all, in streams those that differ."""
        return len(self.stream_cells) + sum(not cell.in_stream for cell in self.plan.cells)

    @property
    def state_dims(self) -> list[int]:
        """The different state dimensions of the runs, in rising order."""
        return sorted(set(self.tables["results"].state_dim))

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """The metrics of runs on single tasks."""
        return metrics_of(self.runs)


class Table(NamedTuple):
    """A table of every study with single tasks or streams; of those with rows if `optional`."""

    columns: str
    make: Callable[[Analysis], Any]
    streams: bool
    optional: bool


TABLES: dict[str, Table] = {}


def table(
    name: str, columns: str, *, optional: bool = False
) -> Callable[[Callable[[Analysis], Any]], Callable[[Analysis], Any]]:
    """Register a function that makes the rows of a table; those of streams begin with `stream_`.

    `columns` are as those of `frame`. A function may use the tables that are registered before it.
    """

    def register(make: Callable[[Analysis], Any]) -> Callable[[Analysis], Any]:
        TABLES[name] = Table(columns, make, name.startswith("stream_"), optional)
        return make

    return register


def with_tables(analysis: Analysis) -> Analysis:
    """The analysis, with every registered table of the kinds of tasks that its plan has."""
    for name, each in TABLES.items():
        if analysis.streams or not each.streams:
            rows = each.make(analysis)
            made = isinstance(rows, pd.DataFrame)
            analysis.tables[name] = rows if made else frame([*rows], each.columns)
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

    A row is the place, the values of `by`, the metric, the number of runs that have it, the
    statistic, and its 95 % interval from `fewest` runs on. `seed` is called with the place, the
    metric and the values of `by`; metrics of one seed and the same runs are resampled together.
    """
    keys = [metric.key for metric in metrics]
    for at, group in rows.groupby(list(place), sort=False):
        wide = group.set_index(["algorithm", "run", *by])[keys]
        wide = (
            wide.unstack([*by]) if by else wide.set_axis(pd.MultiIndex.from_product([keys]), axis=1)
        )
        blocks: dict[tuple[str, bytes], list[Any]] = defaultdict(list)
        for column in wide.columns:
            known = wide[column].notna().to_numpy()
            if known.any():
                blocks[bootstrap.seed(*seed(*at, *column)), known.tobytes()].append(column)
        estimates = {}
        for (text, _), columns in blocks.items():
            values = wide[columns].dropna().to_numpy(dtype=np.float64)
            ends = np.full((2, len(columns)), np.nan)
            if len(values) >= fewest:
                of_all = {"": values}
                ends[:] = statistics.stratified_bootstrap(of_all, bootstrap.draws, text, statistic)
            for column, *numbers in zip(columns, statistic(values), *ends, strict=True):
                estimates[column] = (len(values), *map(float, numbers))
        places = dict.fromkeys(group[[*by]].itertuples(index=False, name=None)) or [()]
        for column in ((key, *where) for where in places for key in keys):
            if column in estimates:
                yield (*at, *column[1:], column[0], *estimates[column])


def contrasts(
    runs: pd.DataFrame, axes: Mapping[str, str], bootstrap: Bootstrap, metrics: Sequence[Metric]
) -> Iterator[tuple[Any, ...]]:
    """What each class changes compared with the first one, between runs of equal number.

    `axes` has the axis of every class, by name.
    """
    first, keys = next(iter(axes), ""), [metric.key for metric in metrics]
    base = runs.loc[runs.class_name == first, ["algorithm", "run", *keys]]
    pairs = runs[runs.class_name != first].merge(base, on=["algorithm", "run"], suffixes=("", "_0"))
    for place, group in by_place(pairs).items():
        for metric in metrics:
            both = group[[metric.key, f"{metric.key}_0"]].dropna().to_numpy()
            if len(both):
                change = both[:, :1] - both[:, 1:]
                ends = bootstrap.interval({"": change}, "contrast", *reversed(place), metric.key)
                level, before = statistics.iqm(both)
                middle = float(statistics.iqm(change)[0])
                yield (
                    *place, metric.key, axes[place[0]], before, level, middle, *ends, len(both),
                    len(both) >= ENOUGH_RUNS, change_verdict(middle * metric.worse, *ends),
                )  # fmt: skip


def differences(
    runs: pd.DataFrame,
    pairs: Iterable[tuple[str, str]],
    metrics: Sequence[Metric],
    draws: int = statistics.DRAWS,
    instance: str = "spec_digest",
) -> Iterator[tuple[Any, ...]]:
    """How the first algorithm of each pair differs from the second, on each class and on all.

    Two runs of equal number on a class have the same instance and seed, and form a pair. The
    intervals depend only on the runs and the names, and those of B − A mirror those of A − B.
    `instance` is the column that says on which instance a run is.
    """
    on = ["class_name", instance, "seed"]
    for (first, second), metric in itertools.product(pairs, metrics):
        left, right = (
            runs.loc[runs.algorithm == name, [*on, metric.key]] for name in (first, second)
        )
        merged = left.merge(right, on=on, suffixes=("_1", "_2")).dropna()
        groups = dict(iter(merged.groupby("class_name", sort=False)))
        bootstrap = Bootstrap(" ".join(("difference", *sorted((first, second)))), draws)
        parts: list[tuple[str, dict[Any, pd.DataFrame], tuple[str, ...]]] = [
            (str(name), {"": group}, (str(name),)) for name, group in groups.items()
        ]
        if len(groups) > 1:
            parts.append((ALL, groups, ()))
        for name, part, place in parts:
            columns = [f"{metric.key}_1", f"{metric.key}_2"]
            both = {key: group[columns].to_numpy() for key, group in part.items()}
            change = {key: x[:, :1] - x[:, 1:] for key, x in both.items()}
            ends = bootstrap.interval(change, *place, metric.key)
            middle = float(statistics.aggregate(change)[0])
            enough = min(map(len, both.values())) >= ENOUGH_RUNS
            verdict = change_verdict(middle * metric.worse, *ends)
            yield (
                first, second, metric.key, name, *statistics.aggregate(both), middle, *ends,
                sum(map(len, both.values())),
                sum(group[instance].nunique() for group in part.values()), enough,
                verdict if enough or verdict == "open" else "indication",
            )  # fmt: skip


def change_verdict(worsening: float, low: float, high: float) -> str:
    """`worse` or `better` where the interval of a change excludes 0, else `open`."""
    if not (low > 0.0 or high < 0.0):
        return "open"
    return "worse" if worsening > 0 else "better"


def learning_curves(
    curves: pd.DataFrame, runs: pd.DataFrame, window: Callable[[int], int]
) -> pd.DataFrame:
    """Median and quartiles over runs, then the running median over a window of evaluations.

    `window` is the number of evaluations in it, by their number in the shortest run.
    """
    horizons = runs.groupby("class_name").horizon.first()
    tables = [frame([], LEARNING_CURVES)]
    for (class_name, algorithm), group in curves.groupby(PLACE, sort=False):
        each = [run for _, run in group.groupby("run")]
        P = min(map(len, each))
        steps = np.median([run.step[:P] for run in each], axis=0).astype(int)
        for measure in CURVES:
            values = np.array([run[measure][:P] for run in each])
            if measure == "episode_return":
                values *= 100.0 / horizons[class_name]
            quartiles = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
            q25, median, q75 = (statistics.running_median(line, window(P)) for line in quartiles)
            columns = {
                "class_name": class_name, "algorithm": algorithm, "measure": measure, "step": steps,
                "median": median, "q25": q25, "q75": q75, "runs": len(each), "window": window(P),
            }  # fmt: skip
            tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def missing_runs(analysis: Analysis, *, streams: bool) -> Iterator[tuple[Any, ...]]:
    """Class, algorithm, run, phase, error and key of each requested cell that has not finished."""
    requested, errors = analysis.requested_cells, analysis.errors
    for planned in analysis.plan.cells:
        key = planned.cell.digest
        wanted = requested is None or key in requested or key in errors
        if planned.in_stream == streams and key not in analysis.cells and wanted:
            place = planned.class_name, planned.algorithm, planned.run, planned.phase
            yield (*place, errors.get(key, ""), key)


def by_place(rows: pd.DataFrame) -> dict[tuple[str, str], pd.DataFrame]:
    """The rows of each (class, algorithm), in their order."""
    return dict(iter(rows.groupby(PLACE, sort=False)))
