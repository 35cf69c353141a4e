"""How long cells take, which of a plan run now, and plans with other budgets.

A cell takes, in seconds of one core, with P its steps (times the agents of a team), E its
evaluations, T the horizon, N the states of its evaluation in and out of distribution, L the layers
of the optimal policy:

    start + P · step + E · T · batch step + N · (state + layer · (L − 1))

A life in a stream takes the last term for each of its tasks. `step` is the algorithm's, all others
are the same; the ten runs of a program of JAX share the start and the evaluations. Where cells of
the algorithm have finished, the sum after `start` is multiplied by the median ratio of their
measured to their estimated seconds.

Budgets and algorithms are part of a cell's content, so a plan with others is another plan with its
own digest and name. The selection of the cells to run now is not: `selected` works on any plan.
"""

from __future__ import annotations

import heapq
import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, cast

from sme_registry.errors import OptionError, SMEError, UnknownNameError, did_you_mean
from sme_registry.io import choice
from sme_registry.spec import StudyAlgorithm, StudyFile, StudyPlan
from sme_registry.spec.study import JAX, Cell, PlannedCell, in_jax, parse_uses
from sme_registry.studies.engine.result import CellResult
from sme_registry.training.algorithms import (
    AGENTS,
    find,
    is_on_policy,
    parameters_of,
    source_of,
)

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
_FASTEST, _SLOWEST = SECONDS_PER_STEP["PPO"], SECONDS_PER_STEP["SAC"]  # of any other algorithm
_START = 1.5  # a process and its imports
_BATCH_STEP = 6e-5  # one step of all episodes of an evaluation, which run as a batch
_STATE, _LAYER = 1.5e-6, 1e-6  # a state, and a layer of π* in it
_RUNS_IN_JAX = 10
_SLOW_CORE = 2.0  # times the seconds of a fast one
_LONGEST_NAME = 64
_KINDS: dict[str, Callable[[PlannedCell], str]] = {
    "class": lambda planned: planned.class_name,
    "algorithm": lambda planned: planned.algorithm,
}


class Span(NamedTuple):
    """Bounds in seconds, of a fast core and a slow one; equal if they come from finished cells."""

    low: float
    high: float


class Estimator:
    """Estimates the seconds of cells on one core, from those that have finished."""

    def __init__(self, finished: Iterable[CellResult] = ()) -> None:
        ratios = defaultdict(list)
        for result in finished:
            expected = _work(result.cell, _FASTEST)
            if expected > 0:
                ratios[result.cell.uses].append(result.timing.total / expected)
        self._ratios = {uses: statistics.median(of_cells) for uses, of_cells in ratios.items()}

    def knows(self, cell: Cell) -> bool:
        """Whether a cell of the same algorithm has finished."""
        return cell.uses in self._ratios

    def seconds(self, cell: Cell) -> Span:
        start = _START / _RUNS_IN_JAX if in_jax(cell.uses) else _START
        low, high = _work(cell, _FASTEST), _SLOW_CORE * _work(cell, _SLOWEST)
        if cell.uses in self._ratios:
            low = high = low * self._ratios[cell.uses]
        return Span(start + low, start + high)


def _work(cell: Cell, otherwise: float) -> float:
    """A cell's seconds by the table without its start; `otherwise` is an unknown step's."""
    kind, name = parse_uses(cell.uses)
    agents = 1 if cell.spec.team is None else len(cell.spec.team.agents)
    transitions = 0 if kind == "reference" else cell.steps * agents
    step = SECONDS_PER_STEP.get(name if kind == "independent" else cell.uses, otherwise)
    curve = cell.evaluations * cell.spec.horizon * _BATCH_STEP
    states = cell.protocol.states_per_region * len(cell.protocol.edges)
    report = sum(_STATE + _LAYER * (spec.complexity - 1) for spec in cell.specs) * states
    return transitions * step + curve / (_RUNS_IN_JAX if kind == "jax" else 1) + report


def makespan(seconds: Sequence[float], workers: int) -> float:
    """Seconds to the end of jobs that are started in order, each by the first free worker."""
    free = [0.0] * min(workers, len(seconds))
    for job in seconds:
        heapq.heapreplace(free, free[0] + job)
    return max(free, default=0.0)


class _Reported(NamedTuple):
    """When a job reported first and last, and what shares of its steps it had done."""

    cells: Sequence[Cell]
    since: float
    before: float
    now: float
    share: float


class Pace:
    """How long all of a study takes, by the seconds that its work so far took."""

    def __init__(
        self, finished: Iterable[CellResult], one_at_a_time: Callable[[Cell], bool]
    ) -> None:
        self._estimator, self._one_at_a_time = Estimator(finished), one_at_a_time
        self._reported: dict[str, _Reported] = {}  # by a job's first cell

    def report(self, cells: Sequence[Cell], share: float) -> None:
        key, now = cells[0].digest, time.monotonic()
        first = self._reported.get(key, _Reported(cells, now, share, now, share))
        self._reported[key] = first._replace(now=now, share=share)

    def seconds_left(self, jobs: Iterable[Sequence[Cell]], workers: int) -> float:
        """Seconds to the end of the cells of running jobs and of those that wait."""
        jobs_so_far = self._reported.values()
        took = sum(job.now - job.since for job in jobs_so_far)
        estimated = sum((job.share - job.before) * self._work(job.cells) for job in jobs_so_far)
        pace = took / estimated if estimated else 1.0
        seconds: dict[bool, list[float]] = {True: [], False: []}  # one at a time; others
        for cells in jobs:
            reported = self._reported.get(cells[0].digest)
            left = 1.0 if reported is None else 1.0 - reported.share
            seconds[self._one_at_a_time(cells[0])].append(pace * left * self._work(cells))
        return max(sum(seconds[True]), makespan(seconds[False], workers))

    def _work(self, cells: Sequence[Cell]) -> float:
        """Seconds of cells as estimated, between a fast core and a slow one."""
        return sum(sum(self._estimator.seconds(cell)) / 2 for cell in cells)


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
        kind, name = parse_uses(uses)
        if agents == "sb3":
            algorithm["uses"] = name if kind == "jax" else uses
        elif kind not in ("reference", "offline"):
            field = f"algorithm {algorithm['name']!r}: uses"
            algorithm["uses"] = find(uses if kind == "jax" else f"{JAX}{uses}", field).uses
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


def first_places(cells: Iterable[PlannedCell]) -> dict[str, PlannedCell]:
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


def uneven_rollouts(plan: StudyPlan) -> list[str]:
    """What to change where the rollouts of an on-policy algorithm do not end where phases do."""
    warnings = []
    for algorithm in plan.algorithms if plan.streams else ():
        try:
            n = _rollout_steps(algorithm)
        except SMEError:  # it cannot be found here
            continue
        phases = {
            member.name: math.gcd(*(phase.steps for phase in member.stream.phases))
            for member in plan.streams
        }
        uneven = [name for name, steps in phases.items() if steps % n]
        if uneven:
            together = math.gcd(*phases.values())
            better = max(m for m in range(1, min(n, together) + 1) if together % m == 0)
            warnings.append(
                f"{algorithm.name} on {', '.join(uneven)}: its rollouts of {n:,} steps do not end "
                "where phases do. At the end of a visit it has learned from fewer steps than a "
                "fresh agent, which counts as lost plasticity. Use "
                f"--set {algorithm.name}.n_steps={better}, and a batch_size that divides it."
            )
    return warnings


def _rollout_steps(algorithm: StudyAlgorithm) -> int:
    """Steps between two updates of an on-policy algorithm; 1 for any other."""
    uses, chosen = algorithm.uses, algorithm.hyperparameters
    if in_jax(uses):
        from sme_registry.jax.run import settings_of

        return int(getattr(settings_of(uses, chosen), "n_steps", 1))
    learner = find(uses).load()
    if not is_on_policy(learner):
        return 1
    parameter = parameters_of(learner).get("n_steps")
    return 1 if parameter is None else int(cast(Any, chosen.get("n_steps", parameter.default)))
