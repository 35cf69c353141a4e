"""`run_cell`: one run of a study, from its document to its result. It writes no files of the study.

A single agent learns in one environment, as its algorithm is defined (teams: `training`). Only the
evaluations run as a batch. The same cell gives the same result on the same machine, except for
`timing`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.errors import PolicyError
from sme_registry.evaluation import (
    EvaluationReport,
    Policy,
    StreamReport,
    TeamPolicy,
    as_policy,
    evaluate,
)
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.io import write_atomically
from sme_registry.spec.study import Cell, in_jax
from sme_registry.studies.engine.algorithms import find_algorithm, reference_name
from sme_registry.studies.engine.checks import refuse_of_reference
from sme_registry.studies.engine.jobs import Lanes
from sme_registry.studies.engine.lanes import run_lanes
from sme_registry.studies.engine.life import Life, TasksInForce
from sme_registry.studies.engine.offline_cell import offline_name, run_offline
from sme_registry.studies.engine.result import CellResult, LearningCurve, Timing, report_field
from sme_registry.studies.engine.training import Training, training
from sme_registry.training.algorithms import one_thread, quiet
from sme_registry.training.record import versions_for

ReportSteps = Callable[[int, int], None]


def run_cell(
    cell: Cell, progress: ReportSteps | None = None, model_path: Path | None = None
) -> CellResult:
    """Train, evaluate during training, and evaluate in and out of distribution at the end.

    The k-th evaluation follows round(steps · k / evaluations) steps, the last one the end of
    training: on-policy algorithms finish their last rollout, so it can be later. Its episodes are
    deterministic and start in states that depend only on the seed and on k.

    Args:
      cell: the cell to run.
      progress: called after each step with the steps done and the steps in all.
      model_path: where to save the trained model, if it has a `save` method. Of a life in a
        stream, the folder of the same name without suffix gets those at the ends of its visits.

    Returns:
      The result. Its times are CPU seconds of this thread, so that other jobs on the machine do
      not count: `environment` is the steps of training, `evaluation` all evaluations including the
      one at the end, `training` the rest of learning, and `steps_per_second` counts training and
      environment together.

    Examples:
      >>> from sme_registry.spec import StudyFile
      >>> from sme_registry.studies import run_cell
      >>> cell = StudyFile.read("study/plan.json").plan.cells[0].cell
      >>> run_cell(cell).report.policy
      'reference:linear'
    """
    start = time.thread_time()
    progress = progress or (lambda done, total: None)
    if in_jax(cell.uses):
        return _run_alone(cell, progress, model_path)
    learner = offline_name(cell.uses)
    if learner is not None:
        return run_offline(cell, learner, progress)
    reference = reference_name(cell.uses)
    if reference is None:
        find_algorithm(cell.uses)  # refuse an unknown one before anything is loaded
    recorder = _Recorder(cell, progress)
    with quiet(), contextlib.nullcontext() if reference else one_thread():
        learned: Policy | TeamPolicy | Life
        if reference:
            learned = _evaluate_reference(cell, reference, recorder)
        else:
            learned = _train(cell, recorder, model_path)
        evaluation_start = time.thread_time()
        if isinstance(learned, Life):
            report: EvaluationReport | StreamReport = learned.report()
        else:
            report = evaluate(learned, cell.spec, cell.protocol, name=cell.uses)
        recorder.evaluation_seconds += time.thread_time() - evaluation_start
    return CellResult(
        key=cell.digest,
        cell=cell,
        curve=recorder.curve(),
        **report_field(report),
        **recorder.online_regret(),
        timing=recorder.timing(time.thread_time() - start),
        versions=versions_for(cell.uses),
    )


def _run_alone(cell: Cell, progress: ReportSteps, model_path: Path | None) -> CellResult:
    """Run a cell that uses JAX as the only lane of a program."""

    def report(done: int, total: int, compilations: int = 0, note: str = "", /) -> None:
        progress(done, total)

    (lane,) = run_lanes((cell,), Lanes(1), report, model_path is not None)
    if isinstance(lane.ended, PolicyError):
        raise lane.ended
    if model_path is not None and lane.model is not None:
        for name, snapshot in lane.snapshots.items():
            write_atomically(model_path.with_suffix("") / name, snapshot)
        write_atomically(model_path, lane.model)
    return lane.ended


class _Recorder:
    """Records the evaluations, regret and times of a run, and when the next evaluation is due."""

    def __init__(self, cell: Cell, progress: ReportSteps) -> None:
        self._cell, self._progress = cell, progress
        self._tasks = TasksInForce(cell.document)
        n = cell.evaluations
        self.due = [round(cell.steps * k / n) for k in range(1, n + 1)]
        self.rows: list[tuple[float, ...]] = []  # the fields of a `LearningCurve`, in its order
        self._agents = () if cell.spec.team is None else self._tasks.after(0).names
        self.steps, self.regret = 0, 0.0
        self.cost: float | None = None
        self.agents_regret = np.zeros(len(self._agents))
        self.agents_rows: list[list[float]] = []  # the regret of each agent in an evaluation
        self.training_seconds = self.environment_seconds = self.evaluation_seconds = 0.0

    def report(self, steps: int) -> None:
        """Report the steps done; an algorithm may take more than those of the plan."""
        if steps <= self._cell.steps:
            self._progress(steps, self._cell.steps)

    def is_due(self, steps: int) -> bool:
        """Whether an evaluation is due during training; the last one waits for its end."""
        done = len(self.rows)
        return done + 1 < len(self.due) and self.due[done] <= steps

    def evaluate(self, steps: int, policy: Policy | TeamPolicy) -> None:
        """Run the next evaluation, after `steps` steps of training."""
        start = time.thread_time()
        cell = self._cell
        states = start_states(
            cell.seed, len(self.rows), cell.evaluation_episodes, cell.spec.state_dim
        )
        done = rollouts(self._tasks.shown_to(policy, steps), self._tasks.after(steps), states)
        self.rows.append(
            (
                steps,
                float(done.episode_return.mean()),
                done.per_step(done.regret),
                done.per_step(done.similarity),
                float(done.length.mean()),
            )
        )
        if self._agents:
            self.agents_rows.append([done.per_step(regret) for regret in done.agents_regret])
        self.evaluation_seconds += time.thread_time() - start

    def curve(self) -> LearningCurve:
        """The learning curve."""
        if not self.rows:
            return LearningCurve()
        columns = zip(*self.rows, strict=True)
        fields: dict[str, Any] = dict(zip(LearningCurve.model_fields, columns, strict=False))
        by_agent = zip(*self.agents_rows, strict=True)
        fields["agents_regret"] = dict(zip(self._agents, by_agent, strict=False))
        return LearningCurve(**fields)

    def online_regret(self) -> dict[str, Any]:
        """The online regret, the online cost, and the regret of each agent."""
        if not self.steps:
            return {}
        means = (self.agents_regret / self.steps).tolist()
        return {
            "online_regret": self.regret / self.steps,
            "online_cost": None if self.cost is None else self.cost / self.steps,
            "agents_online_regret": dict(zip(self._agents, means, strict=True)),
        }

    def timing(self, total: float) -> Timing:
        """Where the time went; `total` is the whole run's."""
        learning = self.training_seconds + self.environment_seconds
        return Timing(
            total=total,
            training=self.training_seconds,
            environment=self.environment_seconds,
            evaluation=self.evaluation_seconds,
            steps_per_second=self.steps / learning if self.steps else 0.0,
        )


def _evaluate_reference(cell: Cell, reference: str, recorder: _Recorder) -> Policy | TeamPolicy:
    """Evaluate a policy that learns nothing as often as a learner."""
    refuse_of_reference(cell.uses, cell.hyperparameters)
    policy = as_policy(reference_policy(reference, cell.spec), cell.spec)
    for steps in recorder.due:
        recorder.evaluate(steps, policy)
        recorder.report(steps)
    return policy


def _train(cell: Cell, recorder: _Recorder, model_path: Path | None) -> Policy | TeamPolicy | Life:
    """Train the cell's learner, and evaluate it whenever an evaluation is due."""
    run = training(cell)
    life = None
    if cell.stream is not None:
        life = Life(cell, run, model_path and model_path.with_suffix(""))
    _learn(cell, run, recorder, life)
    while len(recorder.rows) < cell.evaluations:
        recorder.evaluate(run.env.steps, run.policy())
    if model_path is not None:
        run.save(model_path)
    if life is None:
        return run.policy()
    life.finish(run.env.steps)
    return life


def _learn(cell: Cell, run: Training, recorder: _Recorder, life: Life | None) -> None:
    env = run.env

    def evaluate_due(steps: int) -> None:
        while recorder.is_due(steps):
            recorder.evaluate(steps, run.policy())
        recorder.report(steps)

    def after_step(steps: int) -> None:
        if life is not None:
            life.after_step(steps)
        evaluate_due(steps)

    env.after_step = after_step
    evaluate_due(0)
    start, evaluating = time.thread_time(), recorder.evaluation_seconds
    if cell.steps:
        run.learn()
    learning = time.thread_time() - start - (recorder.evaluation_seconds - evaluating)
    if env.steps < cell.steps:
        raise PolicyError(
            f"uses={cell.uses!r}: learn({cell.steps}) returned after {env.steps} steps of its "
            "environment. It must take all of them, in that environment."
        )
    recorder.steps, recorder.regret = env.steps, env.regret
    recorder.cost = getattr(env, "cost", None)
    recorder.agents_regret = getattr(env, "agents_regret", recorder.agents_regret)
    recorder.environment_seconds = env.seconds
    recorder.training_seconds = learning - env.seconds
