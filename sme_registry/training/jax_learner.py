"""`JAXLearner`: agents in JAX as a `Learner`, from a program of one run.

Its checkpoint holds everything, so a run that is resumed continues with the same bits.

Imports JAX and Stable-Baselines3; import it inside functions only.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import configure

from sme_registry.envs.episodes import Episode, Episodes
from sme_registry.envs.types import Array
from sme_registry.errors import OptionError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import is_installed, read_arrays, write_arrays, write_atomically
from sme_registry.jax import run as jax_run
from sme_registry.jax.program import StepLog
from sme_registry.sb3.vec_env import log_episode
from sme_registry.training.learn import Watch
from sme_registry.training.models import new_sb3_model, set_weights, unloadable
from sme_registry.training.record import RunRecord

_PIECE = 100  # steps between two reports of progress, and the longest wait for Ctrl-C
_EPISODE = "episode"  # of the checkpoint: the sums of the present episode


class JAXLearner:
    """A program of one run, and the model of Stable-Baselines3 that gets its weights."""

    def __init__(self, record: RunRecord) -> None:
        options: dict[str, Any] = {
            "hyperparameters": record.hyperparameters,
            "action_range": record.action_range,
            "steps": record.steps,
        }
        uses, document, seed = record.algorithm, record.document, record.seed
        device = record.device or None
        self._program = jax_run.new_program(uses, [document], [seed], device=device, **options)
        self._model = new_sb3_model(uses, document, seed=seed, **options)
        self._in_stream = record.stream is not None
        self._steps, self._piece = record.steps, min(_PIECE, record.checkpoint_every)
        self._sums = 4 if record.spec.safety is None else 7
        self._log: StepLog | None = None
        self._logger: Any = None

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self._program.steps)

    @property
    def total(self) -> int:
        """Environment steps at the end: PPO collects whole rollouts."""
        rollout = self._program.rollout
        return -(-max(self._steps, self.steps) // rollout) * rollout

    @property
    def model(self) -> Any:
        """The model of Stable-Baselines3, with the present weights."""
        set_weights(self._model, self._program.weights(0), self.steps)
        return self._model

    def learn(self, watch: Watch) -> None:
        """Take the steps that are left; after each piece of them, `watch.on_steps`."""
        program, begin = self._program, self.steps
        watch.prepare("compiling …")

        def on_log(log: StepLog) -> None:
            self._check_finite()
            self._log = log
            watch.on_steps()
            if program.steps - begin > max(self._piece, program.rollout):
                watch.prepared()  # PPO's updates are compiled in the second piece

        jax_run.run(
            program,
            on_log=on_log,
            on_visit=(lambda visit, _: watch.on_visit(visit)) if self._in_stream else None,
            after_piece=watch.on_pause,
            piece=self._piece,
        )
        self._check_finite()

    def _check_finite(self) -> None:
        if not self.is_finite():
            raise ValueError("The weights are not finite.")

    def add_to(self, sums: Episodes) -> list[Episode]:
        """Add the last piece to sums; returns the episodes that ended in it."""
        log = self._log
        assert log is not None
        ended = np.logical_or(log.terminated, log.truncated)
        info = {name: value for name, value in log._asdict().items() if value is not None}
        return sums.add(log.reward, info, log.terminated, ended)

    def is_finite(self) -> bool:
        """Whether all weights are finite."""
        return not self._program.failed()[0]

    def restore(self, checkpoint: Path) -> Array:
        """Go on from a checkpoint; returns the sums of the present episode."""
        sums = np.zeros((7, 1, 1))
        try:
            arrays = read_arrays(checkpoint)
            sums[: self._sums, 0, 0] = arrays.pop(_EPISODE)
            self._program.restore(arrays)
        except (KeyError, OptionError) as error:
            raise unloadable(checkpoint, error.__cause__ or error) from None
        return sums

    def save_checkpoint(self, path: Path, sums: Array) -> None:
        """Write a checkpoint, with the sums of the present episode."""
        write_arrays(path, {**self._program.save(), _EPISODE: sums[: self._sums, 0, 0]})

    def save(self, path: Path) -> None:
        """Write the model of Stable-Baselines3."""
        write_atomically(path, saved_sb3(self.model))

    def begin_log(self, folder: Path) -> None:
        """Log to TensorBoard in a folder if it is installed."""
        if is_installed("tensorboard"):
            self._logger = configure(str(folder), ["tensorboard"])

    def log(self, episodes: Sequence[Episode]) -> None:
        """Log the means of the episodes that ended in a piece."""
        if self._logger is None:
            return
        for episode in episodes:
            self._logger.record_mean("rollout/ep_rew_mean", episode.episode_return)
            self._logger.record_mean("rollout/ep_len_mean", episode.length)
            log_episode(self._logger, episode)
        self._logger.dump(self.steps)

    def close(self) -> None:
        """Close the log."""
        if self._logger is not None:
            self._logger.close()
