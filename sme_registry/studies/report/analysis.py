"""`Analysis`: a study's finished runs and its tables, and what tables are made of.

The run is the unit, or in streams the life: its regions and evaluations are no further evidence.
Missing runs are part of no number but counts.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sme_registry import statistics
from sme_registry.evaluation import retention
from sme_registry.evaluation.dynamic_regret import DynamicRegret
from sme_registry.spec import ObservationSpec, StreamSpec, StudyFile, StudyPlan, SuiteClass
from sme_registry.spec.cards import symbol
from sme_registry.spec.study import PlannedCell
from sme_registry.statistics import Array, Statistic
from sme_registry.studies.engine.result import CellResult
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
WITHIN, OUTSIDE = "WD", "OOD"
ALL = "all classes"
SEVERAL = "several axes"
TASKS, SCHEDULE = "tasks", "schedule"  # axes of streams
_AXES = {
    "state_dim": "state dimension",
    "action_dim": "action dimension",
    "k": "reward interval",
    "r_min": "minimum reward",
    "D": "survival threshold",
    "complexity": "complexity",
    "horizon": "horizon",
    "hidden_width": "hidden width",
    "rotation": "rotation",
    "safety.tightness": "tightness",
}
AXES = {field: (symbol(field), f"{words} {symbol(field)}") for field, words in _AXES.items()} | {
    field: (field, field) for field in ("observation", "policy_init")
}
"""Symbol and name of each field that studies vary, in the order of reports."""


@dataclass(frozen=True)
class ClassInfo:
    """A class of the plan, compared with the first one.

    `axis` is the field in which it differs, dotted within a team (`team.reward`) or an observation;
    "" for the first; `SEVERAL`. `policy_init` counts only if nothing else differs: deep tasks need
    another one. `setting` has every field; the tightness is 0 without safety.
    """

    name: str
    axis: str
    label: str
    setting: Mapping[str, Any]


@dataclass(frozen=True)
class StreamInfo:
    """A class of streams, by its first draw.

    Its axis is what differs from the plan's first stream: "" for itself, `TASKS` if nothing else
    differs, or `SCHEDULE`.
    """

    name: str
    stream: StreamSpec
    axis: str

    @property
    def related(self) -> bool:
        """Whether all phases are rotations of one task."""
        return len({phase.spec.derive(rotation=0.0) for phase in self.stream.phases}) == 1


@dataclass(frozen=True)
class Group:
    """The classes with runs along one axis, in the order of its values; or all, with axis "".

    `values` are empty without a common axis. In `compared` every algorithm has finished runs.
    """

    name: str
    axis: str
    classes: tuple[str, ...]
    values: tuple[Any, ...]
    compared: tuple[str, ...]


def class_infos(plan: StudyPlan) -> dict[str, ClassInfo]:
    return {member.name: _class_info(member, plan.classes[0]) for member in plan.classes}


def stream_infos(plan: StudyPlan) -> dict[str, StreamInfo]:
    infos: dict[str, StreamInfo] = {}
    for member in plan.streams:
        stream = member.instances[0]
        base = next(iter(infos.values()), None)
        alike = base is not None and stream.switches == base.stream.switches
        axis = "" if base is None else TASKS if alike else SCHEDULE
        infos[member.name] = StreamInfo(member.name, stream, axis)
    return infos


def groups(
    classes: Mapping[str, ClassInfo],
    algorithms: Sequence[str],
    finished: Collection[tuple[str, str]],
) -> tuple[Group, ...]:
    """All classes, then for each axis its classes together with the first one."""
    if not classes:
        return ()
    first, *others = classes.values()
    unnamed = [c.axis for c in others if c.axis not in ("", *AXES, SEVERAL)]
    result = []
    for axis in dict.fromkeys(("", *AXES, *unnamed, SEVERAL)):
        members = [first, *(c for c in others if axis in ("", c.axis))]
        values = [] if axis in ("", SEVERAL) else [c.setting.get(axis) for c in members]
        if is_numeric(values):
            members.sort(key=lambda c: c.setting[axis])
        present = [c for c in members if any((c.name, a) in finished for a in algorithms)]
        if present and (not axis or len(members) > 1):
            names = tuple(c.name for c in present)
            compared = (n for n in names if all((n, a) in finished for a in algorithms))
            known = tuple(c.setting.get(axis) for c in present) if values else ()
            result.append(Group(axis_label(axis) or ALL, axis, names, known, tuple(compared)))
    return tuple(result)


def axis_label(axis: str) -> str:
    """What an axis is called: `reward interval k`."""
    return AXES[axis][1] if axis in AXES else axis


def is_numeric(values: Sequence[Any]) -> bool:
    return bool(values) and all(type(value) in (int, float) for value in values)


def setting_label(field: str, value: Any, *, with_symbol: bool = True) -> str:
    """`k = 25`, or `25` without the symbol of the field."""
    text = value
    if not isinstance(value, str):
        as_json = json.dumps(value, separators=(",", ":"), ensure_ascii=False)
        text = f"{value:g}" if is_numeric([value]) else as_json
    return f"{AXES.get(field, (field,))[0]} = {text}" if with_symbol else text


def _class_info(member: SuiteClass, first: SuiteClass) -> ClassInfo:
    setting, base = _setting(member), _setting(first)
    differing = [name for name in AXES if name != "observation" and setting[name] != base[name]]
    for block in ("observation", "team"):
        within = [n for n in dict.fromkeys((*base, *setting)) if n.partition(".")[0] == block]
        within = [name for name in within if setting.get(name) != base.get(name)]
        both = getattr(member.setting, block) and getattr(first.setting, block)
        differing += within if len(within) == 1 and both else [block] * bool(within)
    if len(differing) > 1 and "policy_init" in differing:
        differing.remove("policy_init")
    agents = 0 if member.setting.team is None else len(member.setting.team.agents)
    setting["team"] = f"{agents} agents" if agents else "none"
    setting["observation"] = _observation(member.setting.observation)
    axis = differing[0] if len(differing) == 1 else SEVERAL if differing else ""
    label = ", ".join(setting_label(name, setting[name]) for name in differing)
    return ClassInfo(member.name, axis, label, setting)


def _setting(member: SuiteClass) -> dict[str, Any]:
    return {"safety.tightness": 0.0} | _flat(member.setting.every_field())


def _observation(observation: ObservationSpec | None) -> str:
    """An observation in words: `32 driven, nonlinear 1`."""
    if observation is None:
        return "state"
    distractors = f"{observation.distractors} {observation.dynamics}"
    mixing = " ".join(str(part) for part in (observation.mixing, observation.mixing_depth) if part)
    parts = [distractors] * bool(observation.distractors) + [mixing] * (mixing != "none")
    return ", ".join(parts)


def _flat(fields: Any, prefix: str = "") -> dict[str, Any]:
    """The values of nested plain data by their dotted names; lists of numbers are values."""
    flat: dict[str, Any] = {}
    for key, value in fields.items() if isinstance(fields, dict) else enumerate(fields):
        name = f"{prefix}{key}"
        nested = isinstance(value, dict) or (
            isinstance(value, list) and any(isinstance(item, dict) for item in value)
        )
        flat |= _flat(value, f"{name}.") if nested else {name: value}
    return flat


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
SPECIAL_METRICS = (
    Metric("wd_cost", "WD cost", 1, 3),
    Metric("wd_safe_regret", "WD safe regret", 1),
    Metric("online_cost", "online cost", 1, 3),
    Metric("distractor_regret", "regret with distractors outside their cube", 1),
    Metric("wd_invariance", "WD invariance", 1),
)
_LESS_IS_BETTER = ("forgetting", "plasticity_ratio", "plasticity_difference")
RETENTION = {
    key: Metric(key, label, 1 if key in _LESS_IS_BETTER else -1)
    for key, label in retention.METRICS.items()
}
_VISITED = "regret on the visited phase"
OF_TRAINING = (
    Metric("learning_transfer", "learning transfer", -1),
    Metric("online_regret", "online regret", 1, 3),
    Metric("frozen_online_regret", f"online regret, {retention.LABELS['frozen_agent']}", 1, 3),
)
OF_LIVES = (Metric("visited_regret", _VISITED, 1), *RETENTION.values(), *OF_TRAINING)
OF_VISITS = (
    Metric("normalised_regret", _VISITED, 1),
    *(RETENTION[key] for key in retention.BY_VISIT),
    *OF_TRAINING,
)


def metrics_of(runs: pd.DataFrame) -> tuple[Metric, ...]:
    return (*METRICS, *(metric for metric in SPECIAL_METRICS if metric.key in runs.columns))


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
    def stream_base(self) -> str:
        return next(iter(self.streams), "")

    @property
    def stream_algorithms(self) -> tuple[str, ...]:
        present = {life.planned.algorithm for life in self.lives}
        return tuple(a.name for a in self.plan.algorithms if a.name in present)

    @property
    def metrics(self) -> tuple[Metric, ...]:
        return metrics_of(self.runs)

    @property
    def parts(self) -> tuple[RunKind, ...]:
        axes = {name: info.axis for name, info in self.classes.items()}
        tasks = RunKind(False, self.runs, axes, self.algorithms, self.metrics, "spec_digest")
        if not self.streams:
            return (tasks,)
        lives = self.tables["stream_lives"]
        lives = lives[lives.region == WITHIN].reset_index(drop=True)
        axes = {name: info.axis for name, info in self.streams.items()}
        return tasks, RunKind(True, lives, axes, self.stream_algorithms, OF_LIVES, "stream_digest")

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
