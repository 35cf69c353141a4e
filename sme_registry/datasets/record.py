"""What a data set and an offline training leave behind: their records, as documents.

Hyperparameters, with the source of each default:

| | BC | IQL | source |
|---|---|---|---|
| hidden layers, ReLU | 256, 256 | 256, 256 in each network | IQL's paper; d3rlpy |
| Adam's learning rate | 1e-3 | 3e-4 for actor, critics and value | d3rlpy's BC; IQL's paper |
| discount γ | – | 0.99 | IQL's paper |
| expectile τ | – | 0.7 | METHOD, section 4; IQL's paper on locomotion |
| inverse temperature β | – | 3.0, weights at most 100 | IQL's paper on locomotion |
| soft update of the target critics | – | 0.005 each step | IQL's paper |

IQL's paper (see `learners`) also decays the actor's learning rate by a cosine; neither d3rlpy nor
this package does.
"""

from __future__ import annotations

import os
from typing import Annotated, Any, Literal, Self

from pydantic import Field

from sme_registry.datasets.recipe import DatasetRecipe
from sme_registry.errors import SpecError
from sme_registry.io import read_json
from sme_registry.spec import Digest, Integer, Real, SMESpec, StrictModel, TupleOf
from sme_registry.spec.document import check_digest
from sme_registry.spec.sme_spec import Seed

Share = Annotated[Real, Field(ge=0, le=1)]


class EpisodeScores(StrictModel):
    """Whole episodes of a policy; 0 of them if the values are exact without rollouts.

    Attributes:
      mean_return: mean sum of rewards, in [0, T].
      standard_error: of that mean, over episodes.
      similarity: mean r̃ over all steps.
    """

    episodes: Integer
    mean_return: Real
    standard_error: Real
    similarity: Share


class PolicyScore(StrictModel):
    """The scores of one policy.

    Attributes:
      similarity: mean r̃ over the data set's states.
      step_reward: mean r over them.
      rollouts: null if the horizon is too long for whole episodes.
    """

    similarity: Share
    step_reward: Share
    rollouts: EpisodeScores | None


class ReferenceScores(StrictModel):
    """The scores of a = ½, of the behaviour, of each of its policies on its rows, and of π*."""

    constant: PolicyScore
    behaviour: PolicyScore
    behaviours: TupleOf[PolicyScore]
    optimum: PolicyScore


KEY = "sme"


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
      arrays_digest: see `Transitions.digest`.
      versions: of Python and the packages that the numbers depend on.
    """

    schema_version: Literal[1] = 1
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
        """Validate plain data, and the digests of its documents; errors call it `source`."""
        version = data.get("schema_version") if isinstance(data, dict) else None
        if type(version) is int and version != 1:
            age = "an older" if version < 1 else "a newer"
            raise SpecError(
                f"{source}: {KEY}.schema_version={version}: must be 1. The data set was written by "
                f"{age} version of this package. Read it with that version or with Minari, or "
                "generate it again from its recipe."
            )
        record = super().from_dict(data, f"{source}: {KEY}")
        for field, document in (
            ("recipe_digest", record.recipe),
            ("spec_digest", record.recipe.spec),
            ("protocol_digest", record.recipe.protocol),
        ):
            check_digest(
                getattr(record, field),
                document,
                f"{source}: {KEY}.{field}",
                "Download the data set again, or generate it again.",
            )
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


class OfflineEvaluation(StrictModel):
    """Episodes of the policy in the task, played during training.

    Attributes:
      step: gradient steps before it.
      similarity, similarity_sd: mean and standard deviation of r̃ over all steps of all episodes.
      episode_return: mean over the episodes.
      losses: terms of the loss of the last batch, by name.
    """

    step: Integer
    similarity: Real
    similarity_sd: Real
    episode_return: Real
    losses: dict[str, Real]


class BehaviourQuality(StrictModel):
    """Exact statistics of the data set's transitions.

    Attributes:
      similarity, similarity_sd: mean and standard deviation of r̃.
      step_reward: mean r.
    """

    similarity: Real
    similarity_sd: Real
    step_reward: Real


class OfflineRecord(StrictModel):
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

    schema_version: Literal[1] = 1
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
        """Mean r̃ of the final policy's episodes."""
        return self.evaluations[-1].similarity

    @property
    def improvement(self) -> float:
        """The final policy's similarity minus the behaviour's."""
        return self.similarity - self.behaviour.similarity

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> OfflineRecord:
        record = cls.from_dict(read_json(path), str(path))
        check_digest(
            record.spec_digest, record.spec, f"{os.fspath(path)}: spec_digest", "Train again."
        )
        return record
