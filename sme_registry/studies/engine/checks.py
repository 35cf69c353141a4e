"""Checks of a plan's algorithms before anything runs: that they exist, and their hyperparameters.

They check names, and no values. A package that is not installed here may be installed where the
plan runs, so its algorithms cannot be checked here: `MissingDependencyError`, or `OptionError` of
`find` for a module of someone else's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

from sme_registry.datasets.offline import check_algorithm
from sme_registry.errors import OptionError, SMEError, SpecError
from sme_registry.spec import Cell, StudyAlgorithm, StudyPlan
from sme_registry.spec.study import in_jax
from sme_registry.studies.engine.algorithms import find_algorithm, independent_name, reference_name
from sme_registry.studies.engine.offline_cell import DATA_SETTINGS, offline_name
from sme_registry.training import ALGORITHMS
from sme_registry.training.algorithms import check_limits, is_on_policy, require_sb3
from sme_registry.training.hyperparameters import parameters_of, refuse_unknown

__all__ = ["check_hyperparameters", "check_task", "find", "uneven_rollouts"]


def find(uses: str) -> None:
    """Check that an algorithm of any kind can be found."""
    if reference_name(uses) is not None or offline_name(uses) is not None:
        return
    if in_jax(uses):
        from sme_registry.jax.run import full_name

        full_name(uses)
        return
    independent = independent_name(uses)
    if (independent or uses).casefold() in (name.casefold() for name in ALGORITHMS):
        require_sb3()  # importing them takes seconds
    else:
        find_algorithm(uses)
    if independent is not None:
        _check_independent(uses)


def check_hyperparameters(algorithm: StudyAlgorithm) -> None:
    """Check that an algorithm of a plan has hyperparameters of these names."""
    uses, chosen = algorithm.uses, algorithm.hyperparameters
    if not chosen:
        return
    field = f"algorithm {algorithm.name!r}: hyperparameters"
    learner = offline_name(uses)
    if reference_name(uses) is not None:
        refuse_of_reference(uses, chosen)
    elif in_jax(uses):
        from sme_registry.jax.run import settings_of

        settings_of(uses, chosen, field)
    elif learner is not None:
        own = {name: value for name, value in chosen.items() if name not in DATA_SETTINGS}
        check_algorithm(learner, own)
    else:
        refuse_unknown(find_algorithm(uses), uses, chosen, field)


def check_task(cell: Cell) -> None:
    """Check that the algorithm of a cell has such tasks, where that depends on more than a team."""
    check_limits(cell.uses, cell.document)
    if not in_jax(cell.uses):
        return
    from sme_registry.jax.task import check_supported

    if cell.stream is None:
        check_supported(cell.spec)
        return
    from sme_registry.jax.lives import check_switches

    for index, phase in enumerate(cell.stream.phases):
        try:
            check_supported(phase.spec)
        except SpecError as error:
            raise SpecError(f"phases.{index}.spec: {error}") from None
    check_switches(cell.stream)


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
    learner = find_algorithm(uses)
    if not is_on_policy(learner):
        return 1
    parameter = parameters_of(learner).get("n_steps")
    return 1 if parameter is None else int(cast(Any, chosen.get("n_steps", parameter.default)))


def refuse_of_reference(uses: str, hyperparameters: Mapping[str, Any]) -> None:
    """Raise OptionError if a reference policy is given hyperparameters."""
    if hyperparameters:
        raise OptionError(
            f"hyperparameters={sorted(hyperparameters)}: {uses} has no hyperparameters. Leave them "
            "out."
        )


def _check_independent(uses: str) -> None:
    if not is_on_policy(find_algorithm(uses)):
        raise OptionError(
            f"uses={uses!r}: must be an on-policy algorithm, such as independent:PPO, because the "
            "models of a team learn from the same rollouts. Use one model for all agents instead: "
            f"{independent_name(uses)}."
        )
