"""`offline.json`: what an offline training used, and its evaluations."""

from __future__ import annotations

import os
from typing import Annotated, Any, Literal

from pydantic import Field

from sme_registry.io import read_json
from sme_registry.spec import Integer, Real, SMESpec, StrictModel, TupleOf
from sme_registry.spec.document import refuse_other_digest


class Evaluation(StrictModel):
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
    evaluations: Annotated[TupleOf[Evaluation], Field(min_length=1)]
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
        refuse_other_digest(
            record.spec_digest, record.spec, f"{os.fspath(path)}: spec_digest", "Train again."
        )
        return record
