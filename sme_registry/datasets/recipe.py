"""`DatasetRecipe`: all that a data set is made from, as a hashed document.

The same recipe gives the same bits of every array on one machine (and, like the tasks themselves,
the same numbers elsewhere as far as NumPy, SciPy and LAPACK agree).
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
    explained,
)
from sme_registry.spec.document import plain_number, show

_ADD_UP = 1e-9  # how far weights may be from 1: ten of 0.1 are not 1 in floating point


class Behaviour(StrictModel):
    """One of the policies that act in a set, and its share of the transitions.

    Attributes:
      kind: "mixture": a = (1 − α) π*(s) + α ã(s), α ~ U(0, ν) anew at each step, ã another DUN of
        the shape of π*; "policy": one of the user's, deterministic; "random": a ~ U([0, 1]^A).
      weight: its share, in (0, 1].
      nu: ν of a mixture: 0 is the optimum, 1 the worst.
      policy: what a policy is called.
      sha256: of a policy's file; null for a function, which only its author can run again.
      action_range: of a policy's actions, where it is not the policy's own.
    """

    kind: Literal["mixture", "policy", "random"]
    weight: Annotated[Real, Field(gt=0, le=1, description="share of the transitions")] = 1.0
    nu: Annotated[Real | None, Field(ge=0, le=1, description="ν of a mixture")] = None
    policy: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    sha256: Digest | None = None
    action_range: Literal["unit", "symmetric"] | None = None

    @model_validator(mode="after")
    def _fields_of_its_kind(self) -> Self:
        if (self.kind == "mixture") != (self.nu is not None):
            raise explained(
                f"nu={self.nu}: must be a number in [0, 1] for a mixture and null for any other "
                f"kind, and this is {self.kind!r}."
            )
        if (self.kind == "policy") != (self.policy is not None):
            raise explained(
                f"policy={self.policy!r}: must be a name for a policy and null for any other "
                f"kind, and this is {self.kind!r}."
            )
        if self.kind != "policy" and (self.sha256 is not None or self.action_range is not None):
            raise explained(
                "sha256, action_range: must be null unless kind='policy'. Leave them out."
            )
        return self

    @property
    def label(self) -> str:
        """What a table calls it: `ν = 0.5`, `random`, or the policy's name."""
        return f"ν = {self.nu:g}" if self.nu is not None else self.policy or self.kind


class DatasetRecipe(Document):
    """A task, who acts in it, how much of it is kept, and from which seed.

    Attributes:
      spec: the task.
      behaviours: who acts; their weights add up to 1. Whole episodes each, in this order.
      transitions: N, exactly so many.
      seed: of the starts, of each α and of ã, each a named stream of it.
      coverage: ε: only transitions acted in X_ε = {s : ‖s − ½‖_∞ ≤ (1 + ε)/2} are kept; null keeps
        all, as 0 does.
      protocol: where policies that learn from the set are to be judged.
    """

    schema_version: SchemaVersion = 1
    spec: SMESpec
    behaviours: Annotated[tuple[Behaviour, ...], Field(strict=False, min_length=1, max_length=64)]
    transitions: Annotated[Integer, Field(ge=1, le=10**9, description="N, rows of the set")] = (
        50_000
    )
    seed: Annotated[Integer, Field(ge=0, lt=2**53, description="of the data, not the task")] = 0
    coverage: Annotated[Real | None, Field(gt=-1, le=0, description="ε of the sub-cube")] = None
    protocol: EvaluationProtocol = EvaluationProtocol()

    @model_validator(mode="after")
    def _weights_add_up(self) -> Self:
        total = math.fsum(behaviour.weight for behaviour in self.behaviours)
        if abs(total - 1.0) > _ADD_UP:
            raise explained(
                f"weight: {' + '.join(f'{b.weight:g}' for b in self.behaviours)} = {total:.10g}: "
                "must add up to 1. Change one of the weights."
            )
        empty = next((i for i, share in enumerate(self.shares) if share == 0), None)
        if empty is not None:
            raise explained(
                f"weight={self.behaviours[empty].weight:g}: is less than one of "
                f"{self.transitions} transitions. Ask for more transitions, or leave it out."
            )
        return self

    @property
    def shares(self) -> tuple[int, ...]:
        """How many transitions each behaviour gives; they add up to N.

        Each border between two behaviours is rounded, so no share is off by more than one.
        """
        weights = itertools.accumulate(behaviour.weight for behaviour in self.behaviours)
        borders = [0, *(round(self.transitions * min(w, 1.0)) for w in weights)]
        borders[-1] = self.transitions
        return tuple(high - low for low, high in itertools.pairwise(borders))

    @property
    def expected_similarity(self) -> float | None:
        """Mean r̃ where a* and ã are independent and uniform; None where a policy is the user's.

        A mixture of ν has 1 − ν/6, since E α = ν/2 and E |ã − a*| = 1/3; uniformly random actions
        have 1 − 1/3, since a* is uniform.
        """
        if any(behaviour.kind == "policy" for behaviour in self.behaviours):
            return None
        return math.fsum(
            b.weight * (1.0 - (1.0 / 3.0 if b.nu is None else b.nu / 6.0)) for b in self.behaviours
        )

    def differences(self, asked: DatasetRecipe) -> list[str]:
        """The fields in which another recipe differs: `transitions 100, asked for 200`."""
        return _differences("", self.to_dict(), asked.to_dict())


def _differences(path: str, own: Any, asked: Any) -> list[str]:
    """The leaves in which plain data differ, each by its whole path: `spec.complexity 1, …`."""
    if isinstance(own, dict) and isinstance(asked, dict):
        pairs = {name: (own.get(name), asked.get(name)) for name in {**own, **asked}}
    elif isinstance(own, list) and isinstance(asked, list) and len(own) == len(asked):
        pairs = {str(index): pair for index, pair in enumerate(zip(own, asked, strict=True))}
    elif own == asked:
        return []
    elif isinstance(own, list) and isinstance(asked, list):
        return [f"{path} of {len(own)} entries, asked for {len(asked)}"]
    else:
        return [f"{path} {show(own)}, asked for {show(asked)}"]
    return [
        line
        for name, (left, right) in pairs.items()
        for line in _differences(f"{path}.{name}".lstrip("."), left, right)
    ]


def behaviour_of(what: Any, weight: float = 1.0, action_range: str | None = None) -> Behaviour:
    """A behaviour given as a person writes it.

    Args:
      what: ν as a number; "random"; or a policy: a callable, a model, or the path of a .zip
        or an .onnx.
      weight: its share.
      action_range: of a policy's actions; None for its own.

    Raises:
      SpecError: ν or the weight is outside its range.
      PolicyError: there is no such file.
    """
    number = plain_number(what)
    fields: dict[str, Any] = {"weight": weight}
    if isinstance(number, int | float) and not isinstance(number, bool):
        fields |= {"kind": "mixture", "nu": float(number)}
    elif isinstance(what, str) and what == "random":
        fields |= {"kind": "random"}
    elif isinstance(what, str | os.PathLike):
        path = Path(what)
        fields |= {"kind": "policy", "policy": path.stem, "sha256": sha256_of(path)}
    elif callable(what) or hasattr(what, "predict"):
        name = getattr(what, "__name__", type(what).__name__)
        name = "policy" if name == "<lambda>" else name
        fields |= {"kind": "policy", "policy": name}
    else:
        raise SpecError(
            f"behaviour={show(what)}: must be ν in [0, 1], 'random', or a policy: a callable, "
            "a Stable-Baselines3 model, or the path of its .zip or of an .onnx."
        )
    if fields["kind"] == "policy":
        fields["action_range"] = action_range
    return Behaviour.from_dict(fields, "behaviour")


def sha256_of(path: Path) -> str:
    """The digest of a file.

    Raises:
      PolicyError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return "sha256:" + hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise PolicyError(
            f"{path}: cannot be read: {reason}. Give the path of a saved model (.zip or .onnx)."
        ) from None
