"""The data of an offline training: a data set on disk, or arrays and the spec of their task."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from sme_registry.datasets import Dataset, Transitions, open_dataset
from sme_registry.errors import OptionError, SpecError
from sme_registry.evaluation import resolve_protocol
from sme_registry.offline.record import BehaviourQuality
from sme_registry.spec import EvaluationProtocol, ProtocolLike, SMESpec, SpecLike
from sme_registry.task import Task, load_spec

_CHECKED_ROWS = 64
_TOLERANCE = 1e-6  # of π* between machines, as for fingerprints


@dataclass(frozen=True)
class DataSource:
    """The data of a training, and the task and protocol for its evaluation.

    Attributes:
      transitions: the arrays.
      spec: their task, of a single agent.
      protocol: of the final evaluation.
      dataset_id: None for arrays without a data set.
      recipe_digest: None for arrays without a data set.
    """

    transitions: Transitions
    spec: SMESpec
    protocol: EvaluationProtocol
    dataset_id: str | None
    recipe_digest: str | None

    def record_fields(self) -> dict[str, Any]:
        """The fields of an `OfflineRecord` that describe the data and the task."""
        similarities, step_rewards = self.transitions.similarities, self.transitions.step_rewards
        return {
            "dataset": self.dataset_id,
            "dataset_digest": self.transitions.digest,
            "recipe_digest": self.recipe_digest,
            "transitions": len(self.transitions),
            "spec": self.spec,
            "spec_digest": self.spec.digest,
            "behaviour": BehaviourQuality(
                similarity=float(similarities.mean()),
                similarity_sd=float(similarities.std()),
                step_reward=float(step_rewards.mean()),
            ),
        }


def data_source(data: Any, spec: SpecLike | None, protocol: ProtocolLike | None) -> DataSource:
    """Load the data of a training; see `train_offline` for the arguments.

    Raises:
      OptionError: `data` has the wrong type, or `spec` is missing or not the data set's.
      SpecError: the task is a team's.
      UnknownNameError: no such data set, task or protocol.
      MalformedDocumentError, DigestMismatchError: the data set cannot be read, or was changed.
    """
    if isinstance(data, Transitions):
        if spec is None:
            raise OptionError("spec=None: is required with arrays. Give the spec of their task.")
        task = _single_agent(load_spec(spec))
        chosen = resolve_protocol("paper-v1" if protocol is None else protocol)
        return DataSource(data, task, chosen, None, None)
    if not isinstance(data, Dataset | str | os.PathLike):
        raise OptionError(
            f"data={data!r:.60}: must be a data set, its id, its path, or its Transitions."
        )
    dataset = data if isinstance(data, Dataset) else open_dataset(data)
    record, recipe = dataset.record, dataset.recipe
    if spec is not None and (digest := load_spec(spec).digest) != record.spec_digest:
        raise OptionError(
            f"spec={digest[:19]}…: the data set's task is {record.spec_digest[:19]}…. Leave it out."
        )
    task = _single_agent(recipe.spec)
    chosen = recipe.protocol if protocol is None else resolve_protocol(protocol)
    return DataSource(dataset.transitions(), task, chosen, dataset.id, record.recipe_digest)


def _single_agent(spec: SMESpec) -> SMESpec:
    if spec.team is not None:
        raise SpecError(
            f"team: the data set has {len(spec.team.agents)} agents, and a policy that sees all "
            "observations cannot be executed by the individual agents. Train on a single-agent "
            "data set."
        )
    return spec


def check_task(transitions: Transitions, task: Task) -> None:
    """Check that arrays are finite, and that they are of a task.

    Raises:
      OptionError: they are not.
    """
    S, A = task.spec.state_dim, task.spec.action_dim
    if len(transitions) == 0:
        raise OptionError("transitions=0: must be at least 1. Give a data set with rows.")
    for name, width in (("observations", S + 2), ("actions", A), ("next_observations", S + 2)):
        shape = getattr(transitions, name).shape
        if shape != (len(transitions), width):
            raise OptionError(
                f"{name} of shape {shape}: must be ({len(transitions)}, {width}) for state_dim={S},"
                f" action_dim={A}. Give the spec of the data set."
            )
    for name in ("observations", "actions", "next_observations", "rewards", "states"):
        if not np.isfinite(getattr(transitions, name)).all():
            raise OptionError(f"{name}: contains NaN or infinity. Give finite numbers.")
    rows = np.linspace(0, len(transitions) - 1, min(_CHECKED_ROWS, len(transitions))).astype(int)
    optimal = task.optimal_action(transitions.states[rows])
    difference = np.abs(optimal - transitions.optimal_actions[rows]).max()
    if not difference <= _TOLERANCE:
        raise OptionError(
            f"spec={task.spec.digest[:19]}…: is not the task of the data set: the optimal actions "
            f"differ by up to {difference:.2g}. Give the spec of the data set."
        )
