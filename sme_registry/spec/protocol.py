"""`EvaluationProtocol`: the states in which a policy is evaluated, as a hashed document.

METHOD, section 3: nested cubes X_ε = {s : ‖s − ½‖_∞ ≤ (1+ε)/2}; region 0 is the cube X_0 (WD),
region m the half-open shell X_{ε_m} \\ X_{ε_{m−1}} (OOD m); states uniform by volume in each.
"""

from __future__ import annotations

import itertools
import os
from typing import Annotated, Any, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from sme_registry.spec.document import Document, Integer, Real, SchemaVersion, short_repr


class EvaluationProtocol(Document):
    """How many states, in which regions, with which auxiliary inputs, from which seed.

    Attributes:
      states_per_region: states drawn in the cube, and in each shell around it.
      epsilons: outer ε of each shell, increasing: shell m is between the cubes ε_{m−1} and ε_m.
      sampling: how states are drawn: uniformly by volume in each region.
      time_input: the entry t/T of an observation: uniform over the steps of an episode.
      accumulated_reward_input: the entry r_cum/k of an observation: 0.
      seed: of the states and times.

    Examples:
      >>> from sme_registry import EvaluationProtocol
      >>> EvaluationProtocol(states_per_region=1000, epsilons=[0.5, 1.0]).edges
      ((0.0, 0.0), (0.0, 0.5), (0.5, 1.0))
    """

    schema_version: SchemaVersion = 1
    states_per_region: Annotated[Integer, Field(ge=2, le=10**8)] = 50_000
    epsilons: Annotated[
        tuple[Real, ...],
        Field(strict=False, min_length=1, max_length=1000),
    ] = (0.2, 0.4, 0.6, 0.8, 1.0)
    sampling: Literal["volume_uniform"] = "volume_uniform"
    time_input: Literal["uniform_over_steps"] = "uniform_over_steps"
    accumulated_reward_input: Literal["zero"] = "zero"
    seed: Annotated[Integer, Field(ge=0, lt=2**53)] = 0

    @model_validator(mode="after")
    def _shells_are_nested(self) -> Self:
        levels = (0.0, *self.epsilons)
        if any(outer <= inner for inner, outer in itertools.pairwise(levels)):
            raise ValueError(
                f"epsilons={short_repr(list(self.epsilons))}: must increase, from above 0. "
                "Sort them and remove repeats and zeros."
            )
        return self

    @property
    def edges(self) -> tuple[tuple[float, float], ...]:
        """`(ε_low, ε_high)` of each region, WD first: (0, 0), (0, ε_1), (ε_1, ε_2), …"""
        levels = (0.0, *self.epsilons)
        return ((0.0, 0.0), *itertools.pairwise(levels))


ProtocolLike: TypeAlias = EvaluationProtocol | dict[str, Any] | str | os.PathLike[str]
"""A protocol: itself, its fields, its name in the catalogue, or the path of its file."""
