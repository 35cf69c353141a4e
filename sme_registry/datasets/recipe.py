"""`DatasetRecipe`: all that a data set is generated from, as a hashed document.

On one machine the same recipe gives the same bits of every array. On another machine it gives the
same numbers as far as NumPy, SciPy and LAPACK agree, as for the tasks themselves.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sme_registry.errors import PolicyError, SpecError
from sme_registry.spec import (
    Digest,
    Document,
    EvaluationProtocol,
    Integer,
    Real,
    SchemaVersion,
    SMESpec,
    StrictModel,
    TupleOf,
)
from sme_registry.spec.document import plain_number, short_repr
from sme_registry.spec.sme_spec import Seed

_TOLERANCE = 1e-9  # of the sum of weights: ten times 0.1 is not 1 in floating point


class Behaviour(StrictModel):
    """A policy that collects part of a data set, and its share of the transitions.

    A mixture acts by a = (1 − α) π*(s) + α ã(s), with one α ~ U(0, ν) for each step and ã another
    DUN of the same shape as π*; ν = 0 is the optimum, 1 the worst. A random policy acts by
    a ~ U([0, 1]^A).

    Attributes:
      kind: a mixture of the optimum, a user's policy, or random actions.
      weight: its share of the transitions.
      nu: ν of a mixture, from the optimum (0) to the worst (1); null for the other kinds.
      policy: the name of a user's deterministic policy; null for the other kinds.
      sha256: digest of that policy's file; null for a function, which only its author can run.
      action_range: of that policy's actions, if it differs from the policy's own.
    """

    kind: Literal["mixture", "policy", "random"]
    weight: Annotated[Real, Field(gt=0, le=1)] = 1.0
    nu: Annotated[Real | None, Field(ge=0, le=1)] = None
    policy: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    sha256: Digest | None = None
    action_range: Literal["unit", "symmetric"] | None = None

    @model_validator(mode="after")
    def _fields_of_its_kind(self) -> Self:
        if (self.kind == "mixture") != (self.nu is not None):
            raise ValueError(
                f"nu={self.nu}: must be a number in [0, 1] for kind='mixture' and null otherwise, "
                f"and kind={self.kind!r}."
            )
        if (self.kind == "policy") != (self.policy is not None):
            raise ValueError(
                f"policy={self.policy!r}: must be a name for kind='policy' and null otherwise, "
                f"and kind={self.kind!r}."
            )
        if self.kind != "policy" and (self.sha256 is not None or self.action_range is not None):
            raise ValueError(
                "sha256, action_range: must be null unless kind='policy'. Leave them out."
            )
        return self

    @property
    def label(self) -> str:
        """Its label in tables: `ν = 0.5`, `random`, or the policy's name."""
        return f"ν = {self.nu:g}" if self.nu is not None else self.policy or self.kind


class DatasetRecipe(Document):
    """The task, behaviour policies, size, coverage and seed of a data set.

    With coverage ε it keeps only transitions from states in X_ε = {s : ‖s − ½‖_∞ ≤ (1 + ε)/2}; null
    keeps all, as 0 does. Starts, each α and ã have a named stream of the seed each.

    Attributes:
      spec: the task.
      behaviours: the policies that collect it, one after another; their weights add up to 1.
      transitions: N, rows of the data set.
      seed: of the data, not the task: an integer or, where nobody may guess it, hexadecimal text.
      coverage: ε of the sub-cube of states that are kept; null keeps all.
      protocol: of the evaluation of policies that learn from the data set.
    """

    schema_version: SchemaVersion = 1
    spec: SMESpec
    behaviours: Annotated[TupleOf[Behaviour], Field(min_length=1, max_length=64)]
    transitions: Annotated[Integer, Field(ge=1, le=10**9)] = 50_000
    seed: Seed = 0
    coverage: Annotated[Real | None, Field(gt=-1, le=0)] = None
    protocol: EvaluationProtocol = EvaluationProtocol()

    @model_validator(mode="after")
    def _weights_add_up(self) -> Self:
        total = math.fsum(behaviour.weight for behaviour in self.behaviours)
        if abs(total - 1.0) > _TOLERANCE:
            raise ValueError(
                f"weight: {' + '.join(f'{b.weight:g}' for b in self.behaviours)} = {total:.10g}: "
                "must add up to 1. Change one of the weights."
            )
        empty = next((i for i, share in enumerate(self.shares) if share == 0), None)
        if empty is not None:
            raise ValueError(
                f"weight={self.behaviours[empty].weight:g}: gives less than one of "
                f"{self.transitions} transitions. Use more transitions, or remove the behaviour."
            )
        return self

    @property
    def shares(self) -> tuple[int, ...]:
        weights = itertools.accumulate(behaviour.weight for behaviour in self.behaviours)
        boundaries = [0, *(round(self.transitions * min(w, 1.0)) for w in weights)]
        boundaries[-1] = self.transitions
        return tuple(high - low for low, high in itertools.pairwise(boundaries))

    @property
    def expected_similarity(self) -> float | None:
        """Mean r̃ for independent and uniform a* and ã; None if a policy is the user's.

        1 − ν/6 of a mixture, since E α = ν/2 and E |ã − a*| = 1/3; 1 − 1/3 of random actions.
        """
        if any(behaviour.kind == "policy" for behaviour in self.behaviours):
            return None
        return math.fsum(
            b.weight * (1.0 - (1.0 / 3.0 if b.nu is None else b.nu / 6.0)) for b in self.behaviours
        )

    def differences(self, other: DatasetRecipe) -> list[str]:
        return _differences("", self.to_dict(), other.to_dict())


def _differences(path: str, ours: Any, theirs: Any) -> list[str]:
    """The leaves in which two plain values differ, each with its path: `spec.complexity 1, …`."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        pairs = {name: (ours.get(name), theirs.get(name)) for name in {**ours, **theirs}}
    elif isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs):
        pairs = {str(index): pair for index, pair in enumerate(zip(ours, theirs, strict=True))}
    elif ours == theirs:
        return []
    elif isinstance(ours, list) and isinstance(theirs, list):
        return [f"{path} of {len(ours)} entries, requested {len(theirs)}"]
    else:
        return [f"{path} {short_repr(ours)}, requested {short_repr(theirs)}"]
    return [
        line
        for name, (left, right) in pairs.items()
        for line in _differences(f"{path}.{name}".lstrip("."), left, right)
    ]


def parse_behaviour(policy: Any, weight: float = 1.0, action_range: str | None = None) -> Behaviour:
    """The behaviour for a policy as `make_dataset` accepts it."""
    fields: dict[str, Any]
    if type(number := plain_number(policy)) in (int, float):
        fields = {"kind": "mixture", "nu": float(number)}
    elif isinstance(policy, str) and policy == "random":
        fields = {"kind": "random"}
    elif isinstance(policy, str | os.PathLike):
        path = Path(policy)
        fields = {"policy": path.stem, "sha256": policy_digest(path), "action_range": action_range}
    elif callable(policy) or hasattr(policy, "predict"):
        name = getattr(policy, "__name__", type(policy).__name__)
        name = "policy" if name == "<lambda>" else name
        fields = {"policy": name, "action_range": action_range}
    else:
        raise SpecError(
            f"behaviour={short_repr(policy)}: must be ν in [0, 1], 'random', a callable, a "
            "Stable-Baselines3 model, or the path of a .zip or .onnx file."
        )
    return Behaviour.from_dict({"kind": "policy", "weight": weight, **fields}, "behaviour")


def policy_digest(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return "sha256:" + hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise PolicyError(
            f"{path}: cannot be read: {reason}. Give the path of a saved model (.zip or .onnx)."
        ) from None
