"""Fit a plan to the time available: other budgets, fewer seeds, some of its cells.

Budgets are part of a cell's content, so a plan with another budget is another plan with its own
digest and name. The selection of the cells to run now is not: `selected` works on any plan.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase

from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.spec import PlannedCell, StudyFile, StudyPlan

_SUFFIX, _LONGEST_NAME = "-scaled", 64


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
    plain = file.plan.to_dict()
    if steps is not None:
        plain["steps"] = steps
    for algorithm in plain["algorithms"]:
        budget, name = algorithm["steps"], algorithm["name"]
        if name in steps_of:
            algorithm["steps"] = steps_of[name]
        elif steps is not None and budget != 0:  # 0: a reference, which does not train
            algorithm["steps"] = None
    if seeds is not None:
        plain["seeds"] = seeds
    if evaluations is not None:
        plain["evaluations"] = evaluations
    plan = StudyPlan.from_dict(plain, "the scaled plan")
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
    patterns: dict[str, list[str]] = {"class": [], "algorithm": []}
    names = {
        "class": sorted({cell.class_name for cell in cells}),
        "algorithm": sorted({cell.algorithm for cell in cells}),
    }
    for text in only:
        kind, equals, glob = text.partition("=")
        if not equals or kind not in patterns:
            raise OptionError(
                f"only={text!r}: must be class=GLOB or algorithm=GLOB, such as class='k-*'."
            )
        if not any(fnmatchcase(name, glob) for name in names[kind]):
            listed = ", ".join(names[kind][:12]) + (", …" if len(names[kind]) > 12 else "")
            raise UnknownNameError(
                f"only={text!r}: matches no {kind} of the plan.{did_you_mean(glob, names[kind])} "
                f"Available: {listed}."
            )
        patterns[kind].append(glob)

    def matches(kind: str, name: str) -> bool:
        return not patterns[kind] or any(fnmatchcase(name, glob) for glob in patterns[kind])

    return tuple(
        cell
        for cell in cells
        if matches("class", cell.class_name) and matches("algorithm", cell.algorithm)
    )
