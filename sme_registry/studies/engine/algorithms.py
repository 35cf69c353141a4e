"""`uses` in a study: an algorithm (`training.algorithms`), or a policy that learns nothing.

    reference:constant, …   a reference policy
    independent:PPO         an algorithm with one model for each agent of a team
    jax:PPO                 an algorithm of `sme_registry.jax`, in a program with its environment

A learner gets a `VecEnv` of one environment. The cell counts its steps and evaluates the learner
through `predict` whenever an evaluation is due, so a learner needs no callbacks.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sme_registry.errors import UnknownNameError, did_you_mean
from sme_registry.evaluation.references import POLICIES
from sme_registry.spec.study import INDEPENDENT, REFERENCE
from sme_registry.training import algorithms


def reference_name(uses: str) -> str | None:
    """The policy that `reference:…` names, as `named_after` reads it."""
    return named_after(REFERENCE, uses, POLICIES)


def independent_name(uses: str) -> str | None:
    """The algorithm of `independent:…`: each agent of a team learns with a model of its own."""
    return uses.removeprefix(INDEPENDENT) if uses.startswith(INDEPENDENT) else None


def named_after(prefix: str, uses: str, known: Collection[str]) -> str | None:
    """The name after a prefix; None if `uses` does not begin with it."""
    if not uses.startswith(prefix):
        return None
    name = uses.removeprefix(prefix)
    if name not in known:
        raise UnknownNameError(
            f"uses={uses!r}: must be one of {', '.join(prefix + each for each in known)}."
            f"{did_you_mean(name, known)}"
        )
    return name


def find_algorithm(uses: str) -> Any:
    """The class or function that creates a learner, which is no reference."""
    uses = independent_name(uses) or uses
    return algorithms.find_algorithm(uses, others=[REFERENCE + policy for policy in POLICIES])
