"""The design of a study: its classes and the axes along which they differ, and its metrics."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from sme_registry.evaluation.retention import LABELS
from sme_registry.spec import (
    Setting,
    StreamSpec,
    StudyAlgorithm,
    StudyPlan,
    SuiteClass,
    TeamSpec,
    cards,
)
from sme_registry.spec.cards import BLOCKS, fields_of_block, number_type, symbol
from sme_registry.spec.document import Document
from sme_registry.training.algorithms import parse_uses


class Metric(NamedTuple):
    """A number that reports summarise: its column in the frames, and where reports have it."""

    key: str
    label: str
    worse: int  # +1: more of it is worse; −1: less
    of: str  # run, life, visit, agent of a team, data of offline runs; score: 1 − it is compared
    digits: int = 2  # of its values in tables for people
    neutral: float = 0.0  # neither good nor bad
    training: bool = False  # of training: the same in all regions
    needs: str = ""  # the field of tasks without which runs have no such column


_VISITED = "regret on the visited phase"
_METRICS = (
    Metric("wd_regret", "WD regret", 1, "run agent score"),
    Metric("ood_regret", "OOD regret", 1, "run agent score"),
    Metric("ood_decay", "OOD decay", 1, "run", 3),
    Metric("final_return", "final return, % of optimum", -1, "run", 1, training=True),
    Metric("improvement", "improvement on the behaviour policy", -1, "data", 3),
    Metric("visited_regret", _VISITED, 1, "life"),
    Metric("normalised_regret", _VISITED, 1, "visit"),
    Metric("average_performance", "average performance", -1, "life visit"),
    Metric("backward_transfer", "backward transfer", -1, "life visit"),
    Metric("forgetting", "forgetting", 1, "life visit"),
    Metric("forward_transfer", "forward transfer", -1, "life"),
    Metric("relearning", "relearning", -1, "life"),
    Metric("plasticity_ratio", "plasticity ratio", 1, "life visit", neutral=1.0),
    Metric("plasticity_difference", "plasticity difference", 1, "life visit"),
    Metric("learning_transfer", "learning transfer", -1, "life visit", training=True),
    Metric("online_regret", "online regret", 1, "run agent life visit", 3, training=True),
    Metric(
        "frozen_online_regret", f"online regret, {LABELS['frozen_agent']}", 1, "life visit", 3,
        training=True,
    ),
    Metric("wd_cost", "WD cost", 1, "run", 3, needs="safety"),
    Metric("wd_safe_regret", "WD safe regret", 1, "run", needs="safety"),
    Metric("online_cost", "online cost", 1, "run", 3, training=True, needs="safety"),
    Metric(
        "distractor_regret", "regret with distractors outside their cube", 1, "run",
        needs="observation",
    ),
    Metric("wd_sensitivity", "WD sensitivity", 1, "run", needs="observation"),
)  # fmt: skip
METRICS = {metric.key: metric for metric in _METRICS}
"""Every metric of reports. A new one of runs is a property of their report, and a row here."""


def metrics_of(kind: str, columns: Collection[str] | None = None) -> tuple[Metric, ...]:
    """The metrics of runs, lives, …, or those of them that are among some columns."""
    known = (metric for metric in _METRICS if kind in metric.of.split())
    return tuple(metric for metric in known if columns is None or metric.key in columns)


WITHIN, OUTSIDE = "WD", "OOD"
ALL = "all classes"
SEVERAL = "several axes"
TASKS, SCHEDULE = "tasks", "schedule"  # axes of streams
AXES = tuple(
    name
    for field in Setting.model_fields
    if field not in ("schema_version", "team")
    for name in (*(f"{field}.{inner}" for inner in fields_of_block(field)), field)
)
"""Each field that studies vary, in the order of reports."""


@dataclass(frozen=True)
class ClassInfo:
    """A class of the plan, compared with the first one.

    `axis` is the field in which it differs, dotted within a team (`team.reward`) or an observation;
    "" for the first; `SEVERAL`. `policy_init` counts only if nothing else differs: deep tasks need
    another one. `setting` has every field; without safety its tightness is 0.
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
    return cards.axis(axis) if axis in AXES else axis


def is_numeric(values: Sequence[Any]) -> bool:
    return bool(values) and all(type(value) in (int, float) for value in values)


def setting_label(field: str, value: Any, *, with_symbol: bool = True) -> str:
    """`k = 25`, or `25` without the symbol of the field."""
    text = value
    if not isinstance(value, str):
        as_json = json.dumps(value, separators=(",", ":"), ensure_ascii=False)
        text = f"{value:g}" if is_numeric([value]) else as_json
    name = (field in AXES and symbol(field)) or field
    return f"{name} = {text}" if with_symbol else text


def _class_info(member: SuiteClass, first: SuiteClass) -> ClassInfo:
    setting, base = _setting(member), _setting(first)
    changed = [n for n in dict.fromkeys((*base, *setting)) if setting.get(n) != base.get(n)]
    differing = [name for name in changed if name.partition(".")[0] not in BLOCKS]
    for block in BLOCKS:
        within = [name for name in changed if name.startswith(f"{block}.")]
        both = getattr(member.setting, block) and getattr(first.setting, block)
        values = [of.get(name) for of in (setting, base) for name in within]
        is_axis = len(within) == 1 and (both or is_numeric(values)) and within != ["team.agents"]
        differing += within if is_axis else [block] * bool(within)
        setting[block] = _block_text(getattr(member.setting, block))
    if len(differing) > 1 and "policy_init" in differing:
        differing.remove("policy_init")
    axis = differing[0] if len(differing) == 1 else SEVERAL if differing else ""
    label = ", ".join(setting_label(name, setting[name]) for name in differing)
    return ClassInfo(member.name, axis, label, setting)


def _setting(member: SuiteClass) -> dict[str, Any]:
    """Every field, those of blocks by dotted names; numbers of a block that it lacks are 0."""
    setting: dict[str, Any] = {}
    for name, value in member.setting.every_field().items():
        if name not in BLOCKS:
            setting[name] = value
            continue
        fields = fields_of_block(name).items()
        numbers = (n for n, f in fields if number_type(f) and (f.is_required() or f.default == 0))
        values = dict.fromkeys(numbers, 0) if value is None else value
        setting |= {f"{name}.{inner}": part for inner, part in values.items()}
    return setting


def _block_text(block: TeamSpec | Document | None) -> str:
    """A block in words: `2 agents`, `32 driven nonlinear 1`."""
    if isinstance(block, TeamSpec):
        return f"{len(block.agents)} agents"
    values = {} if block is None else block.model_dump(exclude_defaults=True)
    return " ".join(str(value) for value in values.values()) or "none"


def learner_names(algorithms: Sequence[StudyAlgorithm]) -> dict[str, str]:
    """What each algorithm of a plan is apart from its ν: `IQL`, or `IQL (expectile = 0.9)`."""
    settings = {
        algorithm.name: {k: v for k, v in algorithm.hyperparameters.items() if k != "nu"}
        | ({} if algorithm.steps is None else {"steps": algorithm.steps})
        for algorithm in algorithms
    }
    names = {}
    for algorithm in algorithms:
        alike = [settings[other.name] for other in algorithms if other.uses == algorithm.uses]
        options = settings[algorithm.name]
        differing = [
            f"{key} = {options[key]}" if key in options else f"default {key}"
            for key in sorted({key for setting in alike for key in setting})
            if any(setting.get(key) != alike[0].get(key) for setting in alike)
        ]
        name = parse_uses(algorithm.uses)[1].upper()
        names[algorithm.name] = f"{name} ({', '.join(differing)})" if differing else name
    return names
