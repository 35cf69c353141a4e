"""`learn` for agents in JAX: the same files as `learn`, from a program of one lane.

Its checkpoint holds everything, so a run that is resumed continues with the same bits.

Imports JAX and Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from stable_baselines3.common.logger import configure

from sme_registry.envs.episodes import Episode
from sme_registry.errors import OptionError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import is_installed, read_arrays, write_arrays, write_atomically
from sme_registry.io.system import defer_interrupts
from sme_registry.jax import run as jax_run
from sme_registry.jax.program import Program, StepLog
from sme_registry.sb3.vec_env import log_episode
from sme_registry.training.learn import RunLog, not_finite
from sme_registry.training.models import new_sb3_model, set_weights, unloadable
from sme_registry.training.record import (
    CHECKPOINT,
    MODEL,
    SNAPSHOTS,
    TENSORBOARD,
    RunRecord,
    Snapshots,
)

_PIECE = 100  # steps between two reports of progress, and the longest wait for Ctrl-C
_EPISODE = "episode"  # of the checkpoint: the sums of the present episode


class Agent(NamedTuple):
    """A program of one lane, and the model of Stable-Baselines3 that gets its weights."""

    program: Program
    model: Any


def new_model(record: RunRecord) -> Agent:
    """The program of a run and its model, untrained."""
    program = jax_run.new_program(
        record.algorithm,
        [record.document],
        [record.seed],
        hyperparameters=record.hyperparameters,
        action_range=record.action_range,
        steps=record.steps,
        device=record.device or None,
    )
    model = new_sb3_model(
        record.algorithm,
        record.document,
        seed=record.seed,
        action_range=record.action_range,
        hyperparameters=record.hyperparameters,
        steps=record.steps,
    )
    return Agent(program, model)


def learn(
    agent: Agent, record: RunRecord, folder: Path, progress: bool, console: Console | None
) -> tuple[RunRecord, list[Episode], Any]:
    """Train and write a model; see `training.learn.learn`."""
    program, model = agent
    present = np.zeros(4 if record.spec.safety is None else 7)
    path = folder / CHECKPOINT
    if record.sessions > 1 and path.exists():
        try:
            arrays = read_arrays(path)
            present = arrays.pop(_EPISODE)
            program.restore(arrays)
        except (KeyError, OptionError) as error:
            raise unloadable(path, error.__cause__ or error) from None
    total = -(-max(record.steps, program.steps) // program.rollout) * program.rollout
    board = _Board(folder / TENSORBOARD)
    begin, piece = program.steps, min(_PIECE, record.checkpoint_every)
    with RunLog(record, folder, begin, total, progress, console) as log:
        log.prepare("compiling …")
        sums = log.sums.sums[: len(present), 0, 0]
        sums[:] = present

        def save() -> None:
            log.save_checkpoint(lambda path: write_arrays(path, {**program.save(), _EPISODE: sums}))

        def on_log(steps: StepLog) -> None:
            _check_finite(program, folder)
            ended = np.logical_or(steps.terminated, steps.truncated)
            info = {name: value for name, value in steps._asdict().items() if value is not None}
            finished = log.add(log.sums.add(steps.reward, info, steps.terminated, ended))
            if program.steps - begin > max(piece, program.rollout):
                log.prepared()  # PPO's updates are compiled in the second piece
            board.add(program.steps, finished)

        def after_piece() -> None:
            if log.is_checkpoint_due() or program.steps >= program.budget:
                save()

        on_visit = _on_visit(agent, record, folder)
        jax_run.run(program, on_log=on_log, on_visit=on_visit, after_piece=after_piece, piece=piece)
        _check_finite(program, folder)
    board.close()
    set_weights(model, program.weights(0), program.steps)
    with defer_interrupts():
        write_atomically(folder / MODEL, saved_sb3(model))
        log.record().write(folder)
    return log.record(), log.episodes, model


def _on_visit(agent: Agent, record: RunRecord, folder: Path) -> Any:
    """What writes the snapshots of a life in a stream; None for a task."""
    if record.stream is None:
        return None
    program, model = agent
    snapshots = Snapshots(folder / SNAPSHOTS, record.stream)

    def on_visit(visit: int, weights: list[dict[str, Any]]) -> None:
        set_weights(model, weights[0], program.steps)
        snapshots.write(visit, model)

    if program.steps == 0:
        set_weights(model, program.weights(0), 0)
        snapshots.write_initial(model)
    return on_visit


def _check_finite(program: Program, folder: Path) -> None:
    if program.failed()[0]:
        raise not_finite(program.steps, folder)


class _Board:
    """TensorBoard's log of finished episodes, if it is installed."""

    def __init__(self, folder: Path) -> None:
        installed = is_installed("tensorboard")
        self._logger = configure(str(folder), ["tensorboard"]) if installed else None

    def add(self, step: int, episodes: Sequence[Episode]) -> None:
        """Log the means of the episodes that ended in a piece."""
        if self._logger is None or not episodes:
            return
        for episode in episodes:
            self._logger.record_mean("rollout/ep_rew_mean", episode.episode_return)
            self._logger.record_mean("rollout/ep_len_mean", episode.length)
            log_episode(self._logger, episode)
        self._logger.dump(step)

    def close(self) -> None:
        """Write what is left."""
        if self._logger is not None:
            self._logger.close()
