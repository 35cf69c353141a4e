"""`run.json`: what was run, on what, with which versions; and how far it got."""

from __future__ import annotations

import importlib.metadata
import platform
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from sme_registry.errors import OptionError
from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.spec.document import Integer, Real, StrictModel

FILE = "run.json"
DEFAULTS = "stable-baselines3 defaults"
_PACKAGES = ("gymnasium", "numpy", "scipy", "numba", "stable_baselines3", "torch")


class RunRecord(StrictModel):
    """A training run: its plan, and what came of it.

    Attributes:
      status: "running" (or killed), then "finished".
      spec, spec_digest, algorithm, seed, action_range, num_envs: the plan, which a resumption
        must agree with.
      hyperparameters: whose, and what is changed.
      agents: of the task; more than 1 in a team. They share the one policy that is trained.
      steps: environment steps asked for, over all environments. A step of a team is one step of
        all its agents, so the algorithm learns from `agents` times as many transitions.
      steps_done: at the last checkpoint, and at the end. On-policy algorithms finish their
        last rollout, so it can be above `steps`.
      checkpoint_every: steps between checkpoints.
      episodes: finished episodes, all logged in episodes.csv.
      sessions: 1, and one more for each resumption.
      wall_seconds, steps_per_second: of the training, over all sessions, evaluation left out.
      protocol, protocol_digest: of the evaluation at the end.
      versions: of Python and the packages that the numbers depend on.
    """

    schema_version: Literal[1] = 1
    status: Literal["running", "finished"]
    spec: SMESpec
    spec_digest: str
    algorithm: str
    hyperparameters: str = DEFAULTS
    seed: Integer
    action_range: Literal["unit", "symmetric"]
    num_envs: Integer
    agents: Integer = 1
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

    @classmethod
    def read(cls, folder: Path) -> RunRecord | None:
        """The record of a folder; None where it holds no run.

        Raises:
          MalformedDocumentError, SpecError: there is a file of that name and it is no record.
        """
        path = folder / FILE
        return cls.from_dict(read_json(path), str(path)) if path.exists() else None

    def write(self, folder: Path) -> None:
        """Write it into the run's folder, whole or not at all.

        Raises:
          OptionError: it cannot be written.
        """
        write_atomically(folder / FILE, to_json(self.to_dict()))

    def updated(self, **changes: Any) -> RunRecord:
        """This record with some fields changed."""
        return self.model_copy(update=changes)

    def refuse_other_plan(self, asked: RunRecord, folder: Path) -> None:
        """Raise where the run in the folder is not the one that is to be resumed.

        Raises:
          OptionError: names the field, both values, and the way out.
        """
        for field in ("spec_digest", "algorithm", "seed", "action_range", "num_envs"):
            before, now = getattr(self, field), getattr(asked, field)
            if before != now:
                raise OptionError(
                    f"{field}={now!r}: the run in {folder} has {before!r}. Resume it with what it "
                    "was begun with, or train into another folder."
                )


def installed_versions() -> dict[str, str]:
    """Versions of Python and of what the numbers depend on, where installed."""
    from sme_registry.version import __version__

    versions = {"sme_registry": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions
