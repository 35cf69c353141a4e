"""`run.json`: the plan of a training run, its versions and its progress."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from sme_registry.errors import OptionError
from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.spec.document import Integer, Real, StrictModel

RECORD = "run.json"
MODEL = "model.zip"
TENSORBOARD = "tensorboard"
DEFAULTS = "stable-baselines3 defaults"
PACKAGES = ("gymnasium", "numpy", "scipy", "numba", "stable_baselines3", "torch")


class RunRecord(StrictModel):
    """A training run: its plan and its progress.

    A step of a team is one step of all its agents, so the algorithm learns from `agents` times as
    many transitions.
    """

    schema_version: Literal[1] = 1
    status: Literal["running", "finished"]  # "running" also after a kill
    spec: SMESpec
    spec_digest: str
    task: str = ""  # what the task's file calls it
    algorithm: str
    hyperparameters: str = DEFAULTS  # whose defaults, and the changes to them
    seed: Integer
    action_range: Literal["unit", "symmetric"]
    num_envs: Integer
    agents: Integer = 1
    steps: Integer  # requested, of the environment, over all environments
    # At the last checkpoint, and at the end. On-policy algorithms finish their last rollout, so it
    # can exceed `steps`.
    steps_done: Integer = 0
    checkpoint_every: Integer  # steps
    episodes: Integer = 0  # finished ones, which episodes.csv lists
    sessions: Integer = 1  # 1 plus the number of times the run was resumed
    wall_seconds: Annotated[Real, Field(ge=0)] = 0.0  # over all sessions, without evaluation
    steps_per_second: Annotated[Real, Field(ge=0)] = 0.0
    protocol: EvaluationProtocol  # of the final evaluation
    protocol_digest: str
    versions: dict[str, str]  # of Python and the packages that the numbers depend on

    @classmethod
    def read(cls, folder: Path) -> RunRecord | None:
        """The record of a folder; None if it contains no run.

        Raises:
          MalformedDocumentError, SpecError: the file exists but is not a valid record.
        """
        path = folder / RECORD
        return cls.from_dict(read_json(path), str(path)) if path.exists() else None

    def write(self, folder: Path) -> None:
        """Write the record into the run's folder; raises OptionError if that fails."""
        write_atomically(folder / RECORD, to_json(self.to_dict()))

    def updated(self, **changes: Any) -> RunRecord:
        """This record with some fields changed."""
        return self.model_copy(update=changes)

    def check_same_plan(self, plan: RunRecord, folder: Path) -> None:
        """Raise OptionError if a run to be resumed has another plan."""
        for field in ("spec_digest", "algorithm", "seed", "action_range", "num_envs"):
            before, now = getattr(self, field), getattr(plan, field)
            if before != now:
                raise OptionError(
                    f"{field}={now!r}: the run in {folder} has {before!r}. Resume it with the same "
                    "value, or train into another folder."
                )
