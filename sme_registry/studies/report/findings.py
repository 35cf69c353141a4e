"""Findings of a study: which property of the task breaks each algorithm, and how sure that is.

They follow from the contrasts of normalised regret within distribution. A change counts if its 95 %
interval excludes 0; it is an indication if it rests on fewer than `ENOUGH_RUNS` pairs. Any other
change is open, which does not mean that it is none. `templates/findings.jinja` has the words.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal

from pydantic import SerializerFunctionWrapHandler, model_serializer

from sme_registry.diagnosis.questions import THRESHOLDS as DIAGNOSIS
from sme_registry.spec import Digest, Integer, Real, SchemaVersion, StrictModel, TupleOf
from sme_registry.spec.document import without_empty
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import ALL
from sme_registry.studies.report.offline_findings import THRESHOLDS as OFFLINE
from sme_registry.studies.report.offline_findings import OfflineFindings, offline_findings
from sme_registry.studies.report.offline_tables import OFFLINE_INTERVAL
from sme_registry.studies.report.streams.findings import StreamFindings, stream_findings
from sme_registry.studies.report.tables import ENOUGH_RUNS, training_data

__all__ = [
    "THRESHOLDS",
    "AlgorithmFinding",
    "Best",
    "Caveats",
    "Contrast",
    "Findings",
    "OutOfDistribution",
    "Rival",
    "findings",
]

THRESHOLDS = {
    "unlearnt": DIAGNOSIS["unlearnt"],  # normalised regret, at least: almost nothing was learnt
    "broken": 0.2,  # change of normalised regret, at least
    "hurt": 0.05,  # at least; a smaller one hurts slightly
    "probability": 0.5,  # of improvement, for the better of two algorithms
    "enough_runs": float(ENOUGH_RUNS),  # with fewer runs or pairs a change is an indication
    "interval_runs": float(OFFLINE_INTERVAL),  # with fewer an improvement has no interval
    **OFFLINE,
}
_WD, _OOD = "wd_regret", "ood_regret"
_CHANCE = 0.05  # share of 95 % intervals that exclude 0 without an effect

Severity = Literal["broken", "hurt", "slightly_hurt"]
Certainty = Literal["indication", "rivals", "only_axis", "certain"]
Position = Literal[
    "worse_than_constant", "like_constant", "worse_than_linear", "better_than_linear"
]


class Contrast(StrictModel):
    """The change of normalised regret from the first class to another; a row of `contrasts`."""

    class_name: str
    axis: str  # the field in which the classes differ; `SEVERAL`; or ""
    setting: str  # the class's values of the fields that differ, such as "k = 25"
    base: Real  # IQM of the normalised regret on the first class
    level: Real  # and on this one
    change: Real
    low: Real | None
    high: Real | None
    pairs: Integer  # of runs
    enough_pairs: bool  # at least `ENOUGH_RUNS`
    verdict: Literal["worse", "better", "open"]  # "open" unless the interval excludes 0


class OutOfDistribution(StrictModel):
    """The class that costs most regret out of distribution, and larger changes that are open."""

    worst: Contrast
    larger: TupleOf[Contrast]


class AlgorithmFinding(StrictModel):
    """Which property of the task breaks an algorithm."""

    algorithm: str
    # By the largest change for the worse; "none_shown" if there is none, and "no_contrasts" if no
    # run on the first class has a partner on another.
    verdict: Severity | Literal["none_shown", "no_contrasts"]
    base_wd_regret: Real | None = None  # on the first class; None if it has no run there
    base_unlearnt: bool = False  # whether almost nothing was learnt on the first class
    worst: Contrast | None = None  # the largest change for the worse
    larger: TupleOf[Contrast] = ()  # larger changes that are open
    # Whether `worst` is certainly the worst: "indication" with few pairs; "rivals" if the intervals
    # of other axes allow a larger change; "only_axis" if no other was varied.
    certainty: Certainty | None = None
    rivals: TupleOf[Contrast] = ()  # those other axes
    position: Position | None = None  # of the level on `worst`; None without a linear policy
    linear_wd_regret: Real | None = None  # WD regret of the linear policy on `worst`
    base_linear_wd_regret: Real | None = None  # and on the first class
    harder_to_fit: bool = False  # whether it rises by more than the threshold "hurt"
    also_worse: TupleOf[Contrast] = ()  # changes for the worse on other axes
    better: TupleOf[Contrast] = ()  # changes for the better
    open: TupleOf[Contrast] = ()  # axes without a change for the worse, apart from `larger`
    out_of_distribution: OutOfDistribution | None = None  # over the shells; None if none is certain
    highest_change: Real | None = None  # the highest end of an interval
    largest_single: Contrast | None = None  # the largest change of a single pair of runs


class Rival(StrictModel):
    """An algorithm compared with the best one."""

    algorithm: str
    probability: Real  # that a run of the best algorithm beats one of this algorithm
    low: Real | None  # of its 95 % interval; None if a class has a single run
    high: Real | None
    # "open" if the interval reaches down to 0.5; "indication" with few runs.
    verdict: Literal["better", "indication", "open"]


class Best(StrictModel):
    """The best algorithm over all classes, among those with equal data."""

    algorithm: str
    nu: Real | None  # of the data that all of them learnt from; None for online algorithms
    transitions: Integer | None
    classes: Integer  # on which all algorithms have runs
    iqm: Real  # of 1 − WD regret, mean over classes: 1 is the optimum, 0 the constant ½
    low: Real | None  # of its 95 % interval; None if a class has a single run
    high: Real | None
    rivals: TupleOf[Rival]  # the other algorithms


class Caveats(StrictModel):
    """What limits all findings."""

    planned: Integer  # runs
    missing: Integer
    failed: Integer  # of those missing
    fewest_pairs: Integer | None  # of a contrast; None without contrasts
    intervals: Integer  # of contrasts within distribution
    false_findings: Integer  # how many of them exclude 0 by chance if nothing has an effect
    other_policy_init: TupleOf[str]  # classes whose policy_init also differs from the first's


class Findings(StrictModel):
    """What a study found, as data."""

    schema_version: SchemaVersion = 1
    study: str  # name and version of the plan
    digest: Digest  # of the plan
    base: str  # the plan's first class, with which the others are contrasted; "" without classes
    thresholds: dict[str, Real]  # see `THRESHOLDS`
    algorithms: TupleOf[AlgorithmFinding]  # those that learn
    steps: dict[str, Integer]  # training steps of those compared, if they differ
    best: TupleOf[Best]  # one for each data set that algorithms share
    caveats: Caveats
    offline: OfflineFindings | None  # what learning from data adds; None without such runs
    streams: StreamFindings | None = None  # None, and left out of the JSON, without streams

    @model_serializer(mode="wrap")
    def _omit_no_streams(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return without_empty(handler(self), "streams")


def findings(analysis: Analysis) -> Findings:
    """The findings of a study, from its tables."""
    rows = analysis.aggregates
    rows = rows[(rows.group == ALL) & (rows.metric == _WD) & (rows.statistic == "iqm")]
    compared = list(rows[rows.algorithm.isin(analysis.learners)].itertuples())
    return Findings(
        study=analysis.file.versioned_name,
        digest=analysis.file.digest,
        base=analysis.base,
        thresholds=THRESHOLDS,
        algorithms=tuple(_algorithm(analysis, algorithm) for algorithm in analysis.learners),
        steps=_steps(analysis, [row.algorithm for row in compared]),
        best=tuple(_best(analysis, compared)),
        caveats=_caveats(analysis),
        offline=offline_findings(analysis) if analysis.has_offline_runs else None,
        streams=None if analysis.streams is None else stream_findings(analysis.streams),
    )


def _algorithm(analysis: Analysis, algorithm: str) -> AlgorithmFinding:
    contrasts = _contrasts(analysis, algorithm, _WD)
    if not contrasts:
        return AlgorithmFinding(algorithm=algorithm, verdict="no_contrasts")
    base_wd_regret, base_linear = _level(analysis, analysis.base, algorithm)
    fields: dict[str, Any] = {
        "algorithm": algorithm,
        "base_wd_regret": base_wd_regret,
        "base_unlearnt": base_wd_regret is not None and base_wd_regret >= THRESHOLDS["unlearnt"],
        "better": tuple(c for c in contrasts if c.verdict == "better"),
        "highest_change": max((c.high for c in contrasts if c.high is not None), default=None),
        "largest_single": _largest(c for c in contrasts if c.high is None),
    }
    worst = _largest(c for c in contrasts if c.verdict == "worse")
    if worst is None:
        return AlgorithmFinding(verdict="none_shown", **fields)
    larger = _larger(contrasts, worst)
    rivals = _rivals(contrasts, worst)
    _, linear = _level(analysis, worst.class_name, algorithm)
    rise = 0.0 if linear is None or base_linear is None else linear - base_linear
    worse = _largest_of_each_axis(c for c in contrasts if c.verdict == "worse")
    return AlgorithmFinding(
        verdict=_severity(worst.change),
        worst=worst,
        larger=larger,
        certainty=_certainty(contrasts, worst, rivals),
        rivals=rivals,
        position=_position(worst.level, linear),
        linear_wd_regret=linear,
        base_linear_wd_regret=base_linear,
        harder_to_fit=rise > THRESHOLDS["hurt"],
        also_worse=tuple(c for c in worse if c.axis != worst.axis),
        open=tuple(
            c for c in _largest_of_each_axis(contrasts) if c.verdict != "worse" and c not in larger
        ),
        out_of_distribution=_out_of_distribution(analysis, algorithm),
        **fields,
    )


def _severity(change: float) -> Severity:
    if change >= THRESHOLDS["broken"]:
        return "broken"
    return "hurt" if change >= THRESHOLDS["hurt"] else "slightly_hurt"


def _certainty(
    contrasts: Sequence[Contrast], worst: Contrast, rivals: Sequence[Contrast]
) -> Certainty:
    if not worst.enough_pairs:
        return "indication"
    if rivals:
        return "rivals"
    return "only_axis" if len({c.axis for c in contrasts}) == 1 else "certain"


def _position(level: float, linear: float | None) -> Position | None:
    """Where a normalised regret is among the constant's, which is 1, and the linear policy's."""
    if level > 2.0 - THRESHOLDS["unlearnt"]:
        return "worse_than_constant"
    if level >= THRESHOLDS["unlearnt"]:
        return "like_constant"
    if linear is None:
        return None
    return "worse_than_linear" if level > linear else "better_than_linear"


def _out_of_distribution(analysis: Analysis, algorithm: str) -> OutOfDistribution | None:
    contrasts = _contrasts(analysis, algorithm, _OOD)
    worst = _largest(c for c in contrasts if c.verdict == "worse")
    if worst is None:
        return None
    return OutOfDistribution(worst=worst, larger=_larger(contrasts, worst))


def _contrasts(analysis: Analysis, algorithm: str, metric: str) -> list[Contrast]:
    rows = analysis.contrasts
    rows = rows[(rows.algorithm == algorithm) & (rows.metric == metric)]
    rows = rows.drop(columns=["algorithm", "metric"]).astype(object)
    return [
        Contrast(
            **{**row, "low": _known(row["low"]), "high": _known(row["high"])},
            setting=analysis.classes[row["class_name"]].label,
        )
        for row in rows.to_dict("records")
    ]


def _level(
    analysis: Analysis, class_name: str, algorithm: str
) -> tuple[float | None, float | None]:
    """WD regret of an algorithm on a class, and that of the linear policy."""
    rows = analysis.levels
    place = (rows.class_name == class_name) & (rows.algorithm == algorithm) & (rows.metric == _WD)
    row = next(rows[place].itertuples(), None)
    return (None, None) if row is None else (row.iqm, _known(row.linear))


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _largest(contrasts: Iterable[Contrast]) -> Contrast | None:
    return max(contrasts, key=lambda c: c.change, default=None)


def _largest_of_each_axis(contrasts: Iterable[Contrast]) -> tuple[Contrast, ...]:
    """For each axis the contrast with the largest change, in falling order."""
    largest: dict[str, Contrast] = {}
    for contrast in sorted(contrasts, key=lambda c: c.change, reverse=True):
        largest.setdefault(contrast.axis or contrast.class_name, contrast)
    return tuple(largest.values())


def _larger(contrasts: Iterable[Contrast], worst: Contrast) -> tuple[Contrast, ...]:
    """Changes that are larger than the largest certain one."""
    return _largest_of_each_axis(c for c in contrasts if c.change > worst.change)


def _rivals(contrasts: Iterable[Contrast], worst: Contrast) -> tuple[Contrast, ...]:
    """Changes on other axes that may be larger than the worst one, by their intervals."""
    low = worst.low or 0.0
    return _largest_of_each_axis(
        c for c in contrasts if c.axis != worst.axis and (c.high is None or c.high >= low)
    )


def _steps(analysis: Analysis, algorithms: Sequence[str]) -> dict[str, int]:
    steps = dict(zip(analysis.runs.algorithm, analysis.runs.steps.tolist(), strict=True))
    compared = {algorithm: steps[algorithm] for algorithm in algorithms}
    return compared if len(set(compared.values())) > 1 else {}


def _best(analysis: Analysis, rows: Sequence[Any]) -> Iterable[Best]:
    data = training_data(analysis.runs)
    for shared in dict.fromkeys(data[row.algorithm] for row in rows):
        alike = [row for row in rows if data[row.algorithm] == shared]
        if len(alike) < 2:
            continue
        best = max(alike, key=lambda row: row.value)
        nu, transitions = shared or (None, None)
        yield Best(
            algorithm=best.algorithm,
            nu=nu,
            transitions=transitions,
            classes=best.classes,
            iqm=best.value,
            low=_known(best.low),
            high=_known(best.high),
            rivals=tuple(_improvements(analysis, best.algorithm, {row.algorithm for row in alike})),
        )


def _improvements(analysis: Analysis, best: str, among: set[str]) -> Iterable[Rival]:
    rows = analysis.improvements
    for row in rows[(rows.group == ALL) & (rows.metric == _WD)].itertuples():
        pair = {row.first, row.second}
        if best not in pair or not pair <= among:
            continue
        probability, low, high = row.probability, _known(row.low), _known(row.high)
        if row.second == best:
            probability = 1.0 - probability
            low, high = (None if end is None else 1.0 - end for end in (high, low))
        verdict: Literal["better", "indication", "open"] = "open"
        if low is not None and low > THRESHOLDS["probability"]:
            verdict = "better" if row.fewest_runs >= ENOUGH_RUNS else "indication"
        (other,) = pair - {best}
        yield Rival(algorithm=other, probability=probability, low=low, high=high, verdict=verdict)


def _caveats(analysis: Analysis) -> Caveats:
    rows, missing = analysis.contrasts, analysis.missing
    rows = rows[rows.algorithm.isin(analysis.learners)]
    base = analysis.classes.get(analysis.base)
    policy_init = None if base is None else base.setting["policy_init"]
    intervals = int(((rows.metric == _WD) & rows.low.notna()).sum())
    return Caveats(
        planned=len(analysis.runs) + len(missing),
        missing=len(missing),
        failed=int((missing.error != "").sum()),
        fewest_pairs=None if rows.empty else int(rows.pairs.min()),
        intervals=intervals,
        false_findings=max(1, round(_CHANCE * intervals)),
        other_policy_init=tuple(
            name
            for name, info in analysis.classes.items()
            if info.axis != "policy_init" and info.setting["policy_init"] != policy_init
        ),
    )
