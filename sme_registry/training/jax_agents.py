"""`JAXLearner`: an agent in JAX, and the model of Stable-Baselines3 that gets its weights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger, configure

from sme_registry.envs.episodes import Episode
from sme_registry.errors import OptionError
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import is_installed, read_arrays, write_arrays, write_atomically
from sme_registry.jax.program import StepLog
from sme_registry.jax.run import new_program, run
from sme_registry.spec import StreamSpec
from sme_registry.task.task import Array
from sme_registry.training.learn import Learner, Run, Steps, Watch
from sme_registry.training.models import log_of_run, new_sb3_model, set_weights, unloadable

_EPISODE = "episode"  # of the checkpoint: the sums of the present episode


class JAXLearner(Learner):
    """A program of one run in JAX.

    Its checkpoint holds everything: a resumed run continues with the same bits.
    """

    def __init__(self, name: str, run: Run) -> None:
        super().__init__(name, run)
        options: dict[str, Any] = {
            "hyperparameters": run.hyperparameters,
            "action_range": run.action_range,
            "steps": run.steps,
        }
        device = run.device or None
        self._program = new_program(name, [run.document], [run.seed], device=device, **options)
        self._model = new_sb3_model(name, run.document, seed=run.seed, **options)
        self._sums = 4 if run.document.specs[0].safety is None else 7
        self._logger = Logger(None, [])

    @property
    def steps(self) -> int:
        return int(self._program.steps)

    @property
    def total(self) -> int:
        rollout = self._program.rollout
        return -(-max(self.run.steps, self.steps) // rollout) * rollout

    @property
    def model(self) -> Any:
        set_weights(self._model, self._program.weights(0), self.steps)
        return self._model

    def learn(self, watch: Watch) -> None:
        watch.prepare("compiling …")

        def on_log(log: StepLog) -> None:
            self._check_finite()
            info = {name: value for name, value in log._asdict().items() if value is not None}
            ended = np.logical_or(log.terminated, log.truncated)
            watch.on_steps(Steps(log.reward, info, log.terminated, ended))

        in_stream = isinstance(self.run.document, StreamSpec)
        run(
            self._program,
            on_log=on_log,
            on_visit=(lambda visit, _: watch.on_visit(visit)) if in_stream else None,
            after_piece=watch.on_pause,
            piece=self.run.piece,
        )
        self._check_finite()

    def _check_finite(self) -> None:
        if not self.is_finite():
            raise ValueError("The weights are not finite.")

    def is_finite(self) -> bool:
        return not self._program.failed()[0]

    def restore(self, checkpoint: Path) -> Array:
        sums = np.zeros((7, 1, 1))
        try:
            arrays = read_arrays(checkpoint)
            sums[: self._sums, 0, 0] = arrays.pop(_EPISODE)
            self._program.restore(arrays)
        except (KeyError, OptionError) as error:
            raise unloadable(checkpoint, error.__cause__ or error) from None
        return sums

    def save_checkpoint(self, path: Path, sums: Array) -> None:
        write_arrays(path, {**self._program.save(), _EPISODE: sums[: self._sums, 0, 0]})

    def save(self, path: Path) -> None:
        write_atomically(path, saved_sb3(self.model))

    def begin_log(self, folder: Path) -> None:
        if is_installed("tensorboard"):
            self._logger = configure(str(folder), ["tensorboard"])

    def log(self, episodes: Sequence[Episode]) -> None:
        for episode in episodes:
            log_of_run(self._logger, episode)
        self._logger.dump(self.steps)

    def close(self) -> None:
        self._logger.close()
