"""`run_cell`: one run of a study, from its document to its result. It writes no files of the study.

    reference:…    a policy that learns nothing, evaluated as often as a learner
    offline:…      collects a data set, which it does not keep, and learns from it alone
    jax:…          the only run of a program (`programs`)
    any other      its `Learner`, in environments of its own

The same cell gives the same result on the same machine, except for `timing`.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.datasets import DatasetRecipe, collect, train_offline
from sme_registry.envs.schedule import Schedule
from sme_registry.errors import OptionError, PolicyError, SpecError
from sme_registry.evaluation import EvaluationReport, Policy, evaluate
from sme_registry.evaluation.policies import TeamPolicy, as_policy
from sme_registry.evaluation.references import reference_policy
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.io import write_atomically
from sme_registry.spec.study import Cell
from sme_registry.studies.result import (
    EVALUATION,
    TRAINING,
    CellFailure,
    CellResult,
    OfflineCell,
    Outcome,
    Record,
    Report,
    SharedProgram,
    Timing,
    life_report,
)
from sme_registry.task import materialize
from sme_registry.task.loading import materialize_segments
from sme_registry.training.algorithms import Entry, check_hyperparameters, find, imported
from sme_registry.training.learn import Learner, Run, Steps, Watch
from sme_registry.training.record import Snapshots


def run_cell(
    cell: Cell, progress: Report | None = None, model_path: Path | None = None
) -> CellResult:
    """Train, evaluate during training, and evaluate in and out of distribution at the end.

    The evaluations' episodes are deterministic and start in states that depend only on the seed and
    on the evaluation's number. Times are CPU seconds of this thread. `progress` is called after
    each step with the steps done and the steps in all. A trained model that has a `save` method is
    saved at `model_path`; of a life in a stream, those at the ends of its visits go into the
    folder of the same name without suffix.

    Examples:
      >>> from sme_registry.spec import StudyFile
      >>> from sme_registry.studies import run_cell
      >>> cell = StudyFile.read("study/plan.json").plan.cells[0].cell
      >>> run_cell(cell).report.policy
      'reference:linear'
    """
    progress = progress or (lambda done, total: None)
    entry = find(cell.uses)
    entry.check_task(cell.document)
    check_hyperparameters(cell.uses, cell.hyperparameters)
    if entry.backend.in_programs:
        return _run_alone(cell, progress, model_path)
    with entry.surroundings():
        if entry.kind == "offline":
            return _run_offline(cell, entry, progress)
        if entry.kind == "reference":
            return _run_reference(cell, entry.name, progress)
        return _train(cell, entry, progress, model_path)


def _train(cell: Cell, entry: Entry, progress: Report, model_path: Path | None) -> CellResult:
    run = Run(
        document=cell.document,
        seed=cell.seed,
        steps=cell.steps,
        hyperparameters=cell.hyperparameters,
        action_range=cell.action_range,
    )
    learner = entry.learner(run)
    if cell.source not in (None, learner.source):
        raise OptionError(
            f"uses={cell.uses!r}: the source of its module is {learner.source} now, and that "
            f"of the cell is {cell.source}. Run the study again: with another source it is "
            "another cell."
        )
    cell = Cell(**dict(cell) | {"source": learner.source})
    training = _Training(cell, progress, learner, model_path and model_path.with_suffix(""))
    training.run()
    if model_path is not None:
        learner.save(model_path)
    return training.result()


def _run_alone(cell: Cell, progress: Report, model_path: Path | None) -> CellResult:
    run_program = imported("sme_registry.studies.programs:run_program")
    outcome: Outcome
    (outcome,) = run_program((cell,), SharedProgram(1), progress, model_path is not None)
    entry, model, snapshots = outcome
    if isinstance(entry, CellFailure):
        raise PolicyError(entry.error.removeprefix("PolicyError: "))
    if model_path is not None and model is not None:
        for name, snapshot in snapshots.items():
            write_atomically(model_path.with_suffix("") / name, snapshot)
        write_atomically(model_path, model)
    return entry


def _run_reference(cell: Cell, name: str, progress: Report) -> CellResult:
    evaluations = _Evaluations(cell, progress, cell.evaluations)
    policy = as_policy(reference_policy(name, cell.spec), cell.spec)
    for steps in evaluations.record.due:
        evaluations.evaluate(steps, policy)
        evaluations.report(steps)
    return evaluations.result_of(evaluations.report_on(policy), 0)


class _Evaluations(Watch):
    """The evaluations of a cell whose policy runs outside JAX."""

    def __init__(self, cell: Cell, progress: Report, evaluations: int) -> None:
        self.cell, self._progress = cell, progress
        tasks = materialize_segments(cell.document)
        self._schedule = Schedule(cell.document, tasks)
        agents = () if cell.spec.team is None else tasks[0].names
        self.record = Record((cell,), 1, evaluations, time.thread_time, agents)

    def report(self, steps: int) -> None:
        """Report the steps done; an algorithm may take more than those of the plan."""
        if steps <= self.cell.steps:
            self._progress(steps, self.cell.steps)

    def evaluate(self, steps: int, policy: Policy | TeamPolicy) -> None:
        cell, k = self.cell, self.record.evaluated
        number = k + cell.evaluations - len(self.record.due)  # a function has only the last
        states = start_states(cell.seed, number, cell.evaluation_episodes, cell.spec.state_dim)
        # On the task of the last step, or that of the first.
        segment = self._schedule.times.segment_at(max(steps - 1, 0))
        phases = cell.document.observed_phases
        if phases:
            assert isinstance(policy, Policy)  # streams have no teams
            policy = policy.in_phase(int(self._schedule.phases[segment]), phases)
        episodes = rollouts(policy, self._schedule.tasks[segment], states)
        row = (
            steps,
            float(episodes.episode_return.mean()),
            episodes.per_step(episodes.regret),
            episodes.per_step(episodes.similarity),
            float(episodes.length.mean()),
        )
        by_agent = None
        if cell.spec.team is not None:
            by_agent = [episodes.per_step(regret) for regret in episodes.agents_regret]
        self.record.evaluation(k, np.array(row)[:, None], by_agent)
        self.record.spend(EVALUATION)

    def report_on(self, policy: Policy | TeamPolicy) -> EvaluationReport:
        return evaluate(policy, self.cell.spec, self.cell.protocol, name=self.cell.uses)

    def result_of(self, report: Any, steps: int, environment: float = 0.0) -> CellResult:
        self.record.spend(EVALUATION)
        timing = self.record.timing(steps, environment=environment)
        return self.record.result(0, steps, report, timing)


class _Training(_Evaluations):
    """A learner and its evaluations; in a stream also its policies at the ends of visits."""

    def __init__(
        self, cell: Cell, progress: Report, learner: Learner, snapshots: Path | None
    ) -> None:
        n = min(1, cell.evaluations) if learner.only_at_the_end else cell.evaluations
        super().__init__(cell, progress, n)
        self._learner = learner
        self._files: Snapshots | None = None
        self._policies: list[Policy] = []  # before training, and at the end of each visit
        if cell.stream is not None:
            if snapshots is not None:
                self._files = Snapshots(snapshots, cell.stream)
            self.on_visit(-1)

    def run(self) -> None:
        self._evaluate_due(0)
        self.report(0)
        self._learner.learn(self)
        self.record.spend(TRAINING)
        while self.record.evaluated < len(self.record.due):
            self.evaluate(self._learner.steps, self._learner.policy())

    def on_steps(self, taken: Steps) -> None:
        """Count steps, before the learner learns from them, and run what is due."""
        steps, info = self._learner.steps, taken.info
        self.record.add(steps, info["regret"], info.get("cost"), info.get("phase"))
        self._evaluate_due(steps)
        self.report(steps)

    def on_policy(self) -> None:
        self._evaluate_due(self._learner.steps, yielded=True)

    def on_visit(self, visit: int) -> None:
        """Keep the policy at the end of a visit; of visit −1 that before training."""
        self._policies.append(self._learner.lasting_policy())
        if self._files is not None:
            self._learner.save(self._files.initial if visit < 0 else self._files.visits[visit])

    def result(self) -> CellResult:
        learner, blocks = self._learner, self.record.blocks
        report: Any
        if blocks is None:
            report = self.report_on(learner.policy())
        else:
            initial, *visits = self._policies
            report = life_report(self.cell, visits, initial, blocks.dynamic_regret())
        return self.result_of(report, learner.steps, learner.seconds)

    def _evaluate_due(self, steps: int, *, yielded: bool = False) -> None:
        """Run the evaluations that are due during training; the last one waits for its end."""
        record = self.record
        if yielded != self._learner.yields_policies:
            return
        while record.evaluated + 1 < len(record.due) and record.due[record.evaluated] <= steps:
            record.spend(TRAINING)
            self.evaluate(steps, self._learner.policy())


def _run_offline(cell: Cell, entry: Entry, progress: Report) -> CellResult:
    """Collect the data, learn from it, and evaluate the policy as in every cell."""
    start = time.thread_time()
    settings: dict[str, Any] = dict(cell.hyperparameters)
    fields = entry.settings().model_fields
    nu, transitions, batch_size = (
        settings.pop(name, fields[name].default) for name in ("nu", "transitions", "batch_size")
    )
    data = collect(_recipe(cell, nu, transitions), materialize(cell.spec), {})
    collected = time.thread_time()
    result = train_offline(
        data,
        algorithm=entry.name,
        steps=cell.steps,
        batch_size=batch_size,
        seed=cell.seed,
        evaluations=max(1, cell.evaluations),
        episodes=cell.evaluation_episodes,
        hyperparameters=settings,
        spec=cell.spec,
        protocol=cell.protocol,
        progress=lambda done, total, _: progress(done, total),
    )
    end = time.thread_time()
    learned, T = result.record, cell.spec.horizon
    record = Record((cell,), 1, len(learned.evaluations), time.thread_time)
    for k, each in enumerate(learned.evaluations):
        row = each.step, each.episode_return, each.regret, each.similarity, T
        record.evaluation(k, np.array(row)[:, None])
    training = learned.cpu_ms_per_step * cell.steps / 1e3
    timing = Timing(
        total=end - start,
        training=training,
        environment=collected - start,
        evaluation=max(0.0, end - collected - training),
        steps_per_second=cell.steps / max(training, 1e-9),
    )
    offline = OfflineCell(
        nu=nu,
        transitions=transitions,
        dataset_digest=learned.dataset_digest,
        behaviour_similarity=learned.behaviour.similarity,
        behaviour_similarity_sd=learned.behaviour.similarity_sd,
        similarity=learned.similarity,
        similarity_sd=learned.evaluations[-1].similarity_sd,
    )
    return record.result(0, 0, result.report, timing, offline=offline)


def _recipe(cell: Cell, nu: float, transitions: int) -> DatasetRecipe:
    if cell.spec.D > 0:
        raise SpecError(f"D={cell.spec.D:g}: must be 0 for an offline cell. Leave it out.")
    return DatasetRecipe.from_dict(
        {
            "spec": cell.spec,
            "behaviours": [{"kind": "mixture", "nu": nu, "weight": 1.0}],
            "transitions": transitions,
            "seed": cell.seed,
            "protocol": cell.protocol,
        },
        "data set",
    )
