"""`analyse`: the tables of a study's runs on single tasks; `analysis` has those of streams alone.

An unknown interval end is NaN.

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
                      low, high; pairs; enough_pairs; verdict: worse or better if the interval
                      excludes 0, indication if it does with too few pairs, or open
    differences       first, second, metric: first_level, second_level: IQM over the pairs;
                      difference: IQM over pairs of  x_i(first) − x_i(second),  and for `ALL`
                      classes its mean over classes; low, high; pairs; instances: different ones
                      among the pairs; enough_pairs (in each class); verdict of the first algorithm,
                      as in contrasts
    aggregates        group, metric, statistic: classes, runs, fewest_runs (of a class); value: mean
                      over classes; low, high
    profiles          group, metric, threshold: fewest_runs; share: of runs whose value is above the
                      threshold; low, high
    improvements      group, metric, first, second: classes, fewest_runs; probability; low, high
    learning_curves   measure, step: median, q25, q75 over runs, smoothed; runs; window: evaluations
                      averaged
    offline           nu, learner (the same for every ν): runs; similarity and similarity_sd, means
                      over runs of `offline_similarity` and `offline_similarity_sd`; improvement,
                      the mean of r̃ minus that of the policy that made the data (0 for imitation),
                      low, high from `OFFLINE_INTERVAL` runs; verdict: above, above_few, below,
                      below_few, open; behaviour_similarity and behaviour_similarity_sd, means over
                      the data_sets; constant_similarity: of the constant ½ in WD, over runs
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sme_registry import statistics
from sme_registry.spec import StreamClass, StudyAlgorithm, StudyFile, StudyPlan, SuiteClass
from sme_registry.statistics import Array, Statistic
from sme_registry.studies.ledger import label
from sme_registry.studies.report.analysis import (
    CURVES,
    ENOUGH_RUNS,
    INTERVAL,
    OFFLINE_INTERVAL,
    PLACE,
    PLACE_COLUMNS,
    Analysis,
    Bootstrap,
    RunKind,
    by_place,
    change_verdict,
    counted,
    summary,
    table,
    training_data,
    with_tables,
)
from sme_registry.studies.report.design import (
    ALL,
    Metric,
    class_infos,
    groups,
    learner_names,
    metrics_of,
    stream_infos,
)
from sme_registry.studies.report.frames import (
    RUN,
    RUN_COLUMNS,
    finished_lives,
    finished_runs,
    frame,
    place,
    runs_of,
    share_of_optimum,
    stream_frames,
    study_frames,
    window,
)
from sme_registry.studies.result import CellResult
from sme_registry.training.algorithms import parse_uses

THRESHOLDS = np.linspace(0.0, 1.0, 101)
STATISTICS: dict[str, Statistic] = {
    "iqm": statistics.iqm,
    "median": statistics.median,
    "optimality_gap": statistics.optimality_gap,
}
DIFFERENCES = (
    "first:str second:str metric:str class_name:str first_level second_level difference low high "
    "pairs:int64 instances:int64 enough_pairs:bool verdict:str"
)
_GROUP = "group:str metric:str "


def analyse(
    file: StudyFile,
    finished: Mapping[str, CellResult],
    errors: Mapping[str, str] | None = None,
    *,
    models: Mapping[str, Path] | None = None,
    coloured: Sequence[StudyAlgorithm] = (),
    draws: int = statistics.DRAWS,
) -> Analysis:
    """Every table of a study; equal for equal results.

    Results, errors and models are by the digests of their cells. Colours go to the algorithms that
    are `coloured`, by default the plan's, in order.
    """
    plan = file.plan
    results, curves = study_frames(plan, finished)
    runs = runs_of(results)
    lives = tuple(finished_lives(plan, finished)) if plan.streams else ()
    life_frames = stream_frames(lives)._asdict() if plan.streams else {}
    classes = class_infos(plan)
    present = [a for a in plan.algorithms if a.name in set(runs.algorithm)]
    names = tuple(algorithm.name for algorithm in present)
    places = _places(plan, finished, errors or {})
    analysis = Analysis(
        file=file,
        cells={key: finished[key] for key in places.key if key in finished},
        places=places,
        models=models or {},
        bootstrap=Bootstrap(file.digest, draws),
        classes=classes,
        streams=stream_infos(plan),
        algorithms=names,
        learners=_learners(present),
        coloured=_learners(coloured or plan.algorithms),
        groups=groups(classes, names, set(by_place(runs))),
        runs=runs,
        lives=lives,
        tables={"results": results, "curves": curves}
        | {f"stream_{name}": rows for name, rows in life_frames.items()},
    )
    return with_tables(analysis)


def _places(plan: StudyPlan, finished: Collection[str], errors: Mapping[str, str]) -> pd.DataFrame:
    """Every planned cell, in the order of the plan."""
    rows = [(*place(c).values(), c.phase, c.in_stream, label(c), c.cell.digest) for c in plan.cells]
    places = frame(rows, RUN_COLUMNS + "phase:Int64 streams:bool label:str key:str")
    done, failed = (places.key.isin([*keys]) for keys in (finished, errors))
    begun = (done | failed).groupby([places.class_name, places.algorithm]).transform("any")
    states = np.select([done, failed, begun], ["finished", "failed", "missing"], "left out")
    return places.assign(state=states, error=[errors.get(key, "") for key in places.key])


def _learners(algorithms: Sequence[StudyAlgorithm]) -> tuple[str, ...]:
    return tuple(a.name for a in algorithms if parse_uses(a.uses)[0] != "reference")


@table("missing", "", both=True)
def _missing(analysis: Analysis, part: RunKind) -> pd.DataFrame:
    columns = [*RUN, "phase", "error", "key"] if part.streams else [*RUN, "error"]
    return analysis.missing(streams=part.streams)[columns].reset_index(drop=True)


@table(
    "contrasts",
    f"{PLACE_COLUMNS} metric:str axis:str base level change low high pairs:int64 enough_pairs:bool "
    "verdict:str",
    both=True,
)
def _contrasts(analysis: Analysis, part: RunKind) -> Iterator[tuple[Any, ...]]:
    first, keys = next(iter(part.classes), ""), [metric.key for metric in part.metrics]
    runs = part.runs
    base = runs.loc[runs.class_name == first, ["algorithm", "run", *keys]]
    pairs = runs[runs.class_name != first].merge(base, on=["algorithm", "run"], suffixes=("", "_0"))
    for (name, algorithm), group in by_place(pairs).items():
        for metric in part.metrics:
            both = group[[metric.key, f"{metric.key}_0"]].dropna().to_numpy()
            if len(both):
                seed = "contrast", algorithm, name, metric.key
                level, before, *others = paired({"": both}, metric, analysis.bootstrap, *seed)
                yield (name, algorithm, metric.key, part.classes[name].axis, before, level, *others)


def paired(
    classes: Mapping[Any, Array], metric: Metric, bootstrap: Bootstrap, *seed: str
) -> tuple[Any, ...]:
    """Pairs of runs `[n, 2]` by class: both levels, and the change from the second to the first.

    Its interval, the number of pairs, whether they are enough in each class, and the verdict.
    """
    change = {name: both[:, :1] - both[:, 1:] for name, both in classes.items()}
    middle = float(statistics.aggregate(change)[0])
    ends = bootstrap.interval(change, *seed)
    sizes = [len(both) for both in classes.values()]
    enough = min(sizes) >= ENOUGH_RUNS
    verdict = change_verdict(middle * metric.worse, *ends, enough=enough)
    return (*statistics.aggregate(classes), middle, *ends, sum(sizes), enough, verdict)


@table("differences", DIFFERENCES, both=True)
def _differences(analysis: Analysis, part: RunKind) -> Iterator[tuple[Any, ...]]:
    pairs, draws = itertools.combinations(part.algorithms, 2), analysis.bootstrap.draws
    return differences(part.runs, pairs, part.metrics, draws, part.instance)


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
        for name, part, seed in parts:
            columns = [f"{metric.key}_1", f"{metric.key}_2"]
            both = {key: group[columns].to_numpy() for key, group in part.items()}
            *numbers, enough, verdict = paired(both, metric, bootstrap, *seed, metric.key)
            instances = sum(group[instance].nunique() for group in part.values())
            yield (first, second, metric.key, name, *numbers, instances, enough, verdict)


@table("learning_curves", "", both=True)
def _learning_curves(analysis: Analysis, part: RunKind) -> pd.DataFrame:
    """Median and quartiles over runs, then the running median over a window of evaluations."""
    columns = f"{PLACE_COLUMNS} measure:str step:int64 median q25 q75 runs:int64 window:int64"
    tables = [frame([], columns)]
    classes: Iterable[SuiteClass | StreamClass] = (
        analysis.file.plan.streams if part.streams else analysis.file.plan.classes
    )
    documents = {member.name: member.instances[0] for member in classes}
    for (name, algorithm), group in by_place(analysis.tables[f"{part.prefix}curves"]).items():
        runs = [run for _, run in group.groupby("run")]
        P = min(map(len, runs))
        width = 1 if part.streams else window(P)
        for measure in CURVES:
            values, regret, length = (
                np.array([run[column][:P] for run in runs])
                for column in (measure, "regret", "length")
            )
            if measure == "episode_return":
                values = share_of_optimum(documents[name], values, regret, length)
            quartiles = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
            q25, median, q75 = (statistics.running_median(line, width) for line in quartiles)
            steps = np.median([run.step[:P] for run in runs], axis=0).astype(int)
            curve = {
                "class_name": name, "algorithm": algorithm, "measure": measure, "step": steps,
                "median": median, "q25": q25, "q75": q75, "runs": len(runs), "window": width,
            }  # fmt: skip
            tables.append(pd.DataFrame(curve))
    return pd.concat(tables, ignore_index=True)


@table("counts", "")
def _counts(analysis: Analysis) -> pd.DataFrame:
    places = analysis.places
    places = places[~places.streams & (places.state != "left out")]
    done, failed = places.state == "finished", places.state == "failed"
    return counted(places, done=done, failed=failed, planned=places.key.notna())


@table("regions", "")
def _regions(analysis: Analysis) -> pd.DataFrame:
    by = analysis.tables["results"].groupby([*PLACE, "region"], sort=False)
    return by.agg(
        epsilon_high=("epsilon_high", "first"),
        runs=("run", "size"),
        similarity=("similarity", _iqm),
        similarity_q25=("similarity", lambda values: np.quantile(values, 0.25)),
        similarity_q75=("similarity", lambda values: np.quantile(values, 0.75)),
        normalised_regret=("normalised_regret", _iqm),
        linear_normalised_regret=("linear_normalised_regret", "median"),
    ).reset_index()


@table("levels", f"{PLACE_COLUMNS} metric:str {INTERVAL} linear")
def _levels(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    results = analysis.tables["results"]
    linear = {place: _linear_medians(rows) for place, rows in by_place(results).items()}
    rows = summary(
        analysis.runs, [], metrics_of("run", analysis.runs), analysis.bootstrap,
        lambda name, algorithm, key: ("level", algorithm, name, key),
    )  # fmt: skip
    for row in rows:
        yield (*row, linear[row[:2]].get(row[2], math.nan))


@table("layers", f"{PLACE_COLUMNS} layer:int64 runs:int64 state_r2 distractor_r2", optional=True)
def _layers(analysis: Analysis) -> pd.DataFrame:
    rows = [
        place(planned) | probe.model_dump()
        for planned, result in finished_runs(analysis.plan, analysis.cells)
        if result.report is not None and result.report.observation is not None
        for probe in result.report.observation.probes
    ]
    columns = f"{PLACE_COLUMNS} run:int64 layer:int64 units:int64 state_r2 distractor_r2"
    return layers(frame(rows, columns))


def layers(probed: pd.DataFrame) -> pd.DataFrame:
    """What a linear map recovers from each layer, over runs."""
    kept = probed.groupby([*PLACE, "layer"], sort=False).agg(
        runs=("run", "size"), state_r2=("state_r2", _iqm), distractor_r2=("distractor_r2", _iqm)
    )
    return kept.reset_index()


@table("agents", f"{PLACE_COLUMNS} agent:str metric:str {INTERVAL}", optional=True)
def _agents(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    runs, metrics = analysis.runs, metrics_of("agent")
    keys = [metric.key for metric in metrics]
    names = [c.partition("/")[2] for c in runs.columns if c.startswith(f"{keys[0]}/")]
    if names:
        columns = [
            runs[RUN].assign(agent=name, **{key: runs[f"{key}/{name}"] for key in keys})
            for name in names
        ]
        yield from summary(
            pd.concat(columns), ["agent"], metrics, analysis.bootstrap,
            lambda name, algorithm, key, agent: ("agent", algorithm, name, f"{key}/{agent}"),
        )  # fmt: skip


@table(
    "aggregates",
    f"{_GROUP} algorithm:str statistic:str classes:int64 runs:int64 fewest_runs:int64 value low "
    "high",
)
def _aggregates(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    for group, metric, values in _compared(analysis):
        for algorithm, (name, statistic) in itertools.product(values, STATISTICS.items()):
            classes = {key: x[:, None] for key, x in values[algorithm].items()}
            sizes = [len(x) for x in classes.values()]
            place = "aggregate", algorithm, metric
            ends = analysis.bootstrap.interval(classes, *place, statistic=statistic)
            value = statistics.aggregate(classes, statistic)[0]
            counts = len(sizes), sum(sizes), min(sizes)
            yield (group, metric, algorithm, name, *counts, value, *ends)


@table("profiles", f"{_GROUP} algorithm:str fewest_runs:int64 threshold share low high")
def _profiles(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    bootstrap = analysis.bootstrap
    for group, metric, values in _compared(analysis):
        for algorithm, classes in values.items():
            fewest = min(map(len, classes.values()))
            seed = bootstrap.seed("profile", algorithm, metric)
            shares = statistics.performance_profile(classes, THRESHOLDS, bootstrap.draws, seed)
            known = 1.0 if fewest > 1 else math.nan  # whether the spread of each class is known
            ends = known * shares.low, known * shares.high
            for at in zip(THRESHOLDS.round(4), shares.value, *ends, strict=True):
                yield (group, metric, algorithm, fewest, *at)


@table(
    "improvements",
    f"{_GROUP} first:str second:str classes:int64 fewest_runs:int64 probability low high",
)
def _improvements(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    """Every pair of algorithms, except those that learnt from different data."""
    data, bootstrap = training_data(analysis.runs), analysis.bootstrap
    for group, metric, values in _compared(analysis):
        for first, second in itertools.combinations(analysis.algorithms, 2):
            if len({data[first], data[second]} - {None}) == 2:
                continue
            x, y = values[first], values[second]
            fewest = min(map(len, (*x.values(), *y.values())))
            seed = bootstrap.seed("improvement", first, second, metric)
            estimate = statistics.probability_of_improvement(x, y, bootstrap.draws, seed)
            ends = (estimate.low[0], estimate.high[0]) if fewest > 1 else (math.nan, math.nan)
            yield (group, metric, first, second, len(x), fewest, estimate.value[0], *ends)


def _linear_medians(results: pd.DataFrame) -> dict[str, float]:
    """The regret and decay of the linear policy: medians over the tasks of an algorithm's runs."""
    regret = results.linear_normalised_regret
    similarity = 1.0 - regret * (1.0 - results.constant_similarity)
    runs = results.assign(linear=regret, r=similarity).groupby("run")[["linear", "r"]]
    rows = []
    for _, run in runs:
        (N, *shells), (r, *outside) = run.linear.tolist(), run.r.tolist()
        ood = [np.mean(shells), 1.0 - np.mean(outside) / r] if shells else [math.nan] * 2
        rows.append((N, *ood))
    names = ("wd_regret", "ood_regret", "ood_decay")
    return dict(zip(names, np.median(rows, axis=0).tolist(), strict=True))


def _compared(analysis: Analysis) -> Iterator[tuple[str, str, dict[str, dict[str, Array]]]]:
    """Each group and regret metric with `[n]` values 1 − regret, by algorithm and class."""
    at = by_place(analysis.runs)
    comparable = [group for group in analysis.groups if group.compared]
    for group, metric in itertools.product(comparable, metrics_of("score")):
        values = {
            a: {c: 1.0 - at[c, a][metric.key].to_numpy() for c in group.compared}
            for a in analysis.algorithms
        }
        yield group.name, metric.key, values


def _iqm(values: Any) -> float:
    return float(statistics.iqm(values))


@table(
    "offline",
    "class_name:str nu learner:str runs:int64 similarity similarity_sd improvement low high "
    "verdict:str behaviour_similarity behaviour_similarity_sd data_sets:int64 constant_similarity",
    optional=True,
)
def _offline(analysis: Analysis) -> Iterator[dict[str, Any]]:
    runs = offline_runs(analysis.tables["results"], analysis.plan.algorithms)
    intervals = summary(
        runs, ["nu"], metrics_of("data"), analysis.bootstrap,
        lambda name, learner, _, nu: ("offline", learner, name, f"{nu:g}"),
        place=["class_name", "learner"], statistic=statistics.mean, fewest=OFFLINE_INTERVAL,
    )  # fmt: skip
    known = {row[:3]: row[4:] for row in intervals}
    for (name, nu), same_data in runs.groupby(["class_name", "nu"], sort=False):
        data_sets = same_data.drop_duplicates("dataset_digest")  # however many runs learnt from one
        data = {
            "behaviour_similarity": data_sets.behaviour_similarity.to_numpy().mean(),
            "behaviour_similarity_sd": data_sets.behaviour_similarity_sd.to_numpy().mean(),
            "data_sets": len(data_sets),
            "constant_similarity": same_data.constant_similarity.to_numpy().mean(),
        }
        for learner, group in same_data.groupby("learner", sort=False):
            count, improvement, low, high = known[name, learner, nu]
            yield {
                "class_name": name, "nu": nu, "learner": learner, "runs": count,
                "similarity": group.offline_similarity.to_numpy().mean(),
                "similarity_sd": group.offline_similarity_sd.to_numpy().mean(),
                "improvement": improvement, "low": low, "high": high,
                "verdict": offline_verdict(group.improvement.to_numpy(), low, high), **data,
            }  # fmt: skip


def offline_runs(results: pd.DataFrame, algorithms: Sequence[StudyAlgorithm]) -> pd.DataFrame:
    """One row per run of an offline learner, ordered by class, ν, learner and run."""
    names = learner_names(algorithms)
    rows = results[results.nu.notna()].drop_duplicates(RUN)
    rows = rows.assign(learner=rows.algorithm.map(names))
    order = {"class_name": list(dict.fromkeys(rows.class_name)),
             "learner": list(dict.fromkeys(names.values()))}  # fmt: skip

    def key(column: pd.Series) -> pd.Series:
        return column.map(order[column.name].index) if column.name in order else column

    return rows.sort_values(["class_name", "nu", "learner", "run"], key=key, ignore_index=True)


def offline_verdict(improvements: Array, low: float, high: float) -> str:
    """Whether a learner surpasses its data, from the improvements of its runs."""
    if len(improvements) >= ENOUGH_RUNS:
        return "above" if low > 0.0 else "below" if high < 0.0 else "open"
    if len(improvements) > 1 and improvements.min() > 0.0:
        return "above_few"
    return "below_few" if len(improvements) > 1 and improvements.max() < 0.0 else "open"
