"""The data of an offline training: a data set on disk, or arrays and the spec of their task."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np

from sme_registry.datasets import Dataset, Transitions, open_dataset
from sme_registry.errors import OptionError, SpecError
from sme_registry.evaluation import resolve_protocol
from sme_registry.offline.record import BehaviourQuality
from sme_registry.spec import EvaluationProtocol, ProtocolLike, SMESpec, SpecLike
from sme_registry.task import Task, load, materialize

_CHECKED_ROWS = 64
_TOLERANCE = 1e-6  # of π* between machines, as for fingerprints


class DataSource(NamedTuple):
    """The data of a training, and the task and protocol for its evaluation."""

    transitions: Transitions
    task: Task  # of a single agent
    name: str  # what the task's file calls it; may be empty
    protocol: EvaluationProtocol  # of the final evaluation
    ids: dict[str, str | None]  # the fields `dataset` and `recipe_digest` of an `OfflineRecord`

    def record_fields(self) -> dict[str, Any]:
        """The fields of an `OfflineRecord` that describe the data and the task."""
        similarities = self.transitions.similarities
        return {
            **self.ids,
            "dataset_digest": self.transitions.digest,
            "transitions": len(self.transitions),
            "spec": self.task.spec,
            "spec_digest": self.task.spec.digest,
            "behaviour": BehaviourQuality(
                similarity=similarities.mean(),
                similarity_sd=similarities.std(),
                step_reward=self.transitions.step_rewards.mean(),
            ),
        }


def data_source(data: Any, spec: SpecLike | None, protocol: ProtocolLike | None) -> DataSource:
    """Load and check the data of a training; see `train_offline`."""
    if isinstance(data, Transitions):
        if spec is None:
            raise OptionError("spec=None: is required with arrays. Give the spec of their task.")
        chosen = resolve_protocol("paper-v1" if protocol is None else protocol)
        ids: dict[str, str | None] = {"dataset": None, "recipe_digest": None}
        spec = load(spec, SMESpec)
        source = DataSource(data, _single_agent(spec), spec.name, chosen, ids)
    elif isinstance(data, Dataset | str | os.PathLike):
        dataset = data if isinstance(data, Dataset) else open_dataset(data)
        record, recipe = dataset.record, dataset.recipe
        if spec is not None and (digest := load(spec, SMESpec).digest) != record.spec_digest:
            raise OptionError(
                f"spec={digest[:19]}…: the data set's task is {record.spec_digest[:19]}…. Leave it "
                "out."
            )
        task = _single_agent(recipe.spec)
        chosen = recipe.protocol if protocol is None else resolve_protocol(protocol)
        ids = {"dataset": dataset.id, "recipe_digest": record.recipe_digest}
        source = DataSource(dataset.transitions(), task, record.task, chosen, ids)
    else:
        raise OptionError(
            f"data={data!r:.60}: must be a data set, its id, its path, or its Transitions."
        )
    _check_task(source.transitions, source.task)
    return source


def _single_agent(spec: SMESpec) -> Task:
    if spec.team is not None:
        raise SpecError(
            f"team: the data set has {len(spec.team.agents)} agents, and a policy that sees all "
            "observations cannot be executed by the individual agents. Train on a single-agent "
            "data set."
        )
    return materialize(spec)


def _check_task(transitions: Transitions, task: Task) -> None:
    """Raise OptionError unless arrays are finite and of this task."""
    S, A, m = task.spec.state_dim, task.spec.action_dim, task.spec.distractors
    seen, with_distractors = task.spec.observation_dim, f", {m} distractors" if m else ""
    if len(transitions) == 0:
        raise OptionError("transitions=0: must be at least 1. Give a data set with rows.")
    for name, width in (("observations", seen), ("actions", A), ("next_observations", seen)):
        shape = getattr(transitions, name).shape
        if shape != (len(transitions), width):
            raise OptionError(
                f"{name} of shape {shape}: must be ({len(transitions)}, {width}) for state_dim={S},"
                f" action_dim={A}{with_distractors}. Give the spec of the data set."
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
