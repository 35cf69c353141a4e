"""`learn`: the training of a run, from its start or from its last checkpoint.

Each finished episode is logged with its exact regret, and checkpoints are saved on the way.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor

from sme_registry.envs.episodes import Episode, Episodes
from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import is_installed, write_atomically
from sme_registry.io.system import defer_interrupts
from sme_registry.io.terminal import Progress
from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv
from sme_registry.sb3.vec_env import finished_in, log_episode
from sme_registry.training.algorithms import is_sb3, short_name, silence
from sme_registry.training.learners import CountedVecEnv, IndependentModels
from sme_registry.training.models import load_checkpoint, save_checkpoint
from sme_registry.training.models import new_model as new_sb3_model
from sme_registry.training.record import (
    CHECKPOINT,
    EPISODES,
    MODEL,
    MODELS,
    SNAPSHOTS,
    TENSORBOARD,
    EpisodeLog,
    RunRecord,
    Snapshots,
    VisitEnds,
)

_RECENT = 20  # episodes in the running mean that the progress shows


def new_model(record: RunRecord) -> Any:
    """The untrained model of a run, with its environment; `IndependentModels` for such a team."""
    options: dict[str, Any] = {"seed": record.seed, "hyperparameters": record.hyperparameters}
    if record.independent:
        team = SMETeamVecEnv(record.spec, record.num_envs, action_range=record.action_range)
        counted = CountedVecEnv(team)
        return IndependentModels(record.algorithm, counted, steps=record.steps, **options)
    env_class = SMEVecEnv if record.spec.team is None else SMETeamVecEnv
    env = VecMonitor(env_class(record.document, record.num_envs, action_range=record.action_range))  # type: ignore[arg-type, unused-ignore]
    transitions = record.steps * record.agents
    model: Any = new_sb3_model(
        record.algorithm, env, steps=transitions, field="algorithm", **options
    )
    if not is_sb3(model):
        raise OptionError(
            f"algorithm={record.algorithm!r}: returned a {type(model).__name__}, which is no model "
            "of Stable-Baselines3, so its training cannot be logged or resumed. Train it in a "
            f"study: `sme study new plan.json -t TASK -a {record.algorithm}`."
        )
    return model


def learn(
    model: Any, record: RunRecord, folder: Path, progress: bool, console: Console | None
) -> tuple[RunRecord, list[Episode], Any]:
    """Train and write a model."""
    env = model.env
    model = _continued(model, record, folder)
    lanes_of_a_step = 1 if record.independent else record.agents  # SB3 counts each agent's steps
    first_step = int(model.num_timesteps) // lanes_of_a_step
    total = _total_steps(record, model, first_step)
    _set_loggers(model, folder / TENSORBOARD)
    visits = _visits(model, record, folder, first_step)
    with RunLog(record, folder, first_step, total, progress, console) as log:
        if first_step < record.steps:
            try:
                if record.independent:
                    _train_independent(model, record, first_step, log)
                else:
                    _train(model, record, first_step, log, visits)
            except ValueError:  # of our environments or of PyTorch, where actions are NaN
                _check_finite(model, log)
                raise
            _save_checkpoint(model, log)
    for each in _models(model):
        each.logger.close()
    env.close()
    if visits is not None:
        visits.finish(log.record().steps_done)
    with defer_interrupts():
        _write_model(model, folder)
        log.record().write(folder)
    return log.record(), log.episodes, model.models if record.independent else model


def _train(
    model: Any, record: RunRecord, first_step: int, log: RunLog, visits: VisitEnds | None
) -> None:
    model.learn(
        (record.steps - first_step) * record.agents,
        callback=_Callback(model, log, visits),
        reset_num_timesteps=first_step == 0,
    )


def _train_independent(
    learners: IndependentModels, record: RunRecord, first_step: int, log: RunLog
) -> None:
    def after_step(steps: int) -> None:
        for episode in log.add(finished_in(log.sums, *learners.env.last)):
            by_agent = episode.agents_regret or (episode.regret,)
            for model, regret in zip(learners.models.values(), by_agent, strict=True):
                model.logger.record_mean("rollout/regret", regret)

    def on_rollout() -> None:
        if log.is_checkpoint_due():
            _save_checkpoint(learners, log)

    learners.env.after_step = after_step
    learners.learn(record.steps, on_rollout)


def _visits(model: Any, record: RunRecord, folder: Path, first_step: int) -> VisitEnds | None:
    """What writes the snapshots of a life in a stream; None for a task."""
    if record.stream is None:
        return None
    snapshots = Snapshots(folder / SNAPSHOTS, record.stream)
    if first_step == 0:
        snapshots.write_initial(model)
    return VisitEnds(record.stream, lambda visit: snapshots.write(visit, model), first_step)


def _save_checkpoint(model: Any, log: RunLog) -> None:
    _check_finite(model, log)
    independent = isinstance(model, IndependentModels)
    log.save_checkpoint(
        model.save_checkpoint if independent else lambda path: save_checkpoint(model, path)
    )


def _check_finite(model: Any, log: RunLog) -> None:
    parameters = (each for one in _models(model) for each in one.policy.parameters())
    # Squared: products of weights that are finite and huge are not, and nor are the actions.
    if not all(bool(torch.isfinite(each.square()).all()) for each in parameters):
        raise log.not_finite()


def not_finite(steps: int, folder: Path) -> PolicyError:
    """The error for a run whose weights are NaN or infinite; its record says that it failed."""
    failure = f"the weights are not finite any longer at step {steps:,}"
    record = RunRecord.read(folder)  # of its last checkpoint
    if record is not None:
        record.updated(status="failed", failure=failure).write(folder)
    path = folder / CHECKPOINT
    kept = f"{path} is its last checkpoint" if path.exists() else "it has no checkpoint"
    return PolicyError(
        f"training: {failure}. The run stays in {folder}; {kept}. Train into another folder with "
        "other hyperparameters, such as a lower learning_rate."
    )


def _write_model(model: Any, folder: Path) -> None:
    if isinstance(model, IndependentModels):
        model.save(folder / MODELS)
        return
    write_atomically(folder / MODEL, saved_sb3(model))


class RunLog:
    """The log, the record and the displayed progress of a run, while it trains."""

    def __init__(
        self,
        record: RunRecord,
        folder: Path,
        first_step: int,
        total: int,
        progress: bool,
        console: Console | None,
    ) -> None:
        team = record.spec.team
        names = () if team is None else tuple(agent.name for agent in team.agents)
        self._record, self._folder = record, folder
        self._log = EpisodeLog(folder / EPISODES, first_step, names)
        self._wall_before = self.episodes[-1].wall_seconds if self.episodes else 0.0
        self._last_checkpoint = first_step
        self.sums = Episodes(
            record.num_envs,
            record.agents,
            lambda: record.spec,
            steps=first_step,
            clock=lambda: self._wall_seconds,
        )
        name = short_name(record.algorithm)
        if progress and total > max(first_step, record.steps):
            (console or Console(stderr=True)).print(
                f"{name} collects whole rollouts: {total:,} steps, not {record.steps:,}.",
                style="dim",
            )
        self._progress = Progress(
            f"training {name}", total, done=first_step, console=console, enabled=progress
        )

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
    def agents(self) -> Sequence[str]:
        """Names of a team's agents; none for a single agent."""
        return self._log.agents

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

    @property
    def steps(self) -> int:
        """Environment steps of the whole run so far."""
        return self.sums.steps

    def add(self, finished: Sequence[Episode]) -> Sequence[Episode]:
        """Log the episodes that ended in the last steps, and return them."""
        for episode in finished:
            by_agent = (episode.agents_regret or (episode.regret,)) if self._log.agents else ()
            number = len(self.episodes) + 1
            self._log.add(episode._replace(episode=number, agents_regret=by_agent))
        if finished:
            self._note = self._progress_note()
        self._progress.update(self.steps, self._note)
        return finished

    def record(self) -> RunRecord:
        """The record with its present progress."""
        seconds = self._wall_seconds
        return self._record.updated(
            steps_done=self.steps,
            episodes=len(self.episodes),
            wall_seconds=round(seconds, 3),
            steps_per_second=round(self.steps / max(seconds, 1e-9), 3),
        )

    def is_checkpoint_due(self) -> bool:
        """Whether enough steps have passed since the last checkpoint."""
        return self.steps - self._last_checkpoint >= self._record.checkpoint_every

    def save_checkpoint(self, save: Callable[[Path], None]) -> None:
        """Write the checkpoint with `save`, and the record."""
        with defer_interrupts():
            save(self._folder / CHECKPOINT)
            self.record().write(self._folder)
        self._last_checkpoint = self.steps

    def not_finite(self) -> PolicyError:
        """The error for weights that are not finite; see the function."""
        return not_finite(self.steps, self._folder)

    @property
    def _wall_seconds(self) -> float:
        """Seconds of training over all sessions."""
        return self._wall_before + time.monotonic() - self._start

    def _progress_note(self) -> str:
        """The phase of a stream, and the mean regret of the last episodes."""
        notes, stream, recent = [], self._record.stream, self.episodes[-_RECENT:]
        if stream is not None:
            notes.append(f"phase {stream.pieces[stream.piece_at(self.steps)].phase}")
        if recent:
            regret = np.mean([episode.regret for episode in recent])
            whose = "team's mean regret" if self._log.agents else "mean regret"
            costs = [episode.safety.cost for episode in recent if episode.safety is not None]
            cost = f", cost {np.mean(costs):.3f}" if costs else ""
            notes.append(f"{whose} {regret:.3f}{cost} (last {len(recent)} episodes)")
        return ", ".join(notes)


class _Callback(BaseCallback):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Logs finished episodes, saves checkpoints and updates the progress during SB3's training."""

    def __init__(self, model: Any, log: RunLog, visits: VisitEnds | None) -> None:
        super().__init__()
        self.model, self._log, self._visits = model, log, visits

    def _on_rollout_start(self) -> None:
        # Between rollouts the model is consistent: it has learnt from all transitions, and they are
        # in its replay buffer. For off-policy algorithms that is after each environment step.
        if self._log.is_checkpoint_due():
            _save_checkpoint(self.model, self._log)

    def _on_step(self) -> bool:
        step = (self.locals[name] for name in ("rewards", "dones", "infos"))
        finished = finished_in(self._log.sums, *step)
        if self._visits is not None:
            self._visits.after_step(self._log.steps)
        agents = self._log.agents
        for episode in self._log.add(finished):
            log_episode(self.logger, episode, agents if len(agents) > 1 else ())
        return True


def _continued(model: Any, record: RunRecord, folder: Path) -> Any:
    """The model of the checkpoint if the run is resumed, or the new one."""
    path = folder / CHECKPOINT
    if record.sessions == 1 or not path.exists():
        return model
    if isinstance(model, IndependentModels):
        model.load_checkpoint(path)
        return model
    changes: dict[str, Any] = {}
    if hasattr(model, "buffer_size"):
        changes["buffer_size"] = model.buffer_size
    model = load_checkpoint(type(model), path, model.env, **changes)
    # Another stream than the first session's, but the same whenever this session is repeated.
    sequence = np.random.SeedSequence([record.seed, model.num_timesteps])
    model.set_random_seed(int(sequence.generate_state(1)[0] >> 1))
    if record.stream is not None:  # a seed begins a new life, here where the checkpoint was
        model.env.set_options({"lifetime": int(model.num_timesteps)})
    return model


def _models(model: Any) -> list[Any]:
    return list(model.models.values()) if isinstance(model, IndependentModels) else [model]


def _set_loggers(model: Any, folder: Path) -> None:
    """Log to TensorBoard in a folder if it is installed, or nowhere; each agent in its own."""
    for each in _models(model):
        silence(each)
    if is_installed("tensorboard"):
        folders = (
            {folder / name: each for name, each in model.models.items()}
            if isinstance(model, IndependentModels)
            else {folder: model}
        )
        for own_folder, each in folders.items():
            each.set_logger(configure(str(own_folder), ["tensorboard"]))


def _total_steps(record: RunRecord, model: Any, first_step: int) -> int:
    """Steps at the end of the run: on-policy algorithms collect whole rollouts."""
    on_policy = record.independent or hasattr(model, "rollout_buffer")
    rollout = model.n_steps if on_policy else 1
    chunk = rollout * record.num_envs
    return first_step + int(-(-max(0, record.steps - first_step) // chunk)) * chunk
