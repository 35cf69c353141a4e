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
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor

from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import is_installed, write_atomically
from sme_registry.io.system import defer_interrupts
from sme_registry.io.terminal import Progress
from sme_registry.sb3 import EpisodeRegret, EpisodeSums, RegretCallback, SMETeamVecEnv, SMEVecEnv
from sme_registry.training import checkpoint
from sme_registry.training import episodes as episode_files
from sme_registry.training.algorithms import is_sb3, short_name, silence
from sme_registry.training.episodes import Episode, EpisodeLog
from sme_registry.training.independent import IndependentLearners
from sme_registry.training.learners import new_learner
from sme_registry.training.record import MODEL, MODELS, TENSORBOARD, RunRecord
from sme_registry.training.snapshots import FOLDER as SNAPSHOTS
from sme_registry.training.snapshots import Snapshots
from sme_registry.training.visits import VisitEnds

_RECENT = 20  # episodes in the running mean that the progress shows


def new_model(record: RunRecord) -> Any:
    """The untrained model of a run, with its environment; `IndependentLearners` for such a team."""
    if record.independent:
        return IndependentLearners(record)
    env_class = SMEVecEnv if record.spec.team is None else SMETeamVecEnv
    env = VecMonitor(env_class(record.document, record.num_envs, action_range=record.action_range))  # type: ignore[arg-type, unused-ignore]
    model: Any = new_learner(
        record.algorithm,
        env,
        seed=record.seed,
        steps=record.steps * record.agents,
        hyperparameters=record.hyperparameters,
        field="algorithm",
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
    learners: IndependentLearners, record: RunRecord, first_step: int, log: RunLog
) -> None:
    sums = EpisodeSums(learners.env.num_envs, record.agents)

    def on_step(rewards: Any, dones: Any, infos: list[dict[str, Any]]) -> None:
        finished = sums.add(learners.num_timesteps, rewards, dones, infos)
        log.add(learners.num_timesteps, finished)
        for episode in finished:
            by_agent = episode.agents_regret or (episode.regret,)
            for model, regret in zip(learners.models.values(), by_agent, strict=True):
                model.logger.record_mean("rollout/regret", regret)

    def on_rollout() -> None:
        if log.is_checkpoint_due():
            _save_checkpoint(learners, log)

    learners.learn(record.steps, on_step, on_rollout)


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
    independent = isinstance(model, IndependentLearners)
    log.save_checkpoint(
        model.save_checkpoint if independent else lambda path: checkpoint.save(model, path)
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
    path = folder / checkpoint.FILE
    kept = f"{path} is its last checkpoint" if path.exists() else "it has no checkpoint"
    return PolicyError(
        f"training: {failure}. The run stays in {folder}; {kept}. Train into another folder with "
        "other hyperparameters, such as a lower learning_rate."
    )


def _write_model(model: Any, folder: Path) -> None:
    if isinstance(model, IndependentLearners):
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
        self._log = EpisodeLog(folder / episode_files.FILE, first_step, names)
        self._wall_before = self.episodes[-1].wall_seconds if self.episodes else 0.0
        self._steps = self._last_checkpoint = first_step
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
    def episodes(self) -> list[Episode]:
        """All finished episodes, also those of earlier sessions."""
        return self._log.episodes

    def prepare(self, note: str) -> None:
        """Show what precedes or slows the first steps; see `Progress.prepare`."""
        self._progress.prepare(note)

    def prepared(self) -> None:
        """Measure the displayed rate from here on, if it is not measured yet."""
        self._progress.prepared()

    def add(self, steps: int, finished: Sequence[EpisodeRegret]) -> None:
        """Log the episodes that finished after so many environment steps of the whole run."""
        self._steps = steps
        for episode in finished:
            by_agent = episode.agents_regret or (episode.regret,)
            self._log.add(
                Episode(
                    episode=len(self.episodes) + 1,
                    step=steps,
                    episode_return=episode.episode_return,
                    length=episode.length,
                    regret=episode.regret,
                    similarity=episode.similarity,
                    terminated=int(episode.terminated),
                    wall_seconds=round(self._wall_seconds, 3),
                    agents_regret=by_agent if self._log.agents else (),
                    safety=episode.safety,
                )
            )
        if finished:
            self._note = self._progress_note()
        self._progress.update(steps, self._note)

    def record(self) -> RunRecord:
        """The record with its present progress."""
        seconds = self._wall_seconds
        return self._record.updated(
            steps_done=self._steps,
            episodes=len(self.episodes),
            wall_seconds=round(seconds, 3),
            steps_per_second=round(self._steps / max(seconds, 1e-9), 3),
        )

    def is_checkpoint_due(self) -> bool:
        """Whether enough steps have passed since the last checkpoint."""
        return self._steps - self._last_checkpoint >= self._record.checkpoint_every

    def save_checkpoint(self, save: Callable[[Path], None]) -> None:
        """Write the checkpoint with `save`, and the record."""
        with defer_interrupts():
            save(self._folder / checkpoint.FILE)
            self.record().write(self._folder)
        self._last_checkpoint = self._steps

    def not_finite(self) -> PolicyError:
        """The error for weights that are not finite; see the function."""
        return not_finite(self._steps, self._folder)

    @property
    def _wall_seconds(self) -> float:
        """Seconds of training over all sessions."""
        return self._wall_before + time.monotonic() - self._start

    def _progress_note(self) -> str:
        """The phase of a stream, and the mean regret of the last episodes."""
        notes, stream, recent = [], self._record.stream, self.episodes[-_RECENT:]
        if stream is not None:
            notes.append(f"phase {stream.pieces[stream.piece_at(self._steps)].phase}")
        if recent:
            regret = np.mean([episode.regret for episode in recent])
            whose = "team's mean regret" if self._log.agents else "mean regret"
            costs = [episode.safety.cost for episode in recent if episode.safety is not None]
            cost = f", cost {np.mean(costs):.3f}" if costs else ""
            notes.append(f"{whose} {regret:.3f}{cost} (last {len(recent)} episodes)")
        return ", ".join(notes)


class _Callback(RegretCallback):
    """Logs finished episodes, saves checkpoints and updates the progress during SB3's training."""

    def __init__(self, model: Any, log: RunLog, visits: VisitEnds | None) -> None:
        super().__init__()
        self.model, self._log, self._logged, self._visits = model, log, 0, visits

    def _on_rollout_start(self) -> None:
        # Between rollouts the model is consistent: it has learnt from all transitions, and they are
        # in its replay buffer. For off-policy algorithms that is after each environment step.
        if self._log.is_checkpoint_due():
            _save_checkpoint(self.model, self._log)

    def _on_step(self) -> bool:
        super()._on_step()
        if self._visits is not None:
            self._visits.after_step(self.steps)
        self._log.add(self.steps, self.episodes[self._logged :])
        self._logged = len(self.episodes)
        return True


def _continued(model: Any, record: RunRecord, folder: Path) -> Any:
    """The model of the checkpoint if the run is resumed, or the new one."""
    path = folder / checkpoint.FILE
    if record.sessions == 1 or not path.exists():
        return model
    if isinstance(model, IndependentLearners):
        model.load_checkpoint(path)
        return model
    changes: dict[str, Any] = {}
    if hasattr(model, "buffer_size"):
        changes["buffer_size"] = model.buffer_size
    model = checkpoint.load(type(model), path, model.env, **changes)
    # Another stream than the first session's, but the same whenever this session is repeated.
    sequence = np.random.SeedSequence([record.seed, model.num_timesteps])
    model.set_random_seed(int(sequence.generate_state(1)[0] >> 1))
    if record.stream is not None:  # a seed begins a new life, here where the checkpoint was
        model.env.set_options({"lifetime": int(model.num_timesteps)})
    return model


def _models(model: Any) -> list[Any]:
    return list(model.models.values()) if isinstance(model, IndependentLearners) else [model]


def _set_loggers(model: Any, folder: Path) -> None:
    """Log to TensorBoard in a folder if it is installed, or nowhere; each agent in its own."""
    for each in _models(model):
        silence(each)
    if is_installed("tensorboard"):
        folders = (
            {folder / name: each for name, each in model.models.items()}
            if isinstance(model, IndependentLearners)
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
