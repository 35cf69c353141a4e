"""`offline.json`: what an offline training used, and its evaluations."""

from __future__ import annotations

import os
from typing import Annotated, Any, Literal

from pydantic import Field

from sme_registry.io import read_json
from sme_registry.spec import Integer, Real, SMESpec, StrictModel, TupleOf
from sme_registry.spec.document import refuse_other_digest


class Evaluation(StrictModel):
    """Episodes of the policy in the task, played during training."""

    step: Integer  # gradient steps before it
    similarity: Real  # mean r̃ over all steps of all episodes
    similarity_sd: Real  # standard deviation over these steps
    episode_return: Real  # mean over the episodes
    losses: dict[str, Real]  # terms of the loss of the last batch, by name


class BehaviourQuality(StrictModel):
    """Exact statistics of the data set's transitions."""

    similarity: Real  # mean r̃
    similarity_sd: Real
    step_reward: Real  # mean r


class OfflineRecord(StrictModel):
    """The arguments, data, evaluations and cost of an offline training."""

    schema_version: Literal[1] = 1
    algorithm: Literal["bc", "iql"]
    hyperparameters: dict[str, Any]  # all of them, as used
    seed: Integer  # of initial weights, shuffles, and starts of the evaluation episodes
    steps: Integer  # of the gradient
    batch_size: Integer  # transitions in each
    episodes: Integer  # of each evaluation
    dataset: str | None  # id of the data set; null if only its arrays were passed
    dataset_digest: str  # of its arrays
    recipe_digest: str | None  # null if only the arrays were passed
    transitions: Integer  # N, the size of the data set
    spec: SMESpec
    spec_digest: str
    behaviour: BehaviourQuality
    evaluations: Annotated[TupleOf[Evaluation], Field(min_length=1)]  # in order; last, the policy's
    wall_seconds: Real  # of the training and its evaluations
    cpu_seconds: Real
    cpu_ms_per_step: Real  # of a gradient step, without evaluations
    versions: dict[str, str]  # of Python and the packages that the numbers depend on

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
        """Read the record of an offline training.

        Raises:
          MalformedDocumentError: the file cannot be read or is not strict JSON.
          SpecError: a field is invalid, missing or unknown.
          DigestMismatchError: `spec_digest` does not match the spec.
        """
        record = cls.from_dict(read_json(path), str(path))
        refuse_other_digest(
            record.spec_digest, record.spec, f"{os.fspath(path)}: spec_digest", "Train again."
        )
        return record
