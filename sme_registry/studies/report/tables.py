"""What a study's report is made of, as plain values: `analysis` computes them.

Axis letters: `P` evaluations of a learning curve, `K` thresholds of a profile.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from sme_registry.spec import PlannedCell, StudyFile
from sme_registry.statistics import Array, Estimate
from sme_registry.studies.engine.result import CellResult

# Under this many runs an interval is an indication only. Of normal, exponential and two-humped
# runs a 95 % interval of one class holds the truth in 32–62 % of cases with 2 runs, in 48–86 %
# with 3, in 94–98 % with 4 to 10.
ENOUGH_RUNS = 5
OFFLINE_INTERVAL = 4  # runs under which a mean improvement has no interval at all


@dataclass(frozen=True)
class Metric:
    """A number of a run that a task may change.

    Attributes:
      key: as in tables.
      label: as on an axis of a figure.
      worse: +1 where more of it is worse, −1 where less is.
      of: reads it from a result; None where the run has none.
    """

    key: str
    label: str
    worse: int
    of: Callable[[CellResult], float | None]


@dataclass(frozen=True)
class ClassInfo:
    """A class of the plan, seen from the first one.

    Attributes:
      name: in the plan.
      axis: the field in which it differs from the first class; "" for the first; `SEVERAL`.
        `policy_init` counts only where nothing else differs, as its readings part with others.
      label: `k = 25`; of several axes each of them.
      setting: every axis' value.
    """

    name: str
    axis: str
    label: str
    setting: Mapping[str, Any]


@dataclass(frozen=True)
class Run:
    """A finished run and its place in the plan."""

    planned: PlannedCell
    result: CellResult

    @property
    def place(self) -> tuple[str, str]:
        """Class and algorithm."""
        return self.planned.class_name, self.planned.algorithm


class Missing(NamedTuple):
    """A run that the plan has and the folder has not; `error` where it failed."""

    class_name: str
    algorithm: str
    run: int
    error: str


class Count(NamedTuple):
    """Runs of an algorithm on a class."""

    class_name: str
    algorithm: str
    done: int
    failed: int
    planned: int


@dataclass(frozen=True, eq=False)
class Curve:
    """Learning curves of an algorithm on a class, of one measure.

    Attributes:
      steps: `[P]` environment steps.
      median: `[P]` over runs, smoothed.
      low: `[P]` lower quartile over runs, smoothed.
      high: `[P]` upper quartile.
      runs: how many.
      window: evaluations that were averaged.
    """

    class_name: str
    algorithm: str
    measure: str
    steps: Array
    median: Array
    low: Array
    high: Array
    runs: int
    window: int


class RegionRow(NamedTuple):
    """An algorithm on a class in a region: over its runs.

    `linear` is the normalised regret of the linear least-squares policy on the same states.
    """

    class_name: str
    algorithm: str
    region: str
    epsilon: float
    runs: int
    similarity: float
    similarity_low: float
    similarity_high: float
    regret: float
    linear: float


class DecayRow(NamedTuple):
    """A run: its similarity within the cube, and what it loses in the outermost shell."""

    class_name: str
    algorithm: str
    run: int
    state_dim: int
    epsilon: float
    similarity: float
    decay: float
    decay_points: float


@dataclass(frozen=True)
class Level:
    """An algorithm on a class by one metric: IQM over its runs, with its interval.

    Attributes:
      low: lower end; None from a single run.
      linear: the linear policy's median on the same tasks, where the metric is of a region.
    """

    class_name: str
    algorithm: str
    metric: str
    runs: int
    value: float
    low: float | None
    high: float | None
    linear: float | None


@dataclass(frozen=True)
class Contrast:
    """What a class changes for an algorithm, against the plan's first class.

    Attributes:
      base: IQM on the first class, of the paired runs.
      level: IQM on this class, of the same run numbers.
      change: IQM of the paired differences.
      low: lower end of its interval; None from a single pair.
      high: upper end.
      pairs: run numbers that both classes have.
      worse: +1 where a rise is worse, −1 where a fall is.
    """

    class_name: str
    axis: str
    algorithm: str
    metric: str
    base: float
    level: float
    change: float
    low: float | None
    high: float | None
    pairs: int
    worse: int

    @property
    def verdict(self) -> str:
        """`worse`, `better` or `open`: whether the interval leaves out 0, and on which side."""
        if self.low is None or self.high is None or self.low <= 0.0 <= self.high:
            return "open"
        return "worse" if self.change * self.worse > 0 else "better"

    @property
    def settled(self) -> bool:
        """Whether there are runs enough for the interval to hold what it says."""
        return self.pairs >= ENOUGH_RUNS


@dataclass(frozen=True)
class Aggregate:
    """An algorithm's score over the classes of a group, classes counting alike.

    Attributes:
      group: an axis, with the first class; or all classes.
      metric: of which the score is 1 minus it.
      statistic: "iqm", "median" or "optimality_gap", taken within each class.
      classes: how many: those where every compared algorithm has runs.
      runs: in them.
      fewest: runs in the class that has the fewest.
    """

    group: str
    algorithm: str
    metric: str
    statistic: str
    classes: int
    runs: int
    fewest: int
    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True, eq=False)
class Profile:
    """The share of an algorithm's runs that score above each of `[K]` thresholds."""

    group: str
    algorithm: str
    metric: str
    fewest: int
    thresholds: Array
    estimate: Estimate


@dataclass(frozen=True)
class Improvement:
    """How probably a run of one algorithm beats one of another, over the classes of a group."""

    group: str
    metric: str
    first: str
    second: str
    classes: int
    fewest: int
    value: float
    low: float | None
    high: float | None


class OfflineData(NamedTuple):
    """Data sets of one ν on a class: who made them, beside a constant.

    Attributes:
      sets: how many data sets.
      behaviour: mean r̃ of the policy that made them, over the sets.
      behaviour_sd: standard deviation over steps, its mean over the sets.
      constant: mean r̃ of the constant ½ within distribution, over the runs.
    """

    class_name: str
    nu: float
    sets: int
    behaviour: float
    behaviour_sd: float
    constant: float


class OfflineScore(NamedTuple):
    """What a learner made of data sets of one ν on a class.

    Attributes:
      learner: what it `uses`, with its settings where the plan has several.
      runs: how many.
      score: mean r̃ of the last live episodes, over the runs.
      score_sd: standard deviation over steps, its mean over the runs.
      change: mean over the runs of r̃ less the r̃ of the policy that made the run's data.
      low: lower end of the 95 % interval of `change`; None under `OFFLINE_INTERVAL` runs.
      high: upper end.
      changes: of the runs.
    """

    class_name: str
    nu: float
    learner: str
    runs: int
    score: float
    score_sd: float
    change: float
    low: float | None
    high: float | None
    changes: tuple[float, ...]


@dataclass(frozen=True)
class Group:
    """Classes that are looked at together.

    Attributes:
      name: `all classes`, or an axis as a reader calls it.
      axis: the field; "" for all classes.
      classes: in the order of the axis' values, the first class of the plan among them.
      compared: those where every algorithm that is compared has runs.
      left_out: the others that have any.
    """

    name: str
    axis: str
    classes: tuple[str, ...]
    compared: tuple[str, ...]
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class Analysis:
    """A study's tables.

    Attributes:
      file: the plan.
      results: finished runs, in the plan's order.
      algorithms: those with a finished run, in the plan's order.
      learners: those of them that learn.
      base: the first class' name.
      offline_data: of cells that learn from data, by class and ν; empty where there are none.
      offline: their learners, likewise.
    """

    file: StudyFile
    results: tuple[Run, ...]
    missing: tuple[Missing, ...]
    counts: tuple[Count, ...]
    classes: Mapping[str, ClassInfo]
    algorithms: tuple[str, ...]
    learners: tuple[str, ...]
    base: str
    groups: tuple[Group, ...]
    curves: tuple[Curve, ...]
    regions: tuple[RegionRow, ...]
    decay: tuple[DecayRow, ...]
    levels: tuple[Level, ...]
    contrasts: tuple[Contrast, ...]
    aggregates: tuple[Aggregate, ...]
    profiles: tuple[Profile, ...]
    improvements: tuple[Improvement, ...]
    offline_data: tuple[OfflineData, ...] = ()
    offline: tuple[OfflineScore, ...] = ()

    def level(self, class_name: str, algorithm: str, metric: str) -> Level | None:
        """A level; None where there are no runs."""
        wanted = class_name, algorithm, metric
        return next(
            (x for x in self.levels if (x.class_name, x.algorithm, x.metric) == wanted), None
        )
