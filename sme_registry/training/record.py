"""`run.json`: the plan of a training run, its versions and its progress."""

from __future__ import annotations

import re
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    JsonValue,
    SerializerFunctionWrapHandler,
    model_serializer,
)

from sme_registry.errors import OptionError
from sme_registry.io import read_json, to_json, versions, write_atomically
from sme_registry.spec import EvaluationProtocol, SMESpec, StreamSpec
from sme_registry.spec.document import Integer, Real, StrictModel, without_empty
from sme_registry.spec.study import INDEPENDENT, in_jax

RECORD = "run.json"
MODEL, MODELS = "model.zip", "model"  # a folder of one model for each independent agent
TENSORBOARD = "tensorboard"
CHECKPOINT = "checkpoint.zip"
PACKAGES = ("gymnasium", "numpy", "scipy", "numba", "stable_baselines3", "torch")


def versions_for(uses: str) -> dict[str, str]:
    """Installed versions that the numbers depend on, including the algorithm's own package."""
    package = uses.removeprefix(INDEPENDENT).partition(":")[0].partition(".")[0]
    return versions([*PACKAGES, package, *(["jaxlib"] if in_jax(uses) else [])])


def _from_text(value: Any) -> Any:
    """The changes in the text of older records, "…, but n_steps=256"."""
    if not isinstance(value, str):
        return value
    return {name: int(number) for name, number in re.findall(r"(\w+)=(\d+)", value)}


class RunRecord(StrictModel):
    """A training run: its plan and its progress.

    A step of a team is one step of all its agents, so the algorithm learns from `agents` times as
    many transitions.

    Attributes:
      schema_version: version of the record's format.
      status: whether it is finished; "running" also after a kill.
      failure: why it failed.
      spec: the task; of a life in a stream that of its first phase.
      spec_digest: the task's digest.
      stream: the stream that the agent lives in; null for a single task.
      stream_digest: the stream's digest; empty for a single task.
      task: what the task's file calls it.
      algorithm: its name, as in `sme train`.
      hyperparameters: those that differ from the algorithm's defaults. `sme train` sets some for
        several environments and for teams; see `hyperparameters.for_lanes`.
      device: of agents in JAX: "cpu", "gpu" or "tpu".
      seed: of training.
      action_range: of the environment that the agent acts in.
      num_envs: environments that step together.
      agents: of a team; 1 for a single agent.
      independent: whether it is a team with one model for each agent.
      steps: requested, of the environment, over all environments.
      steps_done: at the last checkpoint, and at the end. On-policy algorithms finish their last
        rollout, so it can exceed `steps`.
      checkpoint_every: steps between checkpoints.
      episodes: finished ones, which episodes.csv lists.
      sessions: 1 plus the number of times the run was resumed.
      wall_seconds: over all sessions, without evaluation.
      steps_per_second: environment steps, over all sessions.
      protocol: of the final evaluation.
      protocol_digest: the protocol's digest.
      versions: of Python and the packages that the numbers depend on.
    """

    schema_version: Literal[1] = 1
    status: Literal["running", "finished", "failed"]
    failure: str = ""
    spec: SMESpec
    spec_digest: str
    stream: StreamSpec | None = None
    stream_digest: str = ""
    task: str = ""
    algorithm: str
    hyperparameters: Annotated[dict[str, JsonValue], BeforeValidator(_from_text)] = Field(
        default_factory=dict
    )
    device: str = ""
    seed: Integer
    action_range: Literal["unit", "symmetric"]
    num_envs: Integer
    agents: Integer = 1
    independent: bool = False
    steps: Integer
    steps_done: Integer = 0
    checkpoint_every: Integer
    episodes: Integer = 0
    sessions: Integer = 1
    wall_seconds: Annotated[Real, Field(ge=0)] = 0.0
    steps_per_second: Annotated[Real, Field(ge=0)] = 0.0
    protocol: EvaluationProtocol
    protocol_digest: str
    versions: dict[str, str]

    @model_serializer(mode="wrap")
    def _omit_empty(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return without_empty(handler(self), "stream", "stream_digest")

    @classmethod
    def read(cls, folder: Path) -> RunRecord | None:
        """The record of a folder; None if it contains no run."""
        path = folder / RECORD
        return cls.from_dict(read_json(path), str(path)) if path.exists() else None

    def write(self, folder: Path) -> None:
        """Write the record into the run's folder; raises OptionError if that fails."""
        write_atomically(folder / RECORD, to_json(self.to_dict()))

    @property
    def document(self) -> SMESpec | StreamSpec:
        """What the agent lives in: the stream, or the task."""
        return self.stream or self.spec

    @property
    def model_name(self) -> str:
        """Name of the trained model in the run's folder: a file, or the folder of its models."""
        return MODELS if self.independent else MODEL

    def updated(self, **changes: Any) -> RunRecord:
        """This record with some fields changed."""
        return self.model_copy(update=changes)

    def continuing(self, previous: RunRecord, folder: Path) -> RunRecord:
        """This plan, with the progress and the hyperparameters of the run that it continues."""
        fields = (
            "stream_digest",
            "spec_digest",
            "algorithm",
            "seed",
            "action_range",
            "num_envs",
            "independent",
        )
        pairs = {field: (getattr(previous, field), getattr(self, field)) for field in fields}
        for name, value in self.hyperparameters.items():
            before = previous.hyperparameters.get(name, "the algorithm's default")
            pairs[f"hyperparameters.{name}"] = (before, value)
        for field, (before, now) in pairs.items():
            if before != now:
                where = _difference(previous, self) if field == "stream_digest" else ""
                raise OptionError(
                    f"{field}={now!r}: the run in {folder} has {before!r}{where}. Resume it with "
                    "the same value, or train into another folder."
                )
        if self.steps < min(previous.steps, previous.steps_done):
            raise OptionError(
                f"steps={self.steps:,}: must be at least {previous.steps_done:,}, the steps that "
                f"the run in {folder} has done. Choose more, or keep {previous.steps:,}."
            )
        return self.updated(
            hyperparameters=previous.hyperparameters,
            sessions=previous.sessions + 1,
            steps_done=previous.steps_done,
        )


def _difference(one: RunRecord, other: RunRecord) -> str:
    """Where the streams of two runs differ first; nothing where one of them has none."""
    if one.stream is None or other.stream is None:
        return ""
    before, now = one.stream.to_dict(), other.stream.to_dict()
    phases = zip_longest(before.pop("phases"), now.pop("phases"))
    different = [f"phases.{index}" for index, (a, b) in enumerate(phases) if a != b]
    different += [name for name in before if before[name] != now[name]]
    return f" ({different[0]} differs)"
