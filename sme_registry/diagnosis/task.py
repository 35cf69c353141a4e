"""A single agent on a task: what is measured of it, and how it compares with another run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydantic import JsonValue

from sme_registry.diagnosis import behaviour, measure
from sme_registry.diagnosis.behaviour import CapacityProbe
from sme_registry.diagnosis.document import Measurements, TaskDiagnosis
from sme_registry.diagnosis.measure import POLICY
from sme_registry.diagnosis.questions import Comparison, Difference, Questions
from sme_registry.diagnosis.rules import WHERE, WHY
from sme_registry.diagnosis.subject import Subject, perceptron_of
from sme_registry.evaluation import Policy, evaluate
from sme_registry.spec import EvaluationProtocol
from sme_registry.task import Task, materialize

TASK_QUESTIONS = {**WHERE, **WHY}


def diagnose_task(
    subject: Subject,
    states: int,
    episodes: int,
    seed: int,
    report: Callable[[str], None],
    against: Subject | None = None,
    *,
    probe_capacity: bool = False,
) -> TaskDiagnosis:
    """The arguments and errors are those of `diagnose`."""
    measured = _measurements(subject, states, episodes, seed, report)
    if probe_capacity:
        probe = _probe(subject, seed, report)
        measured = measured.model_copy(update={"capacity": probe})
    diagnosis = diagnosed(subject, measured)
    if against is None:
        return diagnosis
    other = diagnosed(against, _measurements(against, states, episodes, seed, report))
    comparison = _compare(diagnosis, other)
    return diagnosis.model_copy(update={"comparison": comparison}).judged(TASK_QUESTIONS)


def diagnosed(
    subject: Subject, measured: Measurements, questions: Questions = TASK_QUESTIONS
) -> TaskDiagnosis:
    """The diagnosis that follows from measurements."""
    diagnosis = TaskDiagnosis.about(subject, level=measured.level, measurements=measured)
    return diagnosis.judged(questions)


def _measurements(
    subject: Subject, states: int, episodes: int, seed: int, report: Callable[[str], None]
) -> Measurements:
    task, policy = materialize(subject.spec), subject.policy
    assert isinstance(policy, Policy)  # of a single agent
    references = measure.fit_references(task, states, seed)
    report(f"{subject.name}: uniform states and shells")
    fields, sample = measure.fixed_states(policy, task, references, states, seed)
    report(f"{subject.name}: episodes")
    (runs,) = behaviour.episodes_of(policy.start(), task, references, episodes, seed)
    on_policy = fields["on_policy"] = behaviour.on_policy(task, runs)
    if subject.log is not None:
        constant = min(on_policy.scores[name].regret for name in behaviour.CONSTANTS)
        fields["training"] = behaviour.training(subject.log, constant)
    if subject.explore is not None:
        explored = behaviour.exploration_sd(subject.explore, sample.observation, seed)
        fields["exploration_sd"] = explored
    if not subject.spec.is_plain:
        report(f"{subject.name}: limits and distractors")
        fields |= _limits_and_distractors(policy, task, sample, runs[POLICY], seed)
    return Measurements(**fields)


def _limits_and_distractors(
    policy: Policy, task: Task, sample: measure.Sample, run: behaviour.Trajectories, seed: int
) -> dict[str, Any]:
    """The fields of `Measurements` that tasks with `safety` or `observation` have."""
    protocol = EvaluationProtocol(states_per_region=len(sample.s), seed=seed)
    evaluated = evaluate(policy, task.spec, protocol)
    fields: dict[str, Any] = {"observation": evaluated.observation}
    if evaluated.safety is not None:
        visited = run.s[run.alive], run.a[run.alive]
        fields["limits"] = measure.limits(task, sample, visited, evaluated.safety)
    if task.spec.distractors:
        fields["distraction"] = measure.distraction(policy, task, sample, seed)
    return fields


def _probe(subject: Subject, seed: int, report: Callable[[str], None]) -> CapacityProbe | None:
    assert isinstance(subject.policy, Policy)  # of a single agent
    network = perceptron_of(subject.policy)
    if network is None:
        return None

    def progress(done: int) -> None:
        total = behaviour.GRADIENT_STEPS
        report(f"{subject.name}: capacity, {done:,} of {total:,} gradient steps")

    steps = subject.plan.get("steps")
    count = steps if isinstance(steps, int) and steps else behaviour.DEFAULT_STATES
    return behaviour.probe_capacity(network, materialize(subject.spec), count, seed, progress)


def _compare(run: TaskDiagnosis, other: TaskDiagnosis) -> Comparison:
    values, other_values = (_quantities(one.measurements) for one in (run, other))
    answers = {verdict.question: verdict.answer for verdict in other.verdicts}
    return Comparison(
        name=other.name,
        spec_fields=_differing(run.spec.every_field(), other.spec.every_field()),
        plan_fields=_differing(run.plan, other.plan),
        differences=tuple(
            Difference(quantity=name, value=value, other=other_values[name])
            for name, value in values.items()
        ),
        answers={
            verdict.question: (verdict.answer, answers[verdict.question])
            for verdict in run.verdicts
            if answers.get(verdict.question, verdict.answer) != verdict.answer
        },
    )


def _differing(
    fields: dict[str, JsonValue], others: dict[str, JsonValue]
) -> dict[str, tuple[JsonValue, ...]]:
    return {
        field: (fields.get(field), others.get(field))
        for field in {**others, **fields}
        if fields.get(field) != others.get(field)
    }


def _quantities(measured: Measurements) -> dict[str, float]:
    """The quantities that are compared; normalised regret, which verdicts use, is first."""
    scores = {
        "": measured.policy,
        "linear_": measured.linear,
        "on_policy_": measured.visited,
        "outermost_shell_": measured.shells[-1].scores[POLICY],
    }
    regrets = {
        f"{prefix}{quantity}": getattr(score, quantity)
        for prefix, score in scores.items()
        for quantity in ("normalised_regret", "regret")
    }
    rewarded = {
        "rewarded_share": measured.on_policy.signal.rewarded,
        "random_rewarded_share": measured.on_policy.random_signal.rewarded,
    }
    return regrets | rewarded
