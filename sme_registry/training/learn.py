"""`Learner`, what learns in a run; `learn`, which trains a run by any `Learner`.

A run goes on from its last checkpoint. Each finished episode is logged with its exact regret.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.markup import escape

from sme_registry.envs.episodes import Episode, Episodes
from sme_registry.errors import PolicyError
from sme_registry.evaluation import Policy
from sme_registry.evaluation.policies import TeamPolicy, as_policy
from sme_registry.io.system import defer_interrupts
from sme_registry.io.terminal import Progress, err
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.sme_spec import ActionRange
from sme_registry.task.task import Array
from sme_registry.training.algorithms import short_name
from sme_registry.training.record import (
    CHECKPOINT,
    EPISODES,
    SNAPSHOTS,
    TENSORBOARD,
    EpisodeLog,
    RunRecord,
    Snapshots,
)

_RECENT = 20  # episodes in the running mean that the progress shows


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a learner learns, and how.

    `num_envs` is 1 where that is None, and more for a team and an on-policy algorithm. `piece` is
    the most steps between two pauses of what has them at any step.
    """

    document: SMESpec | StreamSpec
    seed: int
    steps: int
    hyperparameters: Mapping[str, Any]
    action_range: ActionRange = "symmetric"
    num_envs: int | None = None
    device: str | None = None
    piece: int = 100


class Steps(NamedTuple):
    """What happened in one or more steps of all environments: the arguments of `Episodes.add`."""

    rewards: Any
    info: Mapping[str, Any]
    terminated: Any
    ended: Any


class Watch:
    """What is called while a learner learns; `RunLog` of a run, and another of a study's cell."""

    def on_steps(self, steps: Steps) -> None:
        """The learner's environments have taken one or more steps."""

    def on_reset(self) -> None:
        """The learner begins an episode, and forgets one that has not ended."""

    def on_visit(self, visit: int) -> None:
        """A visit of a stream's phase has ended."""

    def on_policy(self) -> None:
        """A learner that yields policies has another one."""

    def on_pause(self) -> None:
        """The learner has learned from all its steps: a checkpoint may be saved."""

    def prepare(self, note: str) -> None:
        """The learner does something else before its first steps, such as compiling."""


class Learner:
    """What learns in environments of its own: of Stable-Baselines3, in JAX, or a function."""

    source: str | None = None  # the digest of the code that learns, if that is part of a cell
    seconds: Any = 0.0  # of the CPU in its environments, if they are known
    only_at_the_end = False  # whether it has no policy before
    yields_policies = False  # whether it has another policy only where it calls `on_policy`
    steps: Any  # of the environments so far
    total: Any  # at the end; on-policy algorithms collect whole rollouts
    model: Any  # the trained policy, as `evaluate` takes it

    def __init__(self, name: str, run: Run) -> None:
        self.name, self.run = name, run
        self.hyperparameters: dict[str, Any] = dict(run.hyperparameters)

    def learn(self, watch: Watch) -> None:
        """Take the steps of the run that are left; ValueError where weights are not finite."""
        raise NotImplementedError

    def policy(self) -> Policy | TeamPolicy:
        """The present policy."""
        return as_policy(self.model, self.run.document.specs[0], action_range=self.run.action_range)

    def lasting_policy(self) -> Policy:
        """The present policy of a single agent, which further training must not change."""
        policy = self.policy()
        assert isinstance(policy, Policy)
        return policy

    def save(self, path: Path) -> None:
        """Write the model; nothing of one that cannot be saved."""

    def is_finite(self) -> bool:
        """Whether all its weights are finite; also if they are unknown."""
        return True

    def restore(self, checkpoint: Path) -> Array | None:
        """Go on from a checkpoint; returns the sums of the present episodes if these go on, too."""

    def save_checkpoint(self, path: Path, sums: Array) -> None:
        """Write a checkpoint, whole or not at all; `sums` are of the present episodes."""

    def begin_log(self, folder: Path) -> None:
        """Log to TensorBoard in a folder from here on, if it is installed."""

    def log(self, episodes: Sequence[Episode]) -> None:
        """Log finished episodes to TensorBoard."""

    def close(self) -> None:
        """Close the environments and the log."""


def learn(
    learner: Learner, record: RunRecord, folder: Path, progress: bool, console: Console | None
) -> tuple[RunRecord, list[Episode]]:
    """Train and write a model."""
    checkpoint, present = folder / CHECKPOINT, None
    if record.sessions > 1 and checkpoint.exists():
        present = learner.restore(checkpoint)
    learner.begin_log(folder / TENSORBOARD)
    with RunLog(learner, record, folder, progress, console, present) as log:
        try:
            learner.learn(log)
        except ValueError:  # of our environments or of PyTorch, where actions are NaN
            log.check_finite()
            raise
        log.check_finite()
        learner.close()
        with defer_interrupts():
            learner.save(folder / record.model_name)
            return log.write_record(), log.episodes


class RunLog(Watch):
    """The log, the record and the displayed progress of a run, while it trains."""

    def __init__(
        self,
        learner: Learner,
        record: RunRecord,
        folder: Path,
        progress: bool,
        console: Console | None,
        present: Array | None,
    ) -> None:
        team, first_step, total = record.spec.team, learner.steps, learner.total
        self._agents = () if team is None else tuple(agent.name for agent in team.agents)
        self._learner, self._record, self._folder = learner, record, folder
        self._log = EpisodeLog(folder / EPISODES, first_step, self._agents)
        lost = record.episodes - len(self.episodes) if first_step else 0
        if lost > 0:
            (console or err()).print(
                f"{escape(str(folder / EPISODES))}: was cut off or changed: {lost:,} of the "
                f"{record.episodes:,} episodes before the checkpoint are missing from the log.",
                soft_wrap=True,
            )
        self._wall_before = self.episodes[-1].wall_seconds if self.episodes else 0.0
        self._last_checkpoint = first_step
        self._sums = Episodes(
            record.num_envs,
            record.agents,
            lambda: record.spec,
            steps=first_step,
            clock=lambda: self._wall_seconds,
        )
        if present is not None:
            self._sums.sums[:] = present
        name = short_name(record.algorithm)
        if progress and total > max(first_step, record.steps):
            (console or err()).print(
                f"{name} collects whole rollouts: {total:,} steps, not {record.steps:,}.",
                style="dim",
            )
        self._progress = Progress(
            f"training {name}", total, done=first_step, console=console, enabled=progress
        )
        self._snapshots: Snapshots | None = None
        if record.stream is not None:
            self._snapshots = Snapshots(folder / SNAPSHOTS, record.stream)
            if first_step == 0:
                learner.save(self._snapshots.initial)

    def __enter__(self) -> RunLog:
        self._progress.__enter__()
        self._start = time.monotonic()
        self._note = self._progress_note()
        return self

    def __exit__(self, *error: Any) -> None:
        self._progress.__exit__(*error)
        self._log.close()

    @property
    def episodes(self) -> list[Episode]:
        return self._log.episodes

    def prepare(self, note: str) -> None:
        self._progress.prepare(note)

    def on_reset(self) -> None:
        self._sums.begin()

    def on_steps(self, steps: Steps) -> None:
        finished = self._sums.add(*steps)
        for episode in finished:
            by_agent = (episode.agents_regret or (episode.regret,)) if self._agents else ()
            number = len(self.episodes) + 1
            self._log.add(episode._replace(episode=number, agents_regret=by_agent))
        if finished:
            self._note = self._progress_note()
            self._learner.log(finished)
        self._progress.update(self._sums.steps, note=self._note)

    def on_visit(self, visit: int) -> None:
        assert self._snapshots is not None  # a task has no visits
        self._learner.save(self._snapshots.visits[visit])

    def on_pause(self) -> None:
        steps = self._sums.steps
        due = steps - self._last_checkpoint >= self._record.checkpoint_every
        if not due and steps < self._learner.total:
            return
        self.check_finite()
        with defer_interrupts():
            self._learner.save_checkpoint(self._folder / CHECKPOINT, self._sums.sums)
            self.write_record()
        self._last_checkpoint = steps

    def write_record(self) -> RunRecord:
        seconds, steps = self._wall_seconds, self._sums.steps
        record = self._record.updated(
            steps_done=steps,
            episodes=len(self.episodes),
            wall_seconds=round(seconds, 3),
            steps_per_second=round(steps / max(seconds, 1e-9), 3),
        )
        record.write(self._folder)
        return record

    def check_finite(self) -> None:
        """Raise PolicyError if weights are NaN or infinite; the record says that the run failed."""
        if self._learner.is_finite():
            return
        failure = f"the weights are not finite any longer at step {self._learner.steps:,}"
        record = RunRecord.read(self._folder)  # of its last checkpoint
        if record is not None:
            record.updated(status="failed", failure=failure).write(self._folder)
        path = self._folder / CHECKPOINT
        kept = f"{path} is its last checkpoint" if path.exists() else "it has no checkpoint"
        raise PolicyError(
            f"training: {failure}. The run stays in {self._folder}; {kept}. Train into another "
            "folder with other hyperparameters, such as a lower learning_rate."
        )

    @property
    def _wall_seconds(self) -> float:
        return self._wall_before + time.monotonic() - self._start

    def _progress_note(self) -> str:
        """The phase of a stream, and the mean regret of the last episodes."""
        notes, stream, recent = [], self._record.stream, self.episodes[-_RECENT:]
        if stream is not None:
            segment = stream.times.segment_at(self._sums.steps)
            notes.append(f"phase {stream.segments[segment].phase}")
        if recent:
            regret = np.mean([episode.regret for episode in recent])
            whose = "team's mean regret" if self._agents else "mean regret"
            costs = [episode.safety.cost for episode in recent if episode.safety is not None]
            cost = f", cost {np.mean(costs):.3f}" if costs else ""
            notes.append(f"{whose} {regret:.3f}{cost} (last {len(recent)} episodes)")
        return ", ".join(notes)
