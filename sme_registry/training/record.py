"""The files of a training run.

`run.json` (`RunRecord`) has its plan, versions and progress. `episodes.csv` (`EpisodeLog`) has a
row for each finished episode, written as soon as it ends; that of a team has one more column for
each agent, `regret/<agent>`, and that of a task with `safety` has `cost`, `violating_share` and
`safe_regret`. Of a life in a stream, `Snapshots` are its models at the ends of its visits:

    initial.zip       the model before training
    visit-00.zip      at the end of visit 0, and so on; the last one is the trained model

Visits count from 0, in as many digits as the last one has, at least two. The policy at the end of a
visit has learned from all that the learner collected in it: with TD3 and SAC up to the update that
follows its last step, with PPO up to that of the last rollout that was over by then. So it is the
policy at the first step of the next visit, before any update that follows that step. The last visit
ends with the training, since the last phase goes on: PPO finishes its last rollout in it.
`jax.run.run` has the same rule.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
)

from sme_registry.envs.episodes import Episode, EpisodeSafety
from sme_registry.errors import OptionError
from sme_registry.io import read_json, to_json, versions, write_atomically
from sme_registry.spec import EvaluationProtocol, SMESpec, StreamSpec
from sme_registry.spec.document import Integer, PlainJson, Real, StrictModel, without_empty
from sme_registry.training.algorithms import BACKENDS, parse_uses

RECORD = "run.json"
MODEL, MODELS = "model.zip", "model"  # a folder of one model for each independent agent
EPISODES = "episodes.csv"
SNAPSHOTS = "snapshots"  # the folder of `Snapshots`
TENSORBOARD = "tensorboard"
CHECKPOINT = "checkpoint.zip"
MODELS_OF_STUDY = "models"
PACKAGES = ("gymnasium", "numpy", "scipy", "numba", "stable_baselines3", "torch")


def versions_for(uses: str) -> dict[str, str]:
    """Installed versions that the numbers depend on, including the algorithm's own package."""
    kind, name = parse_uses(uses)
    package = (
        (name if kind in ("independent", "train") else uses).partition(":")[0].partition(".")[0]
    )
    return versions([*PACKAGES, package, *BACKENDS[kind].packages])


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
      hyperparameters: those that differ from the algorithm's defaults. Training sets some for
        several environments and for teams; see `models.for_lanes`.
      device: of agents in JAX: "cpu", "gpu" or "tpu".
      source: of `train:module:function`, the SHA-256 of the module's source; empty for any other.
      seed: of training.
      action_range: of the environment that the agent acts in.
      num_envs: environments that step together.
      agents: of a team; 1 for a single agent.
      independent: whether it is a team with one model for each agent.
      steps: requested, of the environment, over all environments.
      steps_done: at the last checkpoint, and at the end. On-policy algorithms finish their last
        rollout, so it can exceed `steps`.
      checkpoint_every: steps between checkpoints.
      protocol: of the final evaluation.
      protocol_digest: the protocol's digest.
      episodes: finished ones, which episodes.csv lists.
      sessions: 1 plus the number of times the run was resumed.
      wall_seconds: over all sessions, without evaluation.
      steps_per_second: environment steps, over all sessions.
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
    hyperparameters: PlainJson = Field(default_factory=dict)
    device: str = ""
    source: str = ""
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
        return without_empty(handler(self), "stream", "stream_digest", "source")

    @classmethod
    def read(cls, folder: Path) -> RunRecord | None:
        path = folder / RECORD
        return cls.from_dict(read_json(path), str(path)) if path.exists() else None

    def write(self, folder: Path) -> None:
        write_atomically(folder / RECORD, to_json(self.to_dict()))

    @property
    def document(self) -> SMESpec | StreamSpec:
        return self.stream or self.spec

    @property
    def model_name(self) -> str:
        """Name of the trained model in the run's folder: a file, or the folder of its models."""
        return MODELS if self.independent else MODEL

    def updated(self, **changes: Any) -> RunRecord:
        return self.model_copy(update=changes)

    def continuing(self, previous: RunRecord, folder: Path) -> RunRecord:
        """This plan, with the progress and the hyperparameters of the run that it continues."""
        fields = (
            "stream_digest", "spec_digest", "algorithm", "seed", "action_range", "num_envs",
            "independent",
        )  # fmt: skip
        pairs = {field: (getattr(previous, field), getattr(self, field)) for field in fields}
        for name, value in self.hyperparameters.items():
            before = previous.hyperparameters.get(name, "the algorithm's default")
            pairs[f"hyperparameters.{name}"] = (before, value)
        for field, (before, now) in pairs.items():
            if before != now:
                raise OptionError(
                    f"{field}={now!r}: the run in {folder} has {before!r}. Resume it with the same "
                    "value, or train into another folder."
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
            episodes=previous.episodes,
        )


_AGENT_PREFIX = "regret/"


COLUMNS = Episode._fields[:-2]
SAFETY = EpisodeSafety._fields
_TYPES = (int, int, float, int, float, float, int, float)


def read_episodes(path: Path) -> list[Episode]:
    """All complete rows; one that was cut off by a kill is skipped."""
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise OptionError(f"{path}: cannot be read: {error}. Give an episodes.csv.") from None
    head = rows[0] if rows else []
    columns, others = tuple(head[: len(COLUMNS)]), tuple(head[len(COLUMNS) :])
    by_agent = all(column.startswith(_AGENT_PREFIX) for column in others)
    if columns != COLUMNS or not (by_agent or others == SAFETY):
        raise OptionError(
            f"{path}: the columns must be {','.join(COLUMNS)}, and for a team "
            f"{_AGENT_PREFIX}<agent>, or for a task with safety {','.join(SAFETY)}."
        )
    episodes = []
    for line, row in enumerate(rows[1:], start=2):
        try:
            kinds = zip(_TYPES + (float,) * len(others), row, strict=True)
            values = [kind(text) for kind, text in kinds]
            if not np.isfinite(values).all():
                raise ValueError
        except ValueError:  # a number or a column is missing
            if line == len(rows):
                break
            raise OptionError(
                f"{path}: line {line} must have {len(head)} finite numbers. Correct it."
            ) from None
        own, rest = values[: len(COLUMNS)], tuple(values[len(COLUMNS) :])
        episode = Episode._make((*own, (), EpisodeSafety(*rest) if others == SAFETY else None))
        episodes.append(episode._replace(agents_regret=rest) if by_agent else episode)
    return episodes


class EpisodeLog:
    """Appends rows and flushes each, so that a killed run keeps all finished episodes."""

    def __init__(self, path: Path, up_to_step: int = 0, agents: Sequence[str] = ()) -> None:
        self.agents = agents
        kept = read_episodes(path) if up_to_step and path.exists() else []
        self.episodes = [episode for episode in kept if episode.step <= up_to_step]
        self._path = path
        self._write()

    def _write(self) -> None:
        text = io.StringIO()
        safety = SAFETY if self.episodes and self.episodes[0].safety is not None else ()
        head = [*COLUMNS, *safety, *(f"{_AGENT_PREFIX}{agent}" for agent in self.agents)]
        csv.writer(text, lineterminator="\n").writerows([head, *map(_row, self.episodes)])
        write_atomically(self._path, text.getvalue())
        self._stream = self._path.open("a", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream, lineterminator="\n")

    def add(self, episode: Episode) -> None:
        self.episodes.append(episode)
        if len(self.episodes) == 1 and episode.safety is not None:  # which has columns of its own
            self.close()
            self._write()
            return
        self._writer.writerow(_row(episode))
        self._stream.flush()

    def close(self) -> None:
        self._stream.close()


def _row(episode: Episode) -> list[int | str]:
    *values, agents, safety = episode
    row = (*values, *(safety or ()), *agents)
    return [format(v, ".9g") if isinstance(v, float) else v for v in row]


def model_of_cell(study: Path, key: str) -> Path:
    """Where a study keeps the trained model of a cell, by its digest."""
    return study / MODELS_OF_STUDY / f"{key.removeprefix('sha256:')}.zip"


def folder_of_cell(study: Path, key: str) -> Path:
    """The folder for the `Snapshots` of a cell that is a life; the arguments as above."""
    return model_of_cell(study, key).with_suffix("")


class Snapshots:
    """The files of a life's models in a folder."""

    def __init__(self, folder: Path, stream: StreamSpec) -> None:
        count = stream.visits
        digits = max(2, len(str(count - 1)))
        self.initial = folder / "initial.zip"
        self.visits = [folder / f"visit-{visit:0{digits}}.zip" for visit in range(count)]


class VisitEnds:
    """Calls a function at the end of each visit, while steps are counted."""

    def __init__(
        self, stream: StreamSpec, on_visit: Callable[[int], object], steps: int = 0
    ) -> None:
        *upcoming, self._last = stream.visit_ends()
        self._upcoming = [(visit, end) for visit, end in upcoming if end >= steps]
        self._on_visit = on_visit

    def after_step(self, steps: int) -> None:
        """Count a step; `steps` are all that were taken, and the learner has not learned since."""
        while self._upcoming and self._upcoming[0][1] < steps:
            self._on_visit(self._upcoming.pop(0)[0])

    def finish(self, steps: int) -> None:
        """End the visits that are over when training ends, after its last update."""
        self.after_step(steps + 1)
        visit, end = self._last
        if end <= steps:
            self._on_visit(visit)
