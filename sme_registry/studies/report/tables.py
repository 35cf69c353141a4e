"""Summary tables of a study: functions from its frames (`frames`) to frames.

The run is the unit: its regions and evaluations are no further evidence. Missing runs are counted
in `counts` and `missing`, and are part of no other number. An unknown interval end is NaN.

    value            1 − normalised regret, for statistics that expect more to be better
    change           IQM over run numbers i of  x_i(class) − x_i(first class)
    low, high        ends of a 95 % bootstrap interval (`statistics`); NaN for a single run

Columns of each table, those that name the row first; class_name and algorithm are not repeated.

    counts            done, failed, planned: number of runs
    missing           run; error: "" if it has not failed
    regions           region: epsilon_high, runs; IQM over runs of similarity (and its quartiles
                      similarity_q25, similarity_q75) and normalised_regret; median of
                      linear_normalised_regret
    levels            metric: runs, iqm, low, high; linear: the linear policy's median on the same
                      tasks, NaN for metrics of training
    layers            layer: runs; IQM over runs of state_r2 and distractor_r2, the held-out
                      R² of a linear map from the layer to the state and to the distractors
    agents            agent, metric: runs, iqm, low, high; of each agent of a team
    contrasts         metric: axis; base, level: IQM on the first class and on this one; change,
                      low, high; pairs; enough_pairs; verdict: worse, better or open
    differences       first, second, metric: first_level, second_level: IQM over the pairs;
                      difference: IQM over pairs of  x_i(first) − x_i(second),  and for `ALL`
                      classes its mean over classes; low, high; pairs; instances: different ones
                      among the pairs; enough_pairs; verdict of the first algorithm: worse or better
                      if the interval excludes 0, indication if it does with too few pairs, or open
    aggregates        group, metric, statistic: classes, runs, fewest_runs (of a class); value: mean
                      over classes; low, high
    profiles          group, metric, threshold: fewest_runs; share: of runs whose value is above the
                      threshold; low, high
    improvements      group, metric, first, second: classes, fewest_runs; probability; low, high
    learning_curves   measure, step: median, q25, q75 over runs, smoothed; runs; window: evaluations
                      averaged
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from sme_registry import statistics
from sme_registry.spec import StudyPlan
from sme_registry.statistics import Array, Statistic
from sme_registry.studies.report.classes import ALL, Group
from sme_registry.studies.report.frames import frame, ordered, runs, window

# With fewer runs an interval is an indication only. Of normal, exponential and two-humped runs, a
# 95 % interval of one class covers the truth in 32–62 % of cases with 2 runs, in 48–86 % with 3, in
# 94–98 % with 4 to 10.
ENOUGH_RUNS = 5
THRESHOLDS = np.linspace(0.0, 1.0, 101)
STATISTICS: dict[str, Statistic] = {
    "iqm": statistics.iqm,
    "median": statistics.median,
    "optimality_gap": statistics.optimality_gap,
}
CURVES = {"episode_return": "return, % of optimum", "regret": "mean regret per step"}
PLACE = ["class_name", "algorithm"]
_PLACE = "class_name:str algorithm:str"


@dataclass(frozen=True)
class Metric:
    """A column of `results`, and whether more of it is worse (+1) or less (−1)."""

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
# Of tasks with safety, or with distractors: columns that `runs` has where the plan has such tasks.
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
        """The seed of the interval at a place."""
        return " ".join((self.digest, *place))

    def interval(
        self, values: Array, *place: str, statistic: Statistic = statistics.iqm
    ) -> tuple[float, float]:
        """The interval of a statistic of `[n]` runs; NaN for a single run."""
        column, seed = {"": np.asarray(values)[:, None]}, self.seed(*place)
        low, high = statistics.stratified_bootstrap(column, self.draws, seed, statistic)
        return float(low[0]), float(high[0])


def missing(
    plan: StudyPlan,
    runs: pd.DataFrame,
    errors: Mapping[str, str],
    requested: Collection[str] | None = None,
) -> pd.DataFrame:
    """The requested runs that have not finished, in the plan's order; None for all runs."""
    done = set(runs.key)
    rows = [
        (cell.class_name, cell.algorithm, cell.run, errors.get(cell.cell.digest, ""))
        for cell in plan.cells
        if not cell.in_stream
        and cell.cell.digest not in done
        and (requested is None or cell.cell.digest in requested or cell.cell.digest in errors)
    ]
    return frame(rows, f"{_PLACE} run:int64 error:str")


def counts(plan: StudyPlan, runs: pd.DataFrame, missing: pd.DataFrame) -> pd.DataFrame:
    """How many runs of each algorithm on each class have finished and failed."""
    places = {*runs[[*PLACE, "run"]].itertuples(index=False, name=None)}
    places |= {*missing[[*PLACE, "run"]].itertuples(index=False, name=None)}
    cells = [(c.class_name, c.algorithm, c.run) for c in ordered(plan)]
    planned = frame([cell[:2] for cell in cells if cell in places], _PLACE)
    table = planned.groupby(PLACE, sort=False).size().rename("planned").to_frame()
    absent = missing.groupby(PLACE).size().reindex(table.index, fill_value=0)
    failed = missing[missing.error != ""].groupby(PLACE).size()
    table.insert(0, "done", table.planned - absent)
    table.insert(1, "failed", failed.reindex(table.index, fill_value=0))
    return table.reset_index()


def regions(results: pd.DataFrame) -> pd.DataFrame:
    """Each algorithm on each class in each region, over its runs."""
    return (
        results.groupby([*PLACE, "region"], sort=False)
        .agg(
            epsilon_high=("epsilon_high", "first"),
            runs=("run", "size"),
            similarity=("similarity", _iqm),
            similarity_q25=("similarity", lambda values: np.quantile(values, 0.25)),
            similarity_q75=("similarity", lambda values: np.quantile(values, 0.75)),
            normalised_regret=("normalised_regret", _iqm),
            linear_normalised_regret=("linear_normalised_regret", "median"),
        )
        .reset_index()
    )


def levels(results: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """The IQM of every metric."""
    linear = {place: _linear_medians(rows) for place, rows in by_place(results).items()}
    rows = []
    finished = runs(results)
    for place, group in by_place(finished).items():
        for metric in metrics_of(finished):
            values = group[metric.key].dropna().to_numpy()
            if len(values):
                ends = bootstrap.interval(values, "level", *reversed(place), metric.key)
                reference = linear[place].get(metric.key, math.nan)
                rows.append((*place, metric.key, len(values), _iqm(values), *ends, reference))
    return frame(rows, f"{_PLACE} metric:str runs:int64 iqm low high linear")


def layers(probes: pd.DataFrame) -> pd.DataFrame:
    """What a linear map recovers from each layer, over runs; of what `frames.probes` has."""
    by = probes.groupby([*PLACE, "layer"], sort=False)
    kept = by.agg(
        runs=("run", "size"),
        state_r2=("state_r2", _iqm),
        distractor_r2=("distractor_r2", _iqm),
    )
    return kept.reset_index()


def agents(runs: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """The IQM of regret of each agent of a team; empty without teams."""
    rows = []
    for place, group in by_place(runs).items():
        for metric in AGENT_METRICS:
            for column in [c for c in runs.columns if c.startswith(f"{metric.key}/")]:
                values = group[column].dropna().to_numpy()
                if len(values):
                    ends = bootstrap.interval(values, "agent", *reversed(place), column)
                    agent = column.partition("/")[2]
                    rows.append((*place, agent, metric.key, len(values), _iqm(values), *ends))
    return frame(rows, f"{_PLACE} agent:str metric:str runs:int64 iqm low high")


def contrasts(
    runs: pd.DataFrame,
    axes: Mapping[str, str],
    bootstrap: Bootstrap,
    metrics: Sequence[Metric] | None = None,
) -> pd.DataFrame:
    """What each class changes compared with the plan's first one, between runs of equal number."""
    metrics = metrics_of(runs) if metrics is None else metrics
    first = next(iter(axes), "")
    keys = [metric.key for metric in metrics]
    base = runs.loc[runs.class_name == first, ["algorithm", "run", *keys]]
    pairs = runs[runs.class_name != first].merge(base, on=["algorithm", "run"], suffixes=("", "_0"))
    rows = []
    for place, group in by_place(pairs).items():
        for metric in metrics:
            both = group[[metric.key, f"{metric.key}_0"]].dropna().to_numpy()
            if not len(both):
                continue
            change = both[:, 0] - both[:, 1]
            low, high = bootstrap.interval(change, "contrast", *reversed(place), metric.key)
            level, before = statistics.iqm(both)
            middle = _iqm(change)
            verdict = contrast_verdict(middle * metric.worse, low, high)
            rows.append(
                (*place, metric.key, axes[place[0]], before, level, middle, low, high,
                 len(both), len(both) >= ENOUGH_RUNS, verdict)
            )  # fmt: skip
    columns = "axis:str base level change low high pairs:int64 enough_pairs:bool verdict:str"
    return frame(rows, f"{_PLACE} metric:str {columns}")


def differences(
    runs: pd.DataFrame,
    pairs: Iterable[tuple[str, str]],
    metrics: Sequence[Metric] | None = None,
    draws: int = statistics.DRAWS,
    instance: str = "spec_digest",
) -> pd.DataFrame:
    """How the first algorithm of each pair differs from the second, on each class and on all."""
    metrics = metrics_of(runs) if metrics is None else metrics
    rows = []
    for (first, second), metric in itertools.product(pairs, metrics):
        paired = _paired(runs, first, second, metric.key, instance)
        classes = {name: both for name, (both, _) in paired.items()}
        bootstrap = Bootstrap(" ".join(("difference", *sorted((first, second)))), draws)
        instances = {name: count for name, (_, count) in paired.items()}
        for name, both in classes.items():
            change = both[:, 0] - both[:, 1]
            ends = bootstrap.interval(change, name, metric.key)
            rows.append(_difference(first, second, metric, name, statistics.iqm(both), _iqm(change),
                                    ends, len(both), instances[name], len(both)))  # fmt: skip
        if len(classes) > 1:
            change_of = {n: (both[:, 0] - both[:, 1])[:, None] for n, both in classes.items()}
            sizes = [len(both) for both in classes.values()]
            low, high = statistics.stratified_bootstrap(
                change_of, draws, bootstrap.seed(metric.key)
            )
            ends = (low[0], high[0]) if min(sizes) > 1 else (math.nan, math.nan)
            rows.append(_difference(first, second, metric, ALL, statistics.aggregate(classes),
                                    float(statistics.aggregate(change_of)[0]), ends,
                                    sum(sizes), sum(instances.values()), min(sizes)))  # fmt: skip
    columns = (
        "first_level second_level difference low high pairs:int64 instances:int64 "
        "enough_pairs:bool verdict:str"
    )
    return frame(rows, f"first:str second:str metric:str class_name:str {columns}")


def _paired(
    runs: pd.DataFrame, first: str, second: str, metric: str, instance: str
) -> dict[str, tuple[Array, int]]:
    """By class, `[n, 2]` values of both algorithms in runs on the same instance with one seed."""
    on = ["class_name", instance, "seed"]
    left, right = (runs.loc[runs.algorithm == name, [*on, metric]] for name in (first, second))
    both = left.merge(right, on=on, suffixes=("_1", "_2")).dropna()
    return {
        str(name): (
            group[[f"{metric}_1", f"{metric}_2"]].to_numpy(),
            int(group[instance].nunique()),
        )
        for name, group in both.groupby("class_name", sort=False)
    }


def _difference(
    first: str,
    second: str,
    metric: Metric,
    class_name: str,
    levels: Array,
    difference: float,
    ends: tuple[float, float],
    pairs: int,
    instances: int,
    fewest: int,
) -> tuple[Any, ...]:
    verdict = contrast_verdict(difference * metric.worse, *ends)
    enough = fewest >= ENOUGH_RUNS
    if verdict != "open" and not enough:
        verdict = "indication"
    place = (first, second, metric.key, class_name)
    return (*place, *levels, difference, *ends, pairs, instances, enough, verdict)


def contrast_verdict(worsening: float, low: float, high: float) -> str:
    """`worse` or `better` where the interval of a change excludes 0, else `open`."""
    if not (low > 0.0 or high < 0.0):
        return "open"
    return "worse" if worsening > 0 else "better"


def aggregates(
    runs: pd.DataFrame, groups: Sequence[Group], algorithms: Sequence[str], bootstrap: Bootstrap
) -> pd.DataFrame:
    """Statistics of 1 − normalised regret over the classes of each group; classes count alike."""
    rows = []
    for group, metric, values in _compared(runs, groups, algorithms):
        for algorithm, (name, statistic) in itertools.product(values, STATISTICS.items()):
            classes = {key: x[:, None] for key, x in values[algorithm].items()}
            sizes = [len(x) for x in classes.values()]
            seed = bootstrap.seed("aggregate", algorithm, metric)
            low, high = statistics.stratified_bootstrap(classes, bootstrap.draws, seed, statistic)
            ends = (low[0], high[0]) if min(sizes) > 1 else (math.nan, math.nan)
            value = statistics.aggregate(classes, statistic)[0]
            counts = len(sizes), sum(sizes), min(sizes)
            rows.append((group, metric, algorithm, name, *counts, value, *ends))
    columns = "statistic:str classes:int64 runs:int64 fewest_runs:int64 value low high"
    return frame(rows, f"group:str metric:str algorithm:str {columns}")


def profiles(
    runs: pd.DataFrame, groups: Sequence[Group], algorithms: Sequence[str], bootstrap: Bootstrap
) -> pd.DataFrame:
    """Shares of runs whose 1 − normalised regret is above each threshold."""
    rows: list[Any] = []
    for group, metric, values in _compared(runs, groups, algorithms):
        for algorithm, classes in values.items():
            fewest = min(map(len, classes.values()))
            seed = bootstrap.seed("profile", algorithm, metric)
            shares = statistics.performance_profile(classes, THRESHOLDS, bootstrap.draws, seed)
            known = 1.0 if fewest > 1 else math.nan  # whether the spread of each class is known
            ends = known * shares.low, known * shares.high
            shares_at = zip(THRESHOLDS.round(4), shares.value, *ends, strict=True)
            rows += [(group, metric, algorithm, fewest, *at) for at in shares_at]
    columns = "fewest_runs:int64 threshold share low high"
    return frame(rows, f"group:str metric:str algorithm:str {columns}")


def improvements(
    runs: pd.DataFrame, groups: Sequence[Group], algorithms: Sequence[str], bootstrap: Bootstrap
) -> pd.DataFrame:
    """Every pair of algorithms, except those that learnt from different data."""
    data = training_data(runs)
    rows = []
    for group, metric, values in _compared(runs, groups, algorithms):
        for first, second in itertools.combinations(algorithms, 2):
            if len({data[first], data[second]} - {None}) == 2:
                continue
            x, y = values[first], values[second]
            fewest = min(map(len, (*x.values(), *y.values())))
            seed = bootstrap.seed("improvement", first, second, metric)
            estimate = statistics.probability_of_improvement(x, y, bootstrap.draws, seed)
            ends = (estimate.low[0], estimate.high[0]) if fewest > 1 else (math.nan, math.nan)
            rows.append((group, metric, first, second, len(x), fewest, estimate.value[0], *ends))
    columns = "first:str second:str classes:int64 fewest_runs:int64 probability low high"
    return frame(rows, f"group:str metric:str {columns}")


def learning_curves(
    curves: pd.DataFrame, runs: pd.DataFrame, window: Callable[[int], int] = window
) -> pd.DataFrame:
    """Median and quartiles over runs, then the running median over a window of evaluations."""
    horizons = runs.groupby("class_name").horizon.first()
    columns = f"{_PLACE} measure:str step:int64 median q25 q75 runs:int64 window:int64"
    tables = [frame([], columns)]
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
            table = {
                "class_name": class_name, "algorithm": algorithm, "measure": measure, "step": steps,
                "median": median, "q25": q25, "q75": q75, "runs": len(each), "window": window(P),
            }  # fmt: skip
            tables.append(pd.DataFrame(table))
    return pd.concat(tables, ignore_index=True)


def training_data(runs: pd.DataFrame) -> dict[str, tuple[float, int] | None]:
    """Each algorithm's data as (ν, transitions); None where it learns online or not at all."""
    return {
        row.algorithm: None if math.isnan(row.nu) else (row.nu, int(row.transitions))
        for row in runs.drop_duplicates("algorithm").itertuples()
    }


def by_place(rows: pd.DataFrame) -> dict[tuple[str, str], pd.DataFrame]:
    """The rows of each (class, algorithm), in their order."""
    return dict(iter(rows.groupby(PLACE, sort=False)))


def _linear_medians(results: pd.DataFrame) -> dict[str, float]:
    """The regret metrics of the linear policy: medians over the tasks of an algorithm's runs."""
    regrets = [run.linear_normalised_regret.to_numpy() for _, run in results.groupby("run")]
    wd = np.array([regret[0] for regret in regrets])
    ood = np.array([regret[1:].mean() if len(regret) > 1 else math.nan for regret in regrets])
    values = {"wd_regret": wd, "ood_regret": ood, "ood_decay": ood - wd}
    return {key: float(np.median(value)) for key, value in values.items()}


def _compared(
    runs: pd.DataFrame, groups: Sequence[Group], algorithms: Sequence[str]
) -> Iterator[tuple[str, str, dict[str, dict[str, Array]]]]:
    """Each group and regret metric with `[n]` values 1 − regret, by algorithm and class."""
    at = by_place(runs)
    comparable = [group for group in groups if group.compared]
    for group, metric in itertools.product(comparable, REGRET_METRICS):
        values = {
            a: {c: 1.0 - at[c, a][metric.key].to_numpy() for c in group.compared}
            for a in algorithms
        }
        yield group.name, metric.key, values


def _iqm(values: Any) -> float:
    return float(statistics.iqm(values))
