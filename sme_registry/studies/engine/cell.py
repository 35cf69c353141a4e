"""`run_cell`: one run of a study, from its document to its result. It writes no files of the study.

    reference:…    a policy that learns nothing, evaluated as often as a learner
    offline:…      collects a data set, which it does not keep, and learns from it alone
    jax:…          the only lane of a program (`lanes`)
    train:…        a function (`FunctionLearner`), evaluated at its end alone
    any other      an `SB3Learner` in its environments

Only the evaluations run as a batch. The same cell gives the same result on the same machine, except
for `timing`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.datasets import DatasetRecipe, collect, train_offline
from sme_registry.envs.schedule import Schedule
from sme_registry.errors import OptionError, PolicyError, SpecError
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
from sme_registry.spec.study import Cell
from sme_registry.studies.engine.programs import Lanes, run_lanes
from sme_registry.studies.engine.result import (
    EVALUATION,
    TRAINING,
    CellFailure,
    CellResult,
    LearningCurve,
    OfflineResult,
    Record,
    Timing,
    life_report,
)
from sme_registry.task import materialize, materialize_segments
from sme_registry.training.algorithms import check_hyperparameters, find, one_thread, quiet
from sme_registry.training.functions import FunctionLearner
from sme_registry.training.learn import Watch
from sme_registry.training.record import Snapshots

ReportSteps = Callable[[int, int], None]

TRANSITIONS = 50_000
BATCH_SIZE = 256
_COUNTED_AT_ONCE = 500  # steps of a life; one by one they would cost a twentieth of PPO's


def run_cell(
    cell: Cell, progress: ReportSteps | None = None, model_path: Path | None = None
) -> CellResult:
    """Train, evaluate during training, and evaluate in and out of distribution at the end.

    The evaluations' episodes are deterministic and start in states that depend only on the seed and
    on the evaluation's number.

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
    progress = progress or (lambda done, total: None)
    entry = find(cell.uses)
    if entry.kind == "jax":
        return _run_alone(cell, progress, model_path)
    if entry.kind == "offline":
        return _run_offline(cell, entry.name, progress)
    if entry.kind == "reference":
        check_hyperparameters(cell.uses, cell.hyperparameters)
        return _run_reference(cell, entry.name, progress)
    if entry.kind == "train":
        return _run_function(cell, entry.name, progress, model_path)
    entry.load()  # refuse a missing one before anything is made
    from sme_registry.training.learners import SB3Learner

    with quiet(), one_thread():
        learner = SB3Learner(cell.uses, cell.document, **_options(cell))
        models = model_path and model_path.with_suffix("")
        watch = _Evaluations(cell, progress, learner, models)
        watch.train()
        if learner.steps < cell.steps:
            raise PolicyError(
                f"uses={cell.uses!r}: learn({cell.steps}) returned after {learner.steps} steps of "
                "its environment. It must take all of them, in that environment."
            )
        return watch.result_of_training(model_path)


def _options(cell: Cell) -> dict[str, Any]:
    """What a learner is made with."""
    return {
        "seed": cell.seed,
        "steps": cell.steps,
        "hyperparameters": cell.hyperparameters,
        "action_range": cell.action_range,
    }


def _run_function(
    cell: Cell, name: str, progress: ReportSteps, model_path: Path | None
) -> CellResult:
    """Train with a function, whose policy is evaluated at the end alone."""
    learner = FunctionLearner(name, cell.spec, **_options(cell))
    if cell.source not in (None, learner.source):
        raise OptionError(
            f"uses={cell.uses!r}: the source of its module is {learner.source} now, and that of "
            f"the cell is {cell.source}. Run the study again: with another source it is another "
            "cell."
        )
    cell = Cell(**dict(cell) | {"source": learner.source})
    watch = _Evaluations(cell, progress, learner)
    watch.train()
    return watch.result_of_training(model_path)


def _run_alone(cell: Cell, progress: ReportSteps, model_path: Path | None) -> CellResult:
    """Run a cell that uses JAX as the only lane of a program."""

    def report(done: int, total: int, note: str = "", /) -> None:
        progress(done, total)

    ((entry, model, snapshots),) = run_lanes((cell,), Lanes(1), report, model_path is not None)
    if isinstance(entry, CellFailure):
        raise PolicyError(entry.error.removeprefix("PolicyError: "))
    if model_path is not None and model is not None:
        for name, snapshot in snapshots.items():
            write_atomically(model_path.with_suffix("") / name, snapshot)
        write_atomically(model_path, model)
    return entry


def _run_reference(cell: Cell, name: str, progress: ReportSteps) -> CellResult:
    """Evaluate a policy that learns nothing as often as a learner."""
    evaluations = _Evaluations(cell, progress)
    with quiet():
        policy = as_policy(reference_policy(name, cell.spec), cell.spec)
        for steps in evaluations.record.due:
            evaluations.evaluate(steps, policy)
            evaluations.report(steps)
        return evaluations.result(policy, 0)


class _Evaluations(Watch):
    """The evaluations of a cell whose policy runs outside JAX, and the record of its training."""

    def __init__(
        self,
        cell: Cell,
        progress: ReportSteps,
        learner: Any = None,
        models: Path | None = None,
    ) -> None:
        self.cell, self._progress, self._learner = cell, progress, learner
        tasks = materialize_segments(cell.document)
        self._schedule = Schedule(cell.document, tasks)
        agents = () if cell.spec.team is None else tasks[0].names
        self.record = Record((cell,), 1, time.thread_time, agents)
        self._begun = time.thread_time()
        self._life = None if cell.stream is None else _Life(cell, self.record, learner, models)

    def train(self) -> None:
        """Train the learner, and evaluate it whenever an evaluation is due."""
        env, record = self._learner.env, self.record
        record.start()
        self._evaluate_due(0)
        self.report(0)
        self._learner.learn(self)
        record.add(env.regret, env.cost)
        record.spend(TRAINING)
        while record.evaluated < len(record.due):
            self.evaluate(env.steps, self._learner.policy())

    def on_steps(self) -> None:
        """Count a step, before the learner learns from it, and run what is due."""
        steps = self._learner.steps
        if self._life is not None:
            self._life.after_step(steps)
        self._evaluate_due(steps)
        self.report(steps)

    def on_visit(self, visit: int) -> None:
        """Keep the policy."""
        assert self._life is not None
        self._life.end_visit(visit)

    def result_of_training(self, model_path: Path | None) -> CellResult:
        """The result, with the model where it is to be saved."""
        learner = self._learner
        if model_path is not None:
            learner.save(model_path)
        ended = learner.policy() if self._life is None else self._life.report(learner.steps)
        return self.result(ended, learner.steps, learner.env.seconds)

    def report(self, steps: int) -> None:
        """Report the steps done; an algorithm may take more than those of the plan."""
        if steps <= self.cell.steps:
            self._progress(steps, self.cell.steps)

    def _evaluate_due(self, steps: int) -> None:
        """Run the evaluations that are due during training; the last one waits for its end."""
        record = self.record
        while record.evaluated + 1 < len(record.due) and record.due[record.evaluated] <= steps:
            record.spend(TRAINING)
            self.evaluate(steps, self._learner.policy())

    def evaluate(self, steps: int, policy: Policy | TeamPolicy) -> None:
        """Run the next evaluation, after `steps` steps of training."""
        cell, k = self.cell, self.record.evaluated
        number = k + cell.evaluations - len(self.record.due)  # a function has only the last
        states = start_states(cell.seed, number, cell.evaluation_episodes, cell.spec.state_dim)
        # On the task of the last step, or that of the first.
        segment, stream = self._schedule.segment(max(steps - 1, 0)), cell.stream
        if stream is not None and stream.observes_phase:
            assert isinstance(policy, Policy)  # streams have no teams
            policy = policy.in_phase(int(self._schedule.phases[segment]), stream.observed_phases)
        done = rollouts(policy, self._schedule.tasks[segment], states)
        row = (
            steps,
            float(done.episode_return.mean()),
            done.per_step(done.regret),
            done.per_step(done.similarity),
            float(done.length.mean()),
        )
        by_agent = None
        if cell.spec.team is not None:
            by_agent = [done.per_step(regret) for regret in done.agents_regret]
        self.record.evaluation(k, np.array(row)[:, None], by_agent)
        self.record.spend(EVALUATION)

    def result(
        self, ended: Policy | TeamPolicy | StreamReport, steps: int, seconds: float = 0.0
    ) -> CellResult:
        """The result with the report of the trained policy, or of a life."""
        cell, record = self.cell, self.record
        report: EvaluationReport | StreamReport
        if isinstance(ended, StreamReport):
            report = ended
        else:
            report = evaluate(ended, cell.spec, cell.protocol, name=cell.uses)
        record.spend(EVALUATION)
        total = time.thread_time() - self._begun
        timing = record.timing(steps, 0.0, environment=seconds, total=total)
        return record.result(0, steps, report, timing)


class _Life:
    """A learner's life while it trains: its policies at the ends of visits, and its regret."""

    def __init__(self, cell: Cell, record: Record, learner: Any, models: Path | None) -> None:
        assert cell.stream is not None
        assert record.blocks is not None
        self._cell, self._learner, self._blocks = cell, learner, record.blocks
        self._uncounted: list[tuple[float, int]] = []  # regret and phase of steps
        self._files = None if models is None else Snapshots(models, cell.stream)
        self._initial, self._policies = learner.lasting_policy(), list[Policy]()
        if self._files is not None:
            learner.save(self._files.initial)

    def after_step(self, steps: int) -> None:
        """Count a step, before the learner learns from it."""
        info = self._learner.env.last[2][0]
        self._uncounted.append((info["regret"], info["phase"]))
        if len(self._uncounted) >= _COUNTED_AT_ONCE:
            self._count(steps)

    def report(self, steps: int) -> StreamReport:
        """End the life after its training: what the agent retains, and its dynamic regret."""
        self._count(steps)
        regret = self._blocks.dynamic_regret()
        return life_report(self._cell, self._policies, self._initial, regret)

    def _count(self, steps: int) -> None:
        if self._uncounted:
            regret, phase = zip(*self._uncounted, strict=True)
            self._blocks.add(steps, np.array(regret)[:, None], phase)
            self._uncounted.clear()

    def end_visit(self, visit: int) -> None:
        self._policies.append(self._learner.lasting_policy())
        if self._files is not None:
            self._learner.save(self._files.visits[visit])


def _run_offline(cell: Cell, name: str, progress: ReportSteps) -> CellResult:
    """Collect the data, learn from it, and evaluate the policy as in every cell."""
    start = time.thread_time()
    settings: dict[str, Any] = dict(cell.hyperparameters)
    nu: Any = settings.get("nu")
    recipe = _recipe(cell, settings)
    data = collect(recipe, materialize(cell.spec), {})
    collected = time.thread_time()
    result = train_offline(
        data,
        algorithm=name,
        steps=cell.steps,
        batch_size=settings.pop("batch_size", BATCH_SIZE),
        seed=cell.seed,
        evaluations=max(1, cell.evaluations),
        episodes=cell.evaluation_episodes,
        hyperparameters=settings,
        spec=cell.spec,
        protocol=cell.protocol,
        progress=lambda done, total, _: progress(done, total),
    )
    end = time.thread_time()
    record, T = result.record, cell.spec.horizon
    evaluations = record.evaluations
    training = record.cpu_ms_per_step * cell.steps / 1e3
    return CellResult(
        key=cell.digest,
        cell=cell,
        curve=LearningCurve(
            steps=tuple(each.step for each in evaluations),
            episode_return=tuple(each.episode_return for each in evaluations),
            regret=tuple(1.0 - each.episode_return / T for each in evaluations),
            similarity=tuple(each.similarity for each in evaluations),
            length=(float(T),) * len(evaluations),
        ),
        report=result.report,
        offline=OfflineResult(
            nu=nu,
            transitions=recipe.transitions,
            dataset_digest=record.dataset_digest,
            behaviour_similarity=record.behaviour.similarity,
            behaviour_similarity_sd=record.behaviour.similarity_sd,
            similarity=record.similarity,
            similarity_sd=evaluations[-1].similarity_sd,
        ),
        timing=Timing(
            total=end - start,
            training=training,
            environment=collected - start,
            evaluation=max(0.0, end - collected - training),
            steps_per_second=cell.steps / max(training, 1e-9),
        ),
        versions=record.versions,
    )


def _recipe(cell: Cell, settings: dict[str, Any]) -> DatasetRecipe:
    """The recipe of a cell's data set; takes its `nu` and `transitions` out of `settings`."""
    if cell.spec.D > 0:
        raise SpecError(f"D={cell.spec.D:g}: must be 0 for an offline cell. Leave it out.")
    if "nu" not in settings:
        raise OptionError("hyperparameters.nu: is required. Give a number in [0, 1], such as 0.5.")
    return DatasetRecipe.from_dict(
        {
            "spec": cell.spec,
            "behaviours": [{"kind": "mixture", "nu": settings.pop("nu"), "weight": 1.0}],
            "transitions": settings.pop("transitions", TRANSITIONS),
            "seed": cell.seed,
            "protocol": cell.protocol,
        },
        "data set",
    )
