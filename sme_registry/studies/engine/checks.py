"""Checks of a plan's algorithms before anything runs: that they exist, and their hyperparameters.

They check names, and no values. A package that is not installed here may be installed where the
plan runs, so its algorithms cannot be checked here: `MissingDependencyError`, or `OptionError` of
`find` for a module of someone else's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

from sme_registry.errors import SMEError
from sme_registry.spec import Cell, StudyAlgorithm, StudyPlan
from sme_registry.spec.study import in_jax
from sme_registry.training import algorithms, hyperparameters

__all__ = ["check_hyperparameters", "check_task", "find", "uneven_rollouts"]


def find(uses: str) -> None:
    """Check that an algorithm of any kind can be found."""
    algorithms.find(uses).check_installed()


def check_hyperparameters(algorithm: StudyAlgorithm) -> None:
    """Check that an algorithm of a plan has hyperparameters of these names."""
    field = f"algorithm {algorithm.name!r}: hyperparameters"
    hyperparameters.check_hyperparameters(algorithm.uses, algorithm.hyperparameters, field)


def check_task(cell: Cell) -> None:
    """Check that the algorithm of a cell has such tasks, where that depends on more than a team."""
    algorithms.find(cell.uses).check_task(cell.document)


class UnevenRollouts(NamedTuple):
    """An on-policy algorithm whose rollouts do not end where phases of streams do.

    Its policy at the end of a visit has learned from fewer steps than a fresh agent's, which counts
    as lost plasticity; `better` is the longest shorter rollout that ends where all phases do.
    """

    algorithm: str
    n_steps: int
    streams: tuple[str, ...]
    better: int


def uneven_rollouts(plan: StudyPlan) -> list[UnevenRollouts]:
    """The algorithms of a plan that can be found here and learn from such rollouts."""
    uneven = []
    for algorithm in plan.algorithms if plan.streams else ():
        try:
            n = _rollout_steps(algorithm)
        except SMEError:
            continue
        phases = {
            member.name: math.gcd(*(phase.steps for phase in member.stream.phases))
            for member in plan.streams
        }
        uneven_on = tuple(name for name, steps in phases.items() if steps % n)
        if uneven_on:
            together = math.gcd(*phases.values())
            better = max(m for m in range(1, min(n, together) + 1) if together % m == 0)
            uneven.append(UnevenRollouts(algorithm.name, n, uneven_on, better))
    return uneven


def _rollout_steps(algorithm: StudyAlgorithm) -> int:
    """Steps between two updates of an on-policy algorithm; 1 for any other."""
    uses, chosen = algorithm.uses, algorithm.hyperparameters
    if in_jax(uses):
        from sme_registry.jax.run import settings_of

        return int(getattr(settings_of(uses, chosen), "n_steps", 1))
    learner = algorithms.find(uses).load()
    if not algorithms.is_on_policy(learner):
        return 1
    parameter = hyperparameters.parameters_of(learner).get("n_steps")
    return 1 if parameter is None else int(cast(Any, chosen.get("n_steps", parameter.default)))
