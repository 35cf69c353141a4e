"""Classes of a plan, by the axis in which each differs from the first, and groups of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sme_registry.spec import StudyPlan, SuiteClass

ALL = "all classes"
SEVERAL = "several axes"
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


@dataclass(frozen=True)
class ClassInfo:
    """A class of the plan, compared with the first one.

    Attributes:
      name: in the plan.
      axis: the field in which it differs from the first class; "" for the first; `SEVERAL`.
        `policy_init` counts only if nothing else differs: deep tasks need another one.
      label: `k = 25`; for several axes each of them.
      setting: the value of every axis.
    """

    name: str
    axis: str
    label: str
    setting: Mapping[str, Any]


@dataclass(frozen=True)
class Group:
    """Classes that are compared with each other.

    Attributes:
      name: `ALL`, or the label of an axis.
      axis: the field; "" for all classes.
      classes: in the order of the axis' values, the plan's first class among them.
      compared: those where every algorithm has finished runs.
      left_out: the others that have any.
    """

    name: str
    axis: str
    classes: tuple[str, ...]
    compared: tuple[str, ...]
    left_out: tuple[str, ...]


def class_infos(plan: StudyPlan) -> dict[str, ClassInfo]:
    """Every class of the plan by its name."""
    return {member.name: _class_info(member, plan.classes[0]) for member in plan.classes}


def groups(
    classes: Mapping[str, ClassInfo], algorithms: Sequence[str], done: Collection[tuple[str, str]]
) -> tuple[Group, ...]:
    """All classes, then for each axis its classes together with the first one.

    `done` are the (class, algorithm) pairs with a finished run.
    """
    first, *others = classes.values()
    result = []
    for axis in ("", *AXES, SEVERAL):
        members = [first, *(c for c in others if axis in ("", c.axis))]
        if axis in AXES and axis != "policy_init":
            members.sort(key=lambda c: float(c.setting[axis]))
        present = [c.name for c in members if any((c.name, a) in done for a in algorithms)]
        compared = [name for name in present if all((name, a) in done for a in algorithms)]
        if present and (not axis or len(members) > 1):
            name = AXES[axis][1] if axis in AXES else axis or ALL
            left_out = [n for n in present if n not in compared]
            result.append(Group(name, axis, tuple(present), tuple(compared), tuple(left_out)))
    return tuple(result)


def setting_label(field: str, value: Any, *, with_symbol: bool = True) -> str:
    """`k = 25`, or `25` without the symbol of the field."""
    text = value if isinstance(value, str) else f"{value:g}"
    return f"{AXES[field][0]} = {text}" if with_symbol else text


def _class_info(member: SuiteClass, first: SuiteClass) -> ClassInfo:
    setting, base = member.setting.to_dict(), first.setting.to_dict()
    differing = [name for name in AXES if setting[name] != base[name]]
    if len(differing) > 1 and "policy_init" in differing:
        differing.remove("policy_init")
    axis = differing[0] if len(differing) == 1 else SEVERAL if differing else ""
    label = ", ".join(setting_label(name, setting[name]) for name in differing)
    return ClassInfo(member.name, axis, label, {name: setting[name] for name in AXES})
