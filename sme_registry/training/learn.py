"""`learn`: the training of a run by any `Learner`; `write_report`: its evaluation and its figures.

It goes on from its last checkpoint. Each finished episode is logged with its exact regret. A run on
a task has an `EvaluationReport` of its trained model, a life in a stream a `StreamReport` of its
snapshots, with the dynamic regret of its episodes.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from rich.console import Console

from sme_registry.compiled.arrays import Array
from sme_registry.envs.episodes import Episode, Episodes
from sme_registry.errors import PolicyError
from sme_registry.evaluation import (
    EvaluationReport,
    StreamReport,
    dynamic_regret,
    evaluate,
    evaluate_stream,
    reference_regret,
)
from sme_registry.evaluation.evaluate import OnBatch
from sme_registry.io import is_installed
from sme_registry.io.system import defer_interrupts
from sme_registry.io.terminal import Progress
from sme_registry.plots import reports as plot_files
from sme_registry.plots.maps import STREAM
from sme_registry.spec import StreamSpec
from sme_registry.training.algorithms import short_name
from sme_registry.training.record import (
    CHECKPOINT,
    EPISODES,
    SNAPSHOTS,
    TENSORBOARD,
    EpisodeLog,
    RunRecord,
    Snapshots,
    read_episodes,
)

_RECENT = 20  # episodes in the running mean that the progress shows


class Watch:
    """What is called while a learner learns; `RunLog` of a run, and others of a study's cells.

    Attributes:
      pauses: whether `on_pause` does anything, for which a model must take SB3's callbacks.
    """

    pauses = False

    def on_steps(self) -> None:
        """The learner's environments have taken one or more steps."""

    def on_visit(self, visit: int) -> None:
        """A visit of a stream's phase has ended."""

    def on_pause(self) -> None:
        """The learner has learned from all its steps: a checkpoint may be saved."""

    def prepare(self, note: str) -> None:
        """The learner does something else before its first steps, such as compiling."""

    def prepared(self) -> None:
        """It is done."""


class Learner(Protocol):
    """What learns in environments of its own: of Stable-Baselines3, in JAX, or a function.

    Attributes:
      steps: environment steps so far.
      total: environment steps at the end; on-policy algorithms collect whole rollouts.
      model: the trained policy, as `evaluate` takes it.
    """

    @property
    def steps(self) -> int: ...
    @property
    def total(self) -> int: ...
    @property
    def model(self) -> Any: ...

    def learn(self, watch: Watch) -> None:
        """Take the steps of the run that are left; ValueError where weights are not finite."""

    def add_to(self, sums: Episodes) -> list[Episode]:
        """Add the steps since the last call to sums; returns the episodes that ended in them."""

    def is_finite(self) -> bool:
        """Whether all its weights are finite."""

    def restore(self, checkpoint: Path) -> Array | None:
        """Go on from a checkpoint; returns the sums of the present episodes if these go on, too."""

    def save_checkpoint(self, path: Path, sums: Array) -> None:
        """Write a checkpoint, whole or not at all; `sums` are of the present episodes."""

    def save(self, path: Path) -> None:
        """Write the model; nothing of one that cannot be saved."""

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
        log.record().write(folder)
    return log.record(), log.episodes


class RunLog(Watch):
    """The log, the record and the displayed progress of a run, while it trains."""

    pauses = True

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
            (console or Console(stderr=True)).print(
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
        self._wall_before, self._start = self._wall_seconds, time.monotonic()
        self._progress.__exit__(*error)
        self._log.close()

    @property
    def episodes(self) -> list[Episode]:
        """All finished episodes, also those of earlier sessions."""
        return self._log.episodes

    def prepare(self, note: str) -> None:
        """Show what precedes or slows the first steps; see `Progress.prepare`."""
        self._progress.prepare(note)

    def prepared(self) -> None:
        """Measure the displayed rate from here on, if it is not measured yet."""
        self._progress.prepared()

    def on_steps(self) -> None:
        """Log the episodes that ended, and show how far the run is."""
        finished = self._learner.add_to(self._sums)
        for episode in finished:
            by_agent = (episode.agents_regret or (episode.regret,)) if self._agents else ()
            number = len(self.episodes) + 1
            self._log.add(episode._replace(episode=number, agents_regret=by_agent))
        if finished:
            self._note = self._progress_note()
            self._learner.log(finished)
        self._progress.update(self._sums.steps, self._note)

    def on_visit(self, visit: int) -> None:
        """Write the model of the visit."""
        assert self._snapshots is not None  # a task has no visits
        self._learner.save(self._snapshots.visits[visit])

    def on_pause(self) -> None:
        """Write a checkpoint if enough steps have passed since the last, or at the end."""
        steps = self._sums.steps
        due = steps - self._last_checkpoint >= self._record.checkpoint_every
        if not due and steps < self._learner.total:
            return
        self.check_finite()
        with defer_interrupts():
            self._learner.save_checkpoint(self._folder / CHECKPOINT, self._sums.sums)
            self.record().write(self._folder)
        self._last_checkpoint = steps

    def record(self) -> RunRecord:
        """The record with its present progress."""
        seconds, steps = self._wall_seconds, self._sums.steps
        return self._record.updated(
            steps_done=steps,
            episodes=len(self.episodes),
            wall_seconds=round(seconds, 3),
            steps_per_second=round(steps / max(seconds, 1e-9), 3),
        )

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
        """Seconds of training over all sessions."""
        return self._wall_before + time.monotonic() - self._start

    def _progress_note(self) -> str:
        """The phase of a stream, and the mean regret of the last episodes."""
        notes, stream, recent = [], self._record.stream, self.episodes[-_RECENT:]
        if stream is not None:
            notes.append(
                f"phase {stream.segments[stream.times.segment_at(self._sums.steps)].phase}"
            )
        if recent:
            regret = np.mean([episode.regret for episode in recent])
            whose = "team's mean regret" if self._agents else "mean regret"
            costs = [episode.safety.cost for episode in recent if episode.safety is not None]
            cost = f", cost {np.mean(costs):.3f}" if costs else ""
            notes.append(f"{whose} {regret:.3f}{cost} (last {len(recent)} episodes)")
        return ", ".join(notes)


EVALUATION = "evaluation.json"
REPORT_FILES = (EVALUATION, STREAM, *plot_files.FILES)


def write_report(
    model: Any,
    record: RunRecord,
    episodes: Sequence[Episode],
    folder: Path,
    progress: bool,
    console: Console | None,
) -> tuple[EvaluationReport | StreamReport, tuple[Path, ...]]:
    """Evaluate a finished run; write its report, and its figures if Matplotlib is installed."""
    states = record.protocol.states_per_region * len(record.protocol.edges)
    with Progress("evaluating", states, console=console, unit="states", enabled=progress) as bar:

        def on_batch(done: int, total: int) -> None:
            bar.update(done)

        if record.stream is not None:
            report = _evaluate_life(record, record.stream, folder, on_batch)
            report.write(folder / STREAM)
            return report, _draw(report, episodes, folder, model)
        evaluated = evaluate(
            model,
            record.spec,
            record.protocol,
            action_range=record.action_range,
            name=f"{'independent ' * record.independent}{short_name(record.algorithm)}",
            progress=on_batch,
        )
    evaluated.write(folder / EVALUATION)
    return evaluated, _draw(evaluated, episodes, folder, model)


def _evaluate_life(
    record: RunRecord, stream: StreamSpec, folder: Path, on_batch: OnBatch
) -> StreamReport:
    files = Snapshots(folder / SNAPSHOTS, stream)
    report = evaluate_stream(
        files.visits,
        stream,
        record.protocol,
        initial=files.initial,
        action_range=record.action_range,
        name=short_name(record.algorithm),
        progress=on_batch,
    )
    episodes = read_episodes(folder / EPISODES)  # rounded alike in every session
    if not episodes:
        return report
    step, regret, length = zip(*((e.step, e.regret, e.length) for e in episodes), strict=True)
    log = dynamic_regret(stream, step, regret, length)
    frozen: dict[str, Any] = {"frozen": files.visits[0], "training": log}
    if log.visits[0].online_regret is None:  # where no episode of the first visit is in the log
        frozen = {}
    references = reference_regret(stream, **frozen)
    return report.with_dynamic_regret(log).with_reference_regret(references)


def _draw(
    report: EvaluationReport | StreamReport, episodes: Sequence[Episode], folder: Path, model: Any
) -> tuple[Path, ...]:
    if not is_installed("matplotlib"):
        return ()
    figures: list[Path] = []
    if episodes:
        title = f"{report.policy} on {report.title}"
        visits = report.visits if isinstance(report, StreamReport) else ()
        costs = episodes[0].safety is not None
        figures += plot_files.write_training(folder / EPISODES, folder, title, visits, costs)
    if isinstance(report, StreamReport):
        return (*figures, *plot_files.write_stream(report, folder))
    return (*figures, *plot_files.write_evaluation(report, folder, model))
