"""`run_cell`: one run of a study, from its document to its result. Nothing is written meanwhile.

The agent learns in one environment, as its algorithm is meant to: with more at once PPO and the
off-policy algorithms would all be others. What is done at once is its evaluation, which is no part
of the algorithm. The same cell gives the same result on the same machine, except for `timing`.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import time
from collections.abc import Callable
from pathlib import Path

from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import Policy, evaluate
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.io import write_atomically
from sme_registry.spec.study import Cell
from sme_registry.studies.engine.algorithms import (
    Learner,
    find_algorithm,
    new_learner,
    reference_name,
)
from sme_registry.studies.engine.offline_cell import offline_name, run_offline
from sme_registry.studies.engine.result import CellResult, LearningCurve, Timing
from sme_registry.task import materialize
from sme_registry.training.algorithms import one_thread, quiet
from sme_registry.training.numpy_policy import numpy_policy
from sme_registry.training.record import installed_versions

Progress = Callable[[int, int], None]

_TOLD = 200  # times that progress is told of in a run


def run_cell(
    cell: Cell, progress: Progress | None = None, model_path: Path | None = None
) -> CellResult:
    """Train, evaluate while training, and judge at the end.

    The k-th evaluation falls after round(steps · k / evaluations) steps, the last one after
    training has ended: on-policy algorithms finish their last rollout, so it can be later. Its
    episodes are deterministic, and begin in states that depend on the seed and on k alone.

    Args:
      cell: what to run.
      progress: told the steps done and those in all, now and then.
      model_path: where to keep the trained model, if it is one that can `save`.

    Returns:
      The result. Its times are CPU seconds of this thread, so that other jobs on the machine do
      not count: `environment` is the steps of training, `evaluation` all evaluations with the one
      at the end, `training` the rest of learning, and `steps_per_second` is of training and
      environment together.

    Raises:
      UnknownNameError, OptionError, MissingDependencyError: the algorithm cannot be found, or takes
        other hyperparameters; or the model cannot be written.
      ResourceLimitError: the task would not fit in memory.
      PolicyError: the learner's actions cannot be used, or it stopped early.
    """
    begun = time.thread_time()
    told = progress or (lambda done, total: None)
    learner = offline_name(cell.uses)
    if learner is not None:
        return run_offline(cell, learner, told)
    reference = reference_name(cell.uses)
    if reference is None:
        find_algorithm(cell.uses)  # what cannot be found is refused before anything is loaded
    book = _Book(cell, told)
    with quiet(), contextlib.nullcontext() if reference else one_thread():
        policy = _follow(cell, reference, book) if reference else _train(cell, book, model_path)
        judging = time.thread_time()
        report = evaluate(
            policy.act,
            cell.spec,
            cell.protocol,
            action_range=policy.action_range,
            name=cell.uses,
        )
        book.evaluation_seconds += time.thread_time() - judging
    learning = book.training_seconds + book.environment_seconds
    return CellResult(
        key=cell.digest,
        cell=cell,
        curve=book.curve(),
        report=report,
        online_regret=book.regret / book.steps if book.steps else None,
        timing=Timing(
            total=time.thread_time() - begun,
            training=book.training_seconds,
            environment=book.environment_seconds,
            evaluation=book.evaluation_seconds,
            steps_per_second=book.steps / learning if book.steps else 0.0,
        ),
        versions=versions_for(cell.uses),
    )


class _Book:
    """What is written down of a run, and when the next evaluation is due."""

    def __init__(self, cell: Cell, progress: Progress) -> None:
        self._cell, self._progress = cell, progress
        self._task = materialize(cell.spec)
        self._tell_every = max(1, cell.steps // _TOLD)
        n = cell.evaluations
        self.due = [round(cell.steps * k / n) for k in range(1, n + 1)]
        self.rows: list[tuple[int, float, float, float, float]] = []
        self.steps, self.regret = 0, 0.0
        self.training_seconds = self.environment_seconds = self.evaluation_seconds = 0.0

    def tell(self, steps: int) -> None:
        """Tell how far it is, every now and then."""
        if steps % self._tell_every == 0 or steps == self._cell.steps:
            self._progress(min(steps, self._cell.steps), self._cell.steps)

    def is_due(self, steps: int) -> bool:
        """Whether an evaluation is due after so many steps; the last one never while they go on."""
        done = len(self.rows)
        return done + 1 < len(self.due) and self.due[done] <= steps

    def evaluate(self, steps: int, policy: Policy) -> None:
        """The next evaluation, after so many steps."""
        begun = time.thread_time()
        cell = self._cell
        states = start_states(
            cell.seed, len(self.rows), cell.evaluation_episodes, cell.spec.state_dim
        )
        done = rollouts(policy, self._task, states)
        self.rows.append(
            (
                steps,
                float(done.episode_return.mean()),
                done.per_step(done.regret),
                done.per_step(done.similarity),
                float(done.length.mean()),
            )
        )
        self.evaluation_seconds += time.thread_time() - begun

    def curve(self) -> LearningCurve:
        """The learning curve so far."""
        columns = zip(*self.rows, strict=True) if self.rows else [()] * 5
        names = ("steps", "episode_return", "regret", "similarity", "length")
        return LearningCurve(**dict(zip(names, columns, strict=True)))


def _follow(cell: Cell, reference: str, book: _Book) -> Policy:
    """A policy that learns nothing, evaluated as often as one that does."""
    if cell.hyperparameters:
        raise OptionError(
            f"hyperparameters={sorted(cell.hyperparameters)}: {cell.uses} has none. Leave them out."
        )
    policy = numpy_policy(reference_policy(reference, cell.spec), cell.spec)
    for steps in book.due:
        book.evaluate(steps, policy)
        book.tell(steps)
    return policy


def _train(cell: Cell, book: _Book, model_path: Path | None) -> Policy:
    """Train the cell's learner, and evaluate it when that is due."""
    from sme_registry.training.monitored_env import MonitoredVecEnv

    env = MonitoredVecEnv(cell.spec, action_range=cell.action_range)
    learner = new_learner(
        cell.uses, env, seed=cell.seed, steps=cell.steps, hyperparameters=cell.hyperparameters
    )

    def evaluate_now(steps: int) -> None:
        book.evaluate(steps, numpy_policy(learner, cell.spec, action_range=cell.action_range))

    def after_step(steps: int) -> None:
        while book.is_due(steps):
            evaluate_now(steps)
        book.tell(steps)

    env.after_step = after_step
    after_step(0)
    begun, evaluating = time.thread_time(), book.evaluation_seconds
    if cell.steps:
        learner.learn(cell.steps)
    learning = time.thread_time() - begun - (book.evaluation_seconds - evaluating)
    if env.steps < cell.steps:
        raise PolicyError(
            f"uses={cell.uses!r}: its learn({cell.steps}) returned after {env.steps} steps of the "
            "environment that it was given. It must take them all, in that one."
        )
    book.steps, book.regret = env.steps, env.regret
    book.environment_seconds = env.seconds
    book.training_seconds = learning - env.seconds
    while len(book.rows) < cell.evaluations:
        evaluate_now(env.steps)
    if model_path is not None:
        _save(learner, model_path)
    return numpy_policy(learner, cell.spec, action_range=cell.action_range)


def _save(learner: Learner, path: Path) -> None:
    save = getattr(learner, "save", None)
    if save is not None:
        archive = io.BytesIO()
        save(archive)
        write_atomically(path, archive.getvalue())


def versions_for(uses: str) -> dict[str, str]:
    """What is installed of what the numbers depend on; another package's algorithm's, too."""
    versions = installed_versions()
    package = uses.partition(":")[0].partition(".")[0]
    with contextlib.suppress(importlib.metadata.PackageNotFoundError, ValueError):
        versions[package] = importlib.metadata.version(package)
    return versions
