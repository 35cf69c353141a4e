"""Fit a plan to the time available: other budgets, fewer seeds, agents in JAX, some of its cells.

Budgets and algorithms are part of a cell's content, so a plan with others is another plan with its
own digest and name. The selection of the cells to run now is not: `selected` works on any plan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase

from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.io import choice
from sme_registry.spec import PlannedCell, StudyFile, StudyPlan
from sme_registry.spec.study import JAX, OFFLINE, REFERENCE
from sme_registry.training.algorithms import AGENTS

_LONGEST_NAME = 64
_KINDS: dict[str, Callable[[PlannedCell], str]] = {
    "class": lambda planned: planned.class_name,
    "algorithm": lambda planned: planned.algorithm,
}


def scaled(
    file: StudyFile,
    *,
    steps: int | None = None,
    steps_of: Mapping[str, int] | None = None,
    seeds: int | None = None,
    evaluations: int | None = None,
) -> StudyFile:
    """The plan with other budgets; None keeps the plan's."""
    steps_of = dict(steps_of or {})
    known = [algorithm.name for algorithm in file.plan.algorithms]
    for name in steps_of:
        if name not in known:
            raise UnknownNameError(
                f"steps={name}={steps_of[name]}: the plan has no such algorithm."
                f"{did_you_mean(name, known)} Its algorithms: {', '.join(known)}."
            )
    if (steps is not None or steps_of) and not file.plan.classes:
        raise OptionError(
            f"steps={steps or dict(steps_of)}: lives have the steps of their streams, and the plan "
            "has no single tasks. Make streams with other steps, or leave it out."
        )
    budgets = {"steps": steps, "seeds": seeds, "evaluations": evaluations}
    fields = file.plan.to_dict() | {k: v for k, v in budgets.items() if v is not None}
    for algorithm in fields["algorithms"]:
        budget, name = algorithm["steps"], algorithm["name"]
        if name in steps_of:
            algorithm["steps"] = steps_of[name]
        elif steps is not None and budget != 0:  # 0: a reference, which does not train
            algorithm["steps"] = None
    plan = StudyPlan.from_dict(fields, "the scaled plan")
    return _renamed(file, plan, "-scaled")


def with_agents(file: StudyFile, agents: str) -> StudyFile:
    """The plan with other implementations of its algorithms."""
    choice("agents", agents, AGENTS)
    fields = file.plan.to_dict()
    for algorithm in fields["algorithms"]:
        uses = algorithm["uses"]
        if agents == "sb3":
            algorithm["uses"] = uses.removeprefix(JAX)
        elif not uses.startswith((REFERENCE, OFFLINE)):
            from sme_registry.jax.run import full_name

            algorithm["uses"] = full_name(uses, f"algorithm {algorithm['name']!r}: uses")
    plan = StudyPlan.from_dict(fields, f"the plan with agents={agents}")
    return _renamed(file, plan, f"-{agents}")


def _renamed(file: StudyFile, plan: StudyPlan, suffix: str) -> StudyFile:
    """The file with another plan, and a name that says so; the same file for the same plan."""
    if plan == file.plan:
        return file
    name = file.name.removesuffix(suffix)[: _LONGEST_NAME - len(suffix)] + suffix
    return file.model_copy(update={"name": name, "plan": plan, "digest": plan.digest})


def first_places(cells: Iterable[PlannedCell]) -> dict[str, PlannedCell]:
    """Each cell once, by its digest, in its first place in the plan."""
    places: dict[str, PlannedCell] = {}
    for planned in cells:
        places.setdefault(planned.cell.digest, planned)
    return places


def selected(cells: Iterable[PlannedCell], only: Sequence[str] = ()) -> tuple[PlannedCell, ...]:
    """The cells that match."""
    cells = tuple(cells)
    matching: dict[str, set[str]] = {}  # the names that the patterns of each kind match
    for text in only:
        kind, equals, glob = text.partition("=")
        if not equals or kind not in _KINDS:
            raise OptionError(
                f"only={text!r}: must be class=GLOB or algorithm=GLOB, such as class='k-*'."
            )
        names = sorted({_KINDS[kind](cell) for cell in cells})
        matches = [name for name in names if fnmatchcase(name, glob)]
        if not matches:
            listed = ", ".join(names[:12]) + (", …" if len(names) > 12 else "")
            raise UnknownNameError(
                f"only={text!r}: matches no {kind} of the plan.{did_you_mean(glob, names)} "
                f"Available: {listed}."
            )
        matching.setdefault(kind, set()).update(matches)
    return tuple(
        cell
        for cell in cells
        if all(_KINDS[kind](cell) in names for kind, names in matching.items())
    )
