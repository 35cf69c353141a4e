"""`learn`: the training of a run, from its start or from its last checkpoint.

Each finished episode is logged with its exact regret, and checkpoints are saved on the way.

Imports Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

from sme_registry.evaluation.policies import saved_sb3
from sme_registry.io import is_installed, write_atomically
from sme_registry.sb3 import SMETeamVecEnv, SMEVecEnv
from sme_registry.terminal.interrupts import defer_interrupts
from sme_registry.terminal.progress import Progress
from sme_registry.training import checkpoint
from sme_registry.training import episodes as episode_files
from sme_registry.training.algorithms import load_algorithm, replay_settings, rollout_steps
from sme_registry.training.episodes import Episode, EpisodeLog
from sme_registry.training.record import MODEL, TENSORBOARD, RunRecord

_RECENT = 20  # episodes in the running mean that the progress shows


def learn(
    record: RunRecord, folder: Path, progress: bool, console: Console | None
) -> tuple[RunRecord, list[Episode], Any]:
    """Train and write a model; returns the record with its progress, all episodes, and the model.

    Raises:
      PolicyError: the checkpoint cannot be loaded.
      OptionError: a file cannot be written.
    """
    env = _new_env(record)
    model = _model(record, env, folder)
    first_step = int(model.num_timesteps) // record.agents  # SB3 counts each agent's steps
    team = record.spec.team
    names = () if team is None else tuple(agent.name for agent in team.agents)
    log = EpisodeLog(folder / episode_files.FILE, first_step, names)

    title, total = f"training {record.algorithm}", _total_steps(record, model, first_step)
    with Progress(title, total, done=first_step, console=console, enabled=progress) as bar:
        callback = _Callback(model, record, folder, log, bar)
        try:
            if first_step < record.steps:
                model.learn(
                    (record.steps - first_step) * record.agents,
                    callback=callback,
                    reset_num_timesteps=first_step == 0,
                    tb_log_name="run",
                )
                callback.save_checkpoint()
        finally:
            log.close()
            env.close()
    record = callback.record()
    with defer_interrupts():
        write_atomically(folder / MODEL, saved_sb3(model))
        record.write(folder)
    return record, log.episodes, model


class _Callback(BaseCallback):  # type: ignore[misc, unused-ignore]  # untyped without SB3
    """Logs finished episodes, saves checkpoints and updates the progress during SB3's training.

    SB3 counts one step for each agent of a team; here and in all files a step is one of the team.
    The lanes of a team's agents are adjacent.
    """

    def __init__(
        self, model: Any, record: RunRecord, folder: Path, log: EpisodeLog, progress: Progress
    ) -> None:
        super().__init__()
        self.model = model
        self._record, self._folder = record, folder
        self._log, self._progress = log, progress
        self._wall_before = log.episodes[-1].wall_seconds if log.episodes else 0.0
        self._start = time.monotonic()

    def record(self) -> RunRecord:
        """The record with its present progress."""
        steps, seconds = self._steps_done, self._wall_seconds
        return self._record.updated(
            steps_done=steps,
            episodes=len(self._log.episodes),
            wall_seconds=round(seconds, 3),
            steps_per_second=round(steps / max(seconds, 1e-9), 3),
        )

    def save_checkpoint(self) -> None:
        """Write the checkpoint and the record."""
        with defer_interrupts():
            checkpoint.save(self.model, self._folder / checkpoint.FILE)
            self.record().write(self._folder)

    @property
    def _wall_seconds(self) -> float:
        """Seconds of training over all sessions."""
        return self._wall_before + time.monotonic() - self._start

    @property
    def _steps_done(self) -> int:
        """Environment steps of the whole run over all environments."""
        return int(self.model.num_timesteps) // self._record.agents

    def _on_training_start(self) -> None:
        # return, length, sum of regret and sum of similarity of the current episode in each lane
        self._sums = np.zeros((4, self.training_env.num_envs))
        self._last_checkpoint = self._steps_done
        self._start = time.monotonic()
        self._note = self._running_mean()

    def _on_rollout_start(self) -> None:
        # Between rollouts the model is consistent: it has learnt from all transitions, and they are
        # in its replay buffer. For off-policy algorithms that is after each environment step.
        if self._steps_done - self._last_checkpoint >= self._record.checkpoint_every:
            self.save_checkpoint()
            self._last_checkpoint = self._steps_done

    def _on_step(self) -> bool:
        infos, dones = self.locals["infos"], self.locals["dones"]
        self._sums[0] += self.locals["rewards"]
        self._sums[1] += 1.0
        self._sums[2] += [info["regret"] for info in infos]
        self._sums[3] += [info["similarity"] for info in infos]
        # The lanes of a team end together, so checking the first one is enough.
        agents = self._record.agents
        for lane in np.flatnonzero(dones[::agents]) * agents:
            self._log_episode(int(lane), int(not infos[lane]["TimeLimit.truncated"]))
        if dones.any():
            self._note = self._running_mean()
        self._progress.update(self._steps_done, self._note)
        return True

    def _log_episode(self, lane: int, terminated: int) -> None:
        """Log the episode that ended in this lane, or in a team's lanes from this one on."""
        lanes = slice(lane, lane + self._record.agents)
        returned, length, regret, similarity = self._sums[:, lanes].mean(axis=1).tolist()
        regrets = (self._sums[2, lanes] / length).tolist() if self._log.agents else []
        self._sums[:, lanes] = 0.0
        self._log.add(
            Episode(
                episode=len(self._log.episodes) + 1,
                step=self._steps_done,
                episode_return=returned,
                length=int(length),
                regret=regret / length,
                similarity=similarity / length,
                terminated=terminated,
                wall_seconds=round(self._wall_seconds, 3),
                agents_regret=tuple(regrets),
            )
        )
        self.logger.record_mean("sme/regret", regret / length)
        self.logger.record_mean("sme/similarity", similarity / length)
        for agent, value in zip(self._log.agents, regrets, strict=True):
            self.logger.record_mean(f"sme/regret/{agent}", value)

    def _running_mean(self) -> str:
        recent = self._log.episodes[-_RECENT:]
        if not recent:
            return ""
        regret = np.mean([episode.regret for episode in recent])
        whose = "team's mean regret" if self._log.agents else "mean regret"
        return f"{whose} {regret:.3f} (last {len(recent)} episodes)"


def _new_env(record: RunRecord) -> Any:
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
