"""`learn`: the training loop of a run, from its start or from its last checkpoint."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from sme_registry.io import is_installed, write_atomically
from sme_registry.terminal.interrupts import defer_interrupts
from sme_registry.terminal.progress import Progress
from sme_registry.training import checkpoint
from sme_registry.training import episodes as episode_files
from sme_registry.training.algorithms import load_algorithm, replay_settings, rollout_steps
from sme_registry.training.episodes import Episode, EpisodeLog
from sme_registry.training.record import RunRecord

MODEL = "model.zip"
TENSORBOARD = "tensorboard"


def learn(
    record: RunRecord, folder: Path, progress: bool, console: Console | None
) -> tuple[RunRecord, list[Episode], Any]:
    """Train a model and write it, with the record and the log of the run.

    Args:
      record: the run; with more than one session it resumes from the checkpoint.
      folder: of the run.
      progress: whether to show progress.
      console: where to show it; None for standard error.

    Returns:
      The record with its progress, all episodes, and the model.

    Raises:
      PolicyError: the checkpoint cannot be loaded.
      OptionError: a file cannot be written.
    """
    from sme_registry.training.callback import RunCallback

    env = _new_env(record)
    model = _model(record, env, folder)
    first_step = int(model.num_timesteps) // record.agents  # SB3 counts each agent's steps
    team = record.spec.team
    names = () if team is None else tuple(agent.name for agent in team.agents)
    log = EpisodeLog(folder / episode_files.FILE, first_step, names)

    def current() -> RunRecord:
        steps, seconds = int(model.num_timesteps) // record.agents, callback.wall_seconds
        return record.updated(
            steps_done=steps,
            episodes=len(log.episodes),
            wall_seconds=round(seconds, 3),
            steps_per_second=round(steps / max(seconds, 1e-9), 3),
        )

    def save_checkpoint() -> None:
        with defer_interrupts():
            checkpoint.save(model, folder / checkpoint.FILE)
            current().write(folder)

    title, total = f"training {record.algorithm}", _total_steps(record, model, first_step)
    with Progress(title, total, done=first_step, console=console, enabled=progress) as bar:
        callback = RunCallback(log, bar, save_checkpoint, record.checkpoint_every, names)
        try:
            if first_step < record.steps:
                model.learn(
                    (record.steps - first_step) * record.agents,
                    callback=callback,
                    reset_num_timesteps=first_step == 0,
                    tb_log_name="run",
                )
                save_checkpoint()
        finally:
            log.close()
            env.close()
    record = current()
    content = io.BytesIO()
    with defer_interrupts():
        model.save(content)
        write_atomically(folder / MODEL, content.getvalue())
        record.write(folder)
    return record, log.episodes, model


def _new_env(record: RunRecord) -> Any:
    from stable_baselines3.common.vec_env import VecMonitor

    from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv

    env_class = SMEVecEnv if record.spec.team is None else SMETeamVecEnv
    return VecMonitor(env_class(record.spec, record.num_envs, action_range=record.action_range))  # type: ignore[arg-type, unused-ignore]


def _model(record: RunRecord, env: Any, folder: Path) -> Any:
    """A new model, or that of the checkpoint if the run is resumed."""
    algorithm = load_algorithm(record.algorithm)
    settings: dict[str, Any] = {
        "tensorboard_log": str(folder / TENSORBOARD) if is_installed("tensorboard") else None,
        **replay_settings(algorithm, (record.steps + record.num_envs) * record.agents),
    }
    n_steps = rollout_steps(record.spec, record.algorithm, record.num_envs)
    if n_steps is not None:
        settings["n_steps"] = n_steps
    path = folder / checkpoint.FILE
    if record.sessions == 1 or not path.exists():
        return algorithm("MlpPolicy", env, seed=record.seed, device="cpu", **settings)
    model = checkpoint.load(algorithm, path, env, **settings)
    # Another stream than the first session's, but the same whenever this session is repeated.
    sequence = np.random.SeedSequence([record.seed, model.num_timesteps])
    model.set_random_seed(int(sequence.generate_state(1)[0] >> 1))
    return model


def _total_steps(record: RunRecord, model: Any, first_step: int) -> int:
    """Steps at the end of the run: on-policy algorithms collect whole rollouts."""
    rollout = 1 if hasattr(model, "replay_buffer") else model.n_steps
    chunk = rollout * record.num_envs
    return first_step + int(-(-max(0, record.steps - first_step) // chunk)) * chunk
