"""The documents of data sets and offline training: what they are made from, and what they leave.

On one machine the same recipe gives the same bits of every array. On another machine it gives the
same numbers as far as NumPy, SciPy and LAPACK agree, as for the tasks themselves.

Default hyperparameters are those of d3rlpy's BC and of IQL's paper (see `learners`), which also
decays the actor's learning rate; neither d3rlpy nor this package does.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sme_registry.errors import PolicyError, SpecError, UnknownNameError
from sme_registry.io import choice, sha256_of
from sme_registry.io.files import reason_of
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.spec.blocks import Seed
from sme_registry.spec.document import (
    Digest,
    DigestedFile,
    Document,
    Integer,
    Real,
    SchemaVersion,
    StrictModel,
    TupleOf,
    check_digest,
    plain_number,
    short_repr,
)

KEY = "sme"  # of the record in Minari's metadata
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
        return f"ν = {self.nu:g}" if self.nu is not None else self.policy or self.kind


class DatasetRecipe(Document):
    """The task, behaviour policies, size, coverage and seed of a data set.

    Starts, each α and ã have a named stream of the seed each.

    Attributes:
      spec: the task.
      behaviours: the policies that collect it, one after another; their weights add up to 1.
      transitions: N, rows of the data set.
      seed: of the data, not the task: an integer or, where nobody may guess it, hexadecimal text.
      coverage: ε of the sub-cube {s : ‖s − ½‖_∞ ≤ (1 + ε)/2} of states that are kept; null keeps
        all, as 0 does.
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
        for behaviour, share in zip(self.behaviours, self.shares, strict=True):
            if share == 0:
                raise ValueError(
                    f"weight={behaviour.weight:g}: gives less than one of {self.transitions} "
                    "transitions. Use more transitions, or remove the behaviour."
                )
        return self

    @property
    def shares(self) -> tuple[int, ...]:
        weights = itertools.accumulate(behaviour.weight for behaviour in self.behaviours)
        boundaries = [0, *(round(self.transitions * min(w, 1.0)) for w in weights)]
        boundaries[-1] = self.transitions
        return tuple(high - low for low, high in itertools.pairwise(boundaries))


def parse_behaviour(policy: Any, weight: float = 1.0, action_range: str | None = None) -> Behaviour:
    """The behaviour for a policy as `make_dataset` accepts it."""
    fields: dict[str, Any] = {"kind": "policy", "weight": weight, "action_range": action_range}
    if type(number := plain_number(policy)) in (int, float):
        fields = {"kind": "mixture", "weight": weight, "nu": float(number)}
    elif isinstance(policy, str) and policy == "random":
        fields = {"kind": "random", "weight": weight}
    elif isinstance(policy, str | os.PathLike):
        try:
            fields |= {"policy": Path(policy).stem, "sha256": sha256_of(Path(policy).read_bytes())}
        except (OSError, ValueError) as error:
            raise PolicyError(
                f"{policy}: cannot be read: {reason_of(error)}. Give the path of a saved model "
                "(.zip or .onnx)."
            ) from None
    elif callable(policy) or hasattr(policy, "predict"):
        name = getattr(policy, "__name__", type(policy).__name__)
        fields["policy"] = "policy" if name == "<lambda>" else name
    else:
        raise SpecError(
            f"behaviour={short_repr(policy)}: must be ν in [0, 1], 'random', a callable, a "
            "Stable-Baselines3 model, or the path of a .zip or .onnx file."
        )
    return Behaviour.from_dict(fields, "behaviour")


_Share = Annotated[Real, Field(ge=0, le=1)]


class EpisodeScores(StrictModel):
    """Whole episodes of a policy; 0 of them if the values are exact without rollouts."""

    episodes: Integer
    mean_return: Real  # as the agent is paid, and its standard error over episodes
    standard_error: Real
    similarity: _Share  # mean r̃ over all steps


class PolicyScore(StrictModel):
    """The mean r̃ and r of one policy over the data set's states, and its whole episodes."""

    similarity: _Share
    step_reward: _Share
    rollouts: EpisodeScores | None  # null if the horizon is too long


class ReferenceScores(StrictModel):
    """The scores of a = ½, of the behaviour, of each of its policies on its rows, and of π*."""

    constant: PolicyScore
    behaviour: PolicyScore
    behaviours: TupleOf[PolicyScore]
    optimum: PolicyScore


class Seeds(StrictModel):
    """Seeds of the task and of the data (starts, α, ã and random actions)."""

    task: Seed
    data: Seed


class DatasetRecord(StrictModel):
    """Provenance, reference scores and digests of a data set.

    Attributes:
      schema_version: version of the record's format.
      recipe: all that the data set was generated from.
      recipe_digest, spec_digest, protocol_digest: of the recipe, its task and its protocol.
      task: what the task's file calls it.
      seeds: of the task and of the data.
      nu: ν if a single mixture acted; null for other or several behaviours.
      trajectories: E, the number of Minari episodes.
      scores: of reference policies on the data set.
      arrays_digest: see `AlignedArrays.digest`.
      versions: of Python and the packages that the numbers depend on.
    """

    schema_version: SchemaVersion = 1
    recipe: DatasetRecipe
    recipe_digest: Digest
    spec_digest: Digest
    task: str = ""
    protocol_digest: Digest
    seeds: Seeds
    nu: float | None
    trajectories: Annotated[Integer, Field(ge=1)]
    scores: ReferenceScores
    arrays_digest: Digest
    versions: dict[str, str]

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """Validate plain data, and the digests of its documents."""
        version = data.get("schema_version") if isinstance(data, dict) else None
        if type(version) is int and version != 1:
            age = "an older" if version < 1 else "a newer"
            raise SpecError(
                f"{source}: {KEY}.schema_version={version}: must be 1. The data set was written by "
                f"{age} version of this package. Read it with that version or with Minari, or "
                "generate it again from its recipe."
            )
        record = super().from_dict(data, f"{source}: {KEY}")
        recipe, remedy = record.recipe, "Download the data set again, or generate it again."
        documents = {"recipe": recipe, "spec": recipe.spec, "protocol": recipe.protocol}
        for name, document in documents.items():
            stated, where = getattr(record, f"{name}_digest"), f"{source}: {KEY}.{name}_digest"
            check_digest(stated, document, where, remedy)
        return record


_Width = Annotated[Integer, Field(ge=1, le=4096)]
_Widths = Annotated[tuple[_Width, ...], Field(strict=False, min_length=1, max_length=8)]
_Rate = Annotated[Real, Field(gt=0, le=1)]


class BCHyperparameters(StrictModel):
    """Hyperparameters of behaviour cloning.

    Attributes:
      hidden: widths of the policy's hidden layers.
      learning_rate: of Adam.
    """

    hidden: _Widths = (256, 256)
    learning_rate: _Rate = 1e-3


class IQLHyperparameters(StrictModel):
    """Hyperparameters of implicit Q-learning.

    Attributes:
      hidden: widths of the hidden layers of policy, critics and value function.
      learning_rate: of Adam, for all networks.
      discount: γ.
      expectile: τ of the value function; ½ gives the mean, values near 1 the maximum.
      inverse_temperature: β; 0 gives behaviour cloning.
      max_weight: upper limit of exp(β advantage).
      target_rate: ρ of the soft update of the target critics in each step.
    """

    hidden: _Widths = (256, 256)
    learning_rate: _Rate = 3e-4
    discount: Annotated[Real, Field(ge=0, lt=1)] = 0.99
    expectile: Annotated[Real, Field(gt=0, lt=1)] = 0.7
    inverse_temperature: Annotated[Real, Field(ge=0, le=1000)] = 3.0
    max_weight: Annotated[Real, Field(gt=0, le=1e6)] = 100.0
    target_rate: _Rate = 0.005


Hyperparameters = BCHyperparameters | IQLHyperparameters
ALGORITHMS: dict[str, type[Hyperparameters]] = {"bc": BCHyperparameters, "iql": IQLHyperparameters}


def check_algorithm(
    name: str, changes: Mapping[str, Any] | None = None
) -> tuple[str, Hyperparameters]:
    """An algorithm, whose case does not matter, and its hyperparameters with some changes."""
    name = choice("algorithm", str(name).lower(), ALGORITHMS, error=UnknownNameError)
    plain = dict(changes) if isinstance(changes, Mapping) else changes or {}
    return name, ALGORITHMS[name].from_dict(plain, "hyperparameters")


class OfflineEvaluation(StrictModel):
    """Episodes of the policy in the task, played during training."""

    step: Integer  # of the gradient, before it
    similarity: Real  # mean r̃ over all steps of all episodes, and its standard deviation
    similarity_sd: Real
    episode_return: Real  # mean over the episodes
    regret: Real | None = None  # mean over all steps; None in records without it, of before 1.0
    losses: dict[str, Real]  # terms of the loss of the last batch, by name


class BehaviourQuality(StrictModel):
    """Exact statistics of the data set's transitions: of r̃, and the mean r."""

    similarity: Real
    similarity_sd: Real
    step_reward: Real


class OfflineRecord(DigestedFile):
    """The arguments, data, evaluations and cost of an offline training.

    Attributes:
      schema_version: version of the record's format.
      algorithm: behaviour cloning or implicit Q-learning.
      hyperparameters: all of them, as used.
      seed: of initial weights, shuffles, and starts of the evaluation episodes.
      steps: of the gradient.
      batch_size: transitions in each.
      episodes: of each evaluation.
      dataset: id of the data set; null if only its arrays were passed.
      dataset_digest: of its arrays.
      recipe_digest: the recipe's; null if only the arrays were passed.
      transitions: N, the size of the data set.
      spec, spec_digest: the task, and its digest.
      behaviour: of the data set's transitions.
      evaluations: in order; last, the policy's.
      wall_seconds, cpu_seconds: time of the training and its evaluations.
      cpu_ms_per_step: of a gradient step, without evaluations.
      versions: of Python and the packages that the numbers depend on.
    """

    documents = ("spec",)
    remedy = "Train again."

    schema_version: SchemaVersion = 1
    algorithm: Literal["bc", "iql"]
    hyperparameters: dict[str, Any]
    seed: Integer
    steps: Integer
    batch_size: Integer
    episodes: Integer
    dataset: str | None
    dataset_digest: str
    recipe_digest: str | None
    transitions: Integer
    spec: SMESpec
    spec_digest: str
    behaviour: BehaviourQuality
    evaluations: Annotated[TupleOf[OfflineEvaluation], Field(min_length=1)]
    wall_seconds: Real
    cpu_seconds: Real
    cpu_ms_per_step: Real
    versions: dict[str, str]

    @property
    def similarity(self) -> float:
        return self.evaluations[-1].similarity

    @property
    def improvement(self) -> float:
        """The final policy's similarity minus the behaviour's."""
        return self.similarity - self.behaviour.similarity
