"""`analyse`: what a study's finished runs say, as tables; nothing is drawn or written here.

The unit is the run. What is missing is counted and named, and stays out of every number.

    normalised regret     mean |a − a*| / mean |½ − a*|: 0 the optimum's, 1 the constant ½'s
    score                 1 − normalised regret, for what must rise with skill
    contrast              IQM over run numbers i of  x_i(class) − x_i(first class)
    window                min(10, max(1, evaluations // 10)) evaluations, the latest last

A curve is the median over runs, then the mean over the window, and so are the quartiles beside it.
A final return is the mean over the last window, in hundredths of the optimum's T.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sme_registry import statistics
from sme_registry.evaluation import RegionReport
from sme_registry.spec import StudyAlgorithm, StudyFile, SuiteClass
from sme_registry.statistics import Array, Statistic
from sme_registry.studies.engine.result import CellResult, OfflineResult
from sme_registry.studies.report.tables import (
    OFFLINE_INTERVAL,
    Aggregate,
    Analysis,
    ClassInfo,
    Contrast,
    Count,
    Curve,
    DecayRow,
    Group,
    Improvement,
    Level,
    Metric,
    Missing,
    OfflineData,
    OfflineScore,
    Profile,
    RegionRow,
    Run,
)

ALL = "all classes"
SEVERAL = "several axes"
THRESHOLDS = np.linspace(0.0, 1.0, 101)
CURVES = {
    "episode_return": "return, % of optimum",
    "regret": "mean regret per step",
}
STATISTICS: dict[str, Statistic] = {
    "iqm": statistics.iqm,
    "median": statistics.median,
    "optimality_gap": statistics.optimality_gap,
}
AXES = {
    "state_dim": ("S", "state dimension S"),
    "action_dim": ("A", "action dimension A"),
    "k": ("k", "reward interval k"),
    "r_min": ("r_min", "minimum reward r_min"),
    "D": ("D", "survival threshold D"),
    "complexity": ("L", "complexity L"),
    "horizon": ("T", "horizon T"),
    "hidden_width": ("H", "hidden width H"),
    "policy_init": ("policy_init", "policy_init"),
}
_SMOOTHED = 10
_LINEAR, _CONSTANT = "linear_least_squares", "constant_half"


def _regret_wd(regions: Sequence[RegionReport]) -> float:
    return regions[0].normalised_regret


def _regret_ood(regions: Sequence[RegionReport]) -> float:
    return float(np.mean([region.normalised_regret for region in regions[1:]]))


def learnt_from(results: Iterable[Run]) -> dict[str, tuple[float, int] | None]:
    """Each algorithm's data: ν and how many transitions; None where it learns from no data set."""
    return {
        run.planned.algorithm: None if data is None else (data.nu, data.transitions)
        for run in results
        for data in [run.result.offline]
    }


def window(evaluations: int) -> int:
    """How many evaluations are averaged: the paper's 10 of its 400, fewer where there are few."""
    return min(_SMOOTHED, max(1, evaluations // 10))


def _final_return(result: CellResult) -> float | None:
    returns = result.curve.episode_return
    if not returns:
        return None
    last = returns[-window(len(returns)) :]
    return 100.0 * float(np.mean(last)) / result.cell.spec.horizon


_REGIONS: dict[str, Callable[[Sequence[RegionReport]], float]] = {
    "wd_regret": _regret_wd,
    "ood_regret": _regret_ood,
}
METRICS = (
    Metric(
        "wd_regret", "normalised regret, WD", 1, lambda result: _regret_wd(result.report.regions)
    ),
    Metric(
        "ood_regret", "normalised regret, OOD", 1, lambda result: _regret_ood(result.report.regions)
    ),
    Metric("final_return", "final return, % of optimum", -1, _final_return),
    Metric("online_regret", "regret while training", 1, lambda result: result.online_regret),
)
REGRET_METRICS = METRICS[:2]


def analyse(
    file: StudyFile,
    results: Mapping[str, CellResult],
    failures: Mapping[str, str] | None = None,
    *,
    draws: int = statistics.DRAWS,
) -> Analysis:
    """Every table of a study, from whatever of its runs has finished.

    Args:
      file: the plan.
      results: by the cells' digests; those of other cells are ignored.
      failures: errors, by the cells' digests.
      draws: bootstrap samples of each interval.

    Returns:
      The tables. The same files give the same numbers.
    """
    plan, failures = file.plan, failures or {}
    runs: list[Run] = []
    missing: list[Missing] = []
    for cell in plan.cells:
        key = cell.cell.digest
        if key in results:
            runs.append(Run(cell, results[key]))
        else:
            error = failures.get(key, "")
            missing.append(Missing(cell.class_name, cell.algorithm, cell.run, error))
    planned = Counter((cell.class_name, cell.algorithm) for cell in plan.cells)
    done = Counter(run.place for run in runs)
    failed = Counter((gap.class_name, gap.algorithm) for gap in missing if gap.error)
    classes = {member.name: _seen(member, plan.classes[0]) for member in plan.classes}
    present = [a for a in plan.algorithms if any(run.place[1] == a.name for run in runs)]
    names = tuple(algorithm.name for algorithm in present)
    groups = _groups(classes, names, set(done))
    study = _Study(runs, groups, tuple(classes), names, file.digest, draws)
    return Analysis(
        file=file,
        results=tuple(runs),
        missing=tuple(missing),
        counts=tuple(Count(*at, done[at], failed[at], n) for at, n in planned.items()),
        classes=classes,
        algorithms=names,
        learners=tuple(a.name for a in present if not a.uses.startswith("reference:")),
        base=plan.classes[0].name,
        groups=groups,
        curves=tuple(study.curves()),
        regions=tuple(study.regions()),
        decay=tuple(study.decay()),
        levels=tuple(study.levels()),
        contrasts=tuple(study.contrasts(classes)),
        aggregates=tuple(study.aggregates()),
        profiles=tuple(study.profiles()),
        improvements=tuple(study.improvements()),
        offline_data=tuple(study.offline_data()),
        offline=tuple(study.offline(_learners(plan.algorithms))),
    )


def _seen(member: SuiteClass, first: SuiteClass) -> ClassInfo:
    """A class as seen from the first."""
    own, base = member.setting.to_dict(), first.setting.to_dict()
    differs = [name for name in AXES if own[name] != base[name]]
    if len(differs) > 1 and "policy_init" in differs:
        differs.remove("policy_init")
    axis = differs[0] if len(differs) == 1 else SEVERAL if differs else ""
    label = ", ".join(f"{AXES[name][0]} = {_shown(own[name])}" for name in differs)
    return ClassInfo(member.name, axis, label, {name: own[name] for name in AXES})


def _shown(value: Any) -> str:
    return str(value) if isinstance(value, str) else f"{value:g}"


def _groups(
    classes: Mapping[str, ClassInfo], algorithms: Sequence[str], done: set[tuple[str, str]]
) -> tuple[Group, ...]:
    """All classes, then each axis with the first class in its place; none without two classes."""
    first, *others = classes.values()
    found = []
    for axis in ("", *AXES, SEVERAL):
        members = [first, *(c for c in others if axis in ("", c.axis))]
        if axis in AXES and axis != "policy_init":
            members.sort(key=lambda c: float(c.setting[axis]))
        present = [c.name for c in members if any((c.name, a) in done for a in algorithms)]
        compared = [n for n in present if all((n, a) in done for a in algorithms)]
        if present and (not axis or len(members) > 1):
            name = AXES[axis][1] if axis in AXES else axis or ALL
            left_out = [n for n in present if n not in compared]
            found.append(Group(name, axis, tuple(present), tuple(compared), tuple(left_out)))
    return tuple(found)


class _Study:
    """A study's runs, and every table of them in turn."""

    def __init__(
        self,
        runs: Sequence[Run],
        groups: Sequence[Group],
        classes: Sequence[str],
        algorithms: Sequence[str],
        digest: str,
        draws: int,
    ) -> None:
        self._places: dict[tuple[str, str], list[Run]] = {}
        for run in runs:
            self._places.setdefault(run.place, []).append(run)
        self._groups, self._classes, self._algorithms = groups, classes, algorithms
        self._digest, self._draws = digest, draws
        self._learnt_from = learnt_from(runs)

    def curves(self) -> Iterator[Curve]:
        """Median and quartiles over runs, smoothed."""
        for (class_name, algorithm), runs in self._places.items():
            curves = [run.result.curve for run in runs if run.result.curve.steps]
            if not curves:
                continue
            P = min(len(curve.steps) for curve in curves)
            steps = np.median([curve.steps[:P] for curve in curves], axis=0)
            for measure in CURVES:
                values = np.array([getattr(curve, measure)[:P] for curve in curves])
                if measure == "episode_return":
                    values *= 100.0 / runs[0].result.cell.spec.horizon
                quartiles = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
                low, median, high = (_smoothed(line, window(P)) for line in quartiles)
                yield Curve(
                    class_name, algorithm, measure, steps, median, low, high, len(curves), window(P)
                )

    def regions(self) -> Iterator[RegionRow]:
        """Each algorithm on each class in each region."""
        for (class_name, algorithm), runs in self._places.items():
            reports = [run.result.report for run in runs]
            for index, region in enumerate(reports[0].regions):
                own = [report.regions[index] for report in reports]
                similarity = np.array([r.similarity for r in own])
                low, high = np.quantile(similarity, [0.25, 0.75])
                yield RegionRow(
                    class_name,
                    algorithm,
                    region.name,
                    region.epsilon_high,
                    len(own),
                    float(statistics.iqm(similarity)),
                    float(low),
                    float(high),
                    float(statistics.iqm([r.normalised_regret for r in own])),
                    float(
                        np.median([r.references[_LINEAR][index].normalised_regret for r in reports])
                    ),
                )

    def decay(self) -> Iterator[DecayRow]:
        """Every run's loss from the cube to the outermost shell."""
        for (class_name, algorithm), runs in self._places.items():
            for run in runs:
                inside, *_, outside = run.result.report.regions
                yield DecayRow(
                    class_name,
                    algorithm,
                    run.planned.run,
                    run.result.cell.spec.state_dim,
                    outside.epsilon_high,
                    inside.similarity,
                    outside.similarity_decay,
                    outside.similarity_loss,
                )

    def levels(self) -> Iterator[Level]:
        """Every metric's IQM."""
        for (class_name, algorithm), runs in self._places.items():
            for metric in METRICS:
                values = [value for run in runs if (value := metric.of(run.result)) is not None]
                if not values:
                    continue
                low, high = self._interval(values, f"level {algorithm} {class_name} {metric.key}")
                yield Level(
                    class_name,
                    algorithm,
                    metric.key,
                    len(values),
                    float(statistics.iqm(values)),
                    low,
                    high,
                    _of_linear(runs, metric),
                )

    def contrasts(self, classes: Mapping[str, ClassInfo]) -> Iterator[Contrast]:
        """What every other class changes, by runs of one number."""
        first, *others = classes.values()
        for info, algorithm, metric in itertools.product(others, self._algorithms, METRICS):
            before = self._numbered(first.name, algorithm, metric)
            after = self._numbered(info.name, algorithm, metric)
            pairs = sorted(before.keys() & after.keys())
            if not pairs:
                continue
            change = [after[i] - before[i] for i in pairs]
            low, high = self._interval(change, f"contrast {algorithm} {info.name} {metric.key}")
            yield Contrast(
                info.name,
                info.axis,
                algorithm,
                metric.key,
                float(statistics.iqm([before[i] for i in pairs])),
                float(statistics.iqm([after[i] for i in pairs])),
                float(statistics.iqm(change)),
                low,
                high,
                len(pairs),
                metric.worse,
            )

    def aggregates(self) -> Iterator[Aggregate]:
        """Scores over groups of classes."""
        for group, metric, algorithm in self._compared():
            scores = self._scores(group, algorithm, metric)
            counts = [len(runs) for runs in scores.values()]
            columns = {name: runs[:, None] for name, runs in scores.items()}
            for name, statistic in STATISTICS.items():
                low, high = statistics.stratified_bootstrap(
                    columns, self._draws, self._seed("aggregate", algorithm, metric.key), statistic
                )
                known = min(counts) > 1
                yield Aggregate(
                    group.name,
                    algorithm,
                    metric.key,
                    name,
                    len(counts),
                    sum(counts),
                    min(counts),
                    float(statistics.aggregate(columns, statistic)[0]),
                    float(low[0]) if known else None,
                    float(high[0]) if known else None,
                )

    def profiles(self) -> Iterator[Profile]:
        """Shares of runs above each threshold."""
        for group, metric, algorithm in self._compared():
            scores = self._scores(group, algorithm, metric)
            fewest = min(map(len, scores.values()))
            seed = self._seed("profile", algorithm, metric.key)
            found = statistics.performance_profile(scores, THRESHOLDS, self._draws, seed)
            yield Profile(group.name, algorithm, metric.key, fewest, THRESHOLDS, found)

    def improvements(self) -> Iterator[Improvement]:
        """Every pair of algorithms, but for those that learnt from different data."""
        pairs = [
            pair
            for pair in itertools.combinations(self._algorithms, 2)
            if len({self._learnt_from[name] for name in pair} - {None}) < 2
        ]
        for group, metric, (first, second) in itertools.product(
            self._groups, REGRET_METRICS, pairs
        ):
            if not group.compared:
                continue
            x, y = (self._scores(group, algorithm, metric) for algorithm in (first, second))
            fewest = min(len(runs) for runs in (*x.values(), *y.values()))
            seed = self._seed("improvement", first, second, metric.key)
            found = statistics.probability_of_improvement(x, y, self._draws, seed)
            yield Improvement(
                group.name,
                metric.key,
                first,
                second,
                len(x),
                fewest,
                float(found.value[0]),
                float(found.low[0]) if fewest > 1 else None,
                float(found.high[0]) if fewest > 1 else None,
            )

    def offline_data(self) -> Iterator[OfflineData]:
        """Who made the data, by class and ν; each data set once, however many learnt from it."""
        for (class_name, nu), runs in self._offline().items():
            sets = {scores.dataset_digest: scores for scores, _ in runs}.values()
            yield OfflineData(
                class_name,
                nu,
                len(sets),
                float(np.mean([scores.behaviour_similarity for scores in sets])),
                float(np.mean([scores.behaviour_similarity_sd for scores in sets])),
                float(np.mean([_of_constant(run.result) for _, run in runs])),
            )

    def offline(self, learners: Mapping[str, str]) -> Iterator[OfflineScore]:
        """What each learner made of the data, by class and ν."""
        names = dict.fromkeys(learners.values())
        for ((class_name, nu), runs), name in itertools.product(self._offline().items(), names):
            own = [scores for scores, run in runs if learners[run.place[1]] == name]
            if not own:
                continue
            changes = tuple(scores.similarity - scores.behaviour_similarity for scores in own)
            low = high = None
            if len(own) >= OFFLINE_INTERVAL:
                seed = self._seed("offline", name, class_name, f"{nu:g}")
                column = {"": np.array(changes)[:, None]}
                ends = statistics.stratified_bootstrap(column, self._draws, seed, statistics.mean)
                low, high = (float(end[0]) for end in ends)
            yield OfflineScore(
                class_name,
                nu,
                name,
                len(own),
                float(np.mean([scores.similarity for scores in own])),
                float(np.mean([scores.similarity_sd for scores in own])),
                float(np.mean(changes)),
                low,
                high,
                changes,
            )

    def _offline(self) -> dict[tuple[str, float], list[tuple[OfflineResult, Run]]]:
        """Runs that learnt from data, by class in the plan's order and by rising ν."""
        found: dict[tuple[str, float], list[tuple[OfflineResult, Run]]] = {}
        for runs in self._places.values():
            for run in runs:
                if (scores := run.result.offline) is not None:
                    at = run.planned.class_name, scores.nu
                    found.setdefault(at, []).append((scores, run))
        order = {name: i for i, name in enumerate(self._classes)}
        return {at: found[at] for at in sorted(found, key=lambda at: (order[at[0]], at[1]))}

    def _compared(self) -> Iterator[tuple[Group, Metric, str]]:
        groups = (group for group in self._groups if group.compared)
        return itertools.product(groups, REGRET_METRICS, self._algorithms)

    def _numbered(self, class_name: str, algorithm: str, metric: Metric) -> dict[int, float]:
        """A metric of each run, by its number."""
        runs = self._places.get((class_name, algorithm), [])
        found = ((run.planned.run, metric.of(run.result)) for run in runs)
        return {number: value for number, value in found if value is not None}

    def _scores(self, group: Group, algorithm: str, metric: Metric) -> dict[str, Array]:
        """`[n]` 1 − regret of the runs of each class."""
        return {
            name: 1.0 - np.array([metric.of(run.result) for run in self._places[name, algorithm]])
            for name in group.compared
        }

    def _interval(self, values: Sequence[float], of: str) -> tuple[float | None, float | None]:
        """Of the IQM; of a single run nothing is known."""
        if len(values) < 2:
            return None, None
        column = {"": np.array(values)[:, None]}
        low, high = statistics.stratified_bootstrap(column, self._draws, self._seed(of))
        return float(low[0]), float(high[0])

    def _seed(self, *parts: str) -> str:
        return " ".join((self._digest, *parts))


def _of_linear(runs: Sequence[Run], metric: Metric) -> float | None:
    """The linear policy's median over the runs' tasks; None where the metric is of no region."""
    of = _REGIONS.get(metric.key)
    if of is None:
        return None
    return float(np.median([of(run.result.report.references[_LINEAR]) for run in runs]))


def _of_constant(result: CellResult) -> float:
    """Mean r̃ of the constant ½ within distribution."""
    return result.report.references[_CONSTANT][0].similarity


def _learners(algorithms: Sequence[StudyAlgorithm]) -> dict[str, str]:
    """What each algorithm of the plan is whatever its ν: `IQL`, or `IQL (expectile = 0.9)`."""
    apart = {
        algorithm.name: {k: v for k, v in algorithm.hyperparameters.items() if k != "nu"}
        | ({} if algorithm.steps is None else {"steps": algorithm.steps})
        for algorithm in algorithms
    }
    found = {}
    for algorithm in algorithms:
        kin = [apart[other.name] for other in algorithms if other.uses == algorithm.uses]
        own = apart[algorithm.name]
        told = [
            f"{key} = {own[key]}" if key in own else f"default {key}"
            for key in sorted({key for settings in kin for key in settings})
            if any(settings.get(key) != kin[0].get(key) for settings in kin)
        ]
        name = algorithm.uses.removeprefix("offline:").upper()
        found[algorithm.name] = f"{name} ({', '.join(told)})" if told else name
    return found


def _smoothed(line: Array, width: int) -> Array:
    """Means over the last `width` entries, fewer at the beginning."""
    total = np.concatenate([[0.0], np.cumsum(line)])
    ends = np.arange(1, len(line) + 1)
    begins = np.maximum(0, ends - width)
    return np.asarray((total[ends] - total[begins]) / (ends - begins))
