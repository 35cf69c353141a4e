"""Fit a plan to the time available: other budgets, fewer seeds, some of its cells.

Budgets are part of a cell's content, so a plan with another budget is another plan with its own
digest and name. The selection of the cells to run now is not: `selected` works on any plan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase

from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.spec import PlannedCell, StudyFile, StudyPlan

_SUFFIX, _LONGEST_NAME = "-scaled", 64
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
    """The plan with other budgets; None keeps the plan's.

    Args:
      file: the plan.
      steps: of every algorithm that trains, including those with a budget of their own.
      steps_of: of single algorithms, by name; overrides `steps`.
      seeds: runs of each algorithm on each class.
      evaluations: during training.

    Returns:
      The same file if nothing changes, otherwise one named `<name>-scaled`.

    Raises:
      UnknownNameError: the plan has no algorithm of a name in `steps_of`.
      SpecError: a number is outside its range.
    """
    steps_of = dict(steps_of or {})
    known = [algorithm.name for algorithm in file.plan.algorithms]
    for name in steps_of:
        if name not in known:
            raise UnknownNameError(
                f"steps={name}={steps_of[name]}: the plan has no such algorithm."
                f"{did_you_mean(name, known)} Its algorithms: {', '.join(known)}."
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
    if plan == file.plan:
        return file
    name = file.name.removesuffix(_SUFFIX)[: _LONGEST_NAME - len(_SUFFIX)] + _SUFFIX
    return file.model_copy(update={"name": name, "plan": plan, "digest": plan.digest})


def selected(cells: Iterable[PlannedCell], only: Sequence[str] = ()) -> tuple[PlannedCell, ...]:
    """The cells that match.

    Args:
      cells: of a plan.
      only: patterns `class=GLOB` and `algorithm=GLOB`. A cell must match any of the patterns of
        each kind that is given. No pattern selects every cell.

    Raises:
      OptionError: a pattern has another form.
      UnknownNameError: a pattern matches nothing.
    """
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
