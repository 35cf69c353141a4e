"""How long cells take, which of a plan run now, and plans with other budgets.

Budgets and algorithms are part of a cell's content, so a plan with others is another plan with its
own digest and name. The selection of the cells to run now is not: `selected` works on any plan.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from operator import attrgetter

from sme_registry.errors import OptionError, SMEError, UnknownNameError, did_you_mean
from sme_registry.io import choice
from sme_registry.spec import StudyAlgorithm, StudyFile, StudyPlan
from sme_registry.spec.study import Cell, PlannedCell
from sme_registry.studies.result import CellResult
from sme_registry.training.algorithms import backend_of, find, parse_uses, with_agents
from sme_registry.training.functions import source_of

# Seconds of one training step with default hyperparameters on a fast core.
SECONDS_PER_STEP = {
    "PPO": 0.0006,
    "A2C": 0.0006,
    "TD3": 0.012,
    "DDPG": 0.012,
    "SAC": 0.013,
    "jax:PPO": 0.00002,
    "jax:TD3": 0.006,
    "jax:SAC": 0.005,
    "offline:bc": 0.0015,
    "offline:iql": 0.006,
}
_OTHER = 0.012  # of an algorithm that is not in the table
_START = 2.0  # a process, its imports and the evaluations
_LONGEST_NAME = 64
_KINDS: dict[str, Callable[[PlannedCell], str]] = {
    "class": attrgetter("class_name"),
    "algorithm": attrgetter("algorithm"),
    "run": lambda cell: str(cell.run),
}


class Estimator:
    """Estimates the seconds of cells on one core: those of their steps, and of a start.

    Seconds of a step are from a table, of a fast core. Where cells of the algorithm have finished,
    the estimate is multiplied by the median ratio of their seconds to their estimates.
    """

    def __init__(self, finished: Iterable[CellResult] = ()) -> None:
        ratios = defaultdict(list)
        for result in finished:
            ratios[result.cell.uses].append(result.timing.total / _by_table(result.cell))
        self._ratios = {uses: statistics.median(of_cells) for uses, of_cells in ratios.items()}

    def seconds(self, cell: Cell) -> float:
        return _by_table(cell) * self._ratios.get(cell.uses, 1.0)


def _by_table(cell: Cell) -> float:
    kind, name = parse_uses(cell.uses)
    transitions = 0 if kind == "reference" else cell.steps * len(cell.spec.agents)
    step = SECONDS_PER_STEP.get(name if kind == "independent" else cell.uses, _OTHER)
    return _START + transitions * step


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
        choice("steps", name, known, error=UnknownNameError)
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


def in_implementation(file: StudyFile, agents: str) -> StudyFile:
    """The plan with the implementations of `agents`; references and offline learners stay."""
    fields = file.plan.to_dict()
    for algorithm in fields["algorithms"]:
        uses = algorithm["uses"]
        changed = with_agents(uses, agents)
        if changed != uses and backend_of(uses).learner:
            algorithm["uses"] = find(changed, f"algorithm {algorithm['name']!r}: uses").uses
    plan = StudyPlan.from_dict(fields, f"the plan with agents={agents}")
    return _renamed(file, plan, f"-{agents}")


def with_sources(file: StudyFile) -> StudyFile:
    """The plan with the digest of the source of each `train:…` that is here; imports none."""
    fields = file.plan.to_dict()
    for algorithm in fields["algorithms"]:
        name, stated = f"algorithm {algorithm['name']!r}", algorithm.get("source")
        try:
            source = source_of(algorithm["uses"])
        except OptionError:
            continue
        if source is None:
            continue
        if stated not in (None, source):
            raise OptionError(
                f"{name}: source={stated!r}: the source of the module is {source!r} now. Restore "
                "the module, or leave source out of the plan for new results."
            )
        algorithm["source"] = source
    plan = StudyPlan.from_dict(fields, "the plan")
    return file.model_copy(update={"plan": plan, "digest": plan.digest})


def _renamed(file: StudyFile, plan: StudyPlan, suffix: str) -> StudyFile:
    """The file with another plan, and a name that says so; the same file for the same plan."""
    if plan == file.plan:
        return file
    name = file.name.removesuffix(suffix)[: _LONGEST_NAME - len(suffix)] + suffix
    return file.model_copy(update={"name": name, "plan": plan, "digest": plan.digest})


def selected(cells: Iterable[PlannedCell], only: Sequence[str] = ()) -> tuple[PlannedCell, ...]:
    """The cells that match."""
    cells = tuple(cells)
    matching = defaultdict[str, set[str]](set)  # the names that the patterns of each kind match
    for text in only:
        kind, equals, glob = text.partition("=")
        if not equals or kind not in _KINDS:
            raise OptionError(
                f"only={text!r}: must be class=GLOB, algorithm=GLOB or run=GLOB, such as "
                "class='k-*'."
            )
        names = sorted({_KINDS[kind](cell) for cell in cells})
        matches = [name for name in names if fnmatchcase(name, glob)]
        if not matches:
            listed = ", ".join(names[:12]) + (", …" if len(names) > 12 else "")
            raise UnknownNameError(
                f"only={text!r}: matches no {kind} of the plan.{did_you_mean(glob, names)} "
                f"Available: {listed}."
            )
        matching[kind].update(matches)
    return tuple(
        cell
        for cell in cells
        if all(_KINDS[kind](cell) in names for kind, names in matching.items())
    )


def uneven_rollouts(plan: StudyPlan) -> list[str]:
    """What to change where the rollouts of an on-policy algorithm do not end where phases do."""
    phases = {
        member.name: math.gcd(*(phase.steps for phase in member.stream.phases))
        for member in plan.streams
    }
    warnings = []
    for algorithm in plan.algorithms if phases else ():
        n = _rollout_steps(algorithm)
        uneven = [name for name, steps in phases.items() if steps % n]
        if uneven:
            together = math.gcd(*phases.values())
            better = max(m for m in range(1, min(n, together) + 1) if together % m == 0)
            warnings.append(
                f"{algorithm.name} on {', '.join(uneven)}: its rollouts of {n:,} steps do not end "
                "where phases do. At the end of a visit it has learned from fewer steps than a "
                "fresh agent, which raises its plasticity ratio. Use "
                f"--set {algorithm.name}.n_steps={better}, and a batch_size that divides it."
            )
    return warnings


def _rollout_steps(algorithm: StudyAlgorithm) -> int:
    """Steps between two updates of an on-policy algorithm; 1 for any other, or one not here."""
    try:
        fields = find(algorithm.uses).settings().model_fields
    except SMEError:
        return 1
    steps = algorithm.hyperparameters.get("n_steps", getattr(fields.get("n_steps"), "default", 1))
    return steps if "gae_lambda" in fields and isinstance(steps, int) else 1
