"""One policy on one task: its measurements, the verdicts, and a comparison with another run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, ClassVar

from pydantic import JsonValue

from sme_registry.diagnosis import behaviour, measure
from sme_registry.diagnosis.behaviour import CapacityProbe
from sme_registry.diagnosis.document import Diagnosis, Level, Part, table
from sme_registry.diagnosis.measure import LINEAR, POLICY, Violations
from sme_registry.diagnosis.questions import (
    THRESHOLDS,
    Comparison,
    Difference,
    Measurements,
    TaskCase,
    Verdict,
    answer_all,
    label,
)
from sme_registry.diagnosis.rules import WHERE, WHY
from sme_registry.diagnosis.subject import Subject, perceptron_of
from sme_registry.evaluation import Policy, evaluate
from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.report import SAFETY_REFERENCES
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.spec.document import Digest
from sme_registry.task import Task, materialize

TASK_QUESTIONS = {**WHERE, **WHY}


class TaskDiagnosis(Diagnosis):
    headline_macro: ClassVar[str] = "task_headline"
    only_field: ClassVar[str] = "measurements"

    spec: SMESpec
    spec_digest: Digest
    level: Level  # normalised regret, ranked among the constant ½, the linear policy and 0
    comparison: Comparison | None = None  # with another run; null without one
    measurements: Measurements  # what the verdicts rest on

    def parts(self) -> Iterator[Part]:
        """Findings, the comparison, and on request the other answers and the numbers."""
        yield from super().parts()
        yield from _numbers(self.measurements)

    def tables(self) -> Iterator[Part]:
        if self.comparison is not None:
            yield from _tables_of(self.comparison)


def _tables_of(comparison: Comparison) -> Iterator[Part]:
    pairs = {**comparison.spec_fields, **comparison.plan_fields}
    fields = [f"{name} ({value}, there {other})" for name, (value, other) in pairs.items()]
    note = f"Compared with {comparison.name}. Fields that differ: {', '.join(fields) or 'none'}."
    rows = {label(row.quantity): row for row in comparison.differences}
    yield table("Compared with another run", "quantity", rows, "value other difference", note)
    if comparison.answers:
        answers = [(label(question), *pair) for question, pair in comparison.answers.items()]
        yield Part("Answers that differ", ("question", "this run", "other run"), answers)


def _numbers(measured: Measurements) -> Iterator[Part]:
    """Tables of the references, the action channels, and of limits, distractors and layers."""
    for heading, scores in (
        ("References, uniform states", measured.uniform),
        ("References, own episodes", measured.on_policy.scores),
    ):
        rows: dict[str, Any] = {_NAMES[name]: score for name, score in scores.items()}
        yield table(heading, "policy", rows, "regret mae normalised_regret", detail=True)
    rows = {str(channel.channel): channel for channel in measured.channels}
    fields = "mae normalised_regret linear_normalised_regret regret offset slope at_zero at_one"
    yield table("Action channels", "channel", rows, fields, detail=True)
    if measured.limits is not None:
        yield from _limits(measured.limits)
    distraction, observation = measured.distraction, measured.observation
    if distraction is not None:
        fields = "normalised_regret averaged_regret half_regret owed_regret distractor_share"
        yield table("Distractors", "states", {"uniform": distraction}, fields, detail=True)
    if distraction is not None and observation is not None:
        rows = {region.name: region for region in observation.distractor_regions}
        yield table("Distractors by region", "region", rows, "mae normalised_regret", detail=True)
    if observation is not None and observation.probes:
        rows = {str(probe.layer or "observation"): probe for probe in observation.probes}
        yield table("Layers", "layer", rows, "units state_r2 distractor_r2", detail=True)


_NAMES = {POLICY: "this policy", **LABELS}


def _limits(limits: Violations) -> Iterator[Part]:
    report = limits.report
    scores = {
        "this policy": report.regions[0],
        "its actions cut off at the limits": limits.cut_off,
        **{_NAMES[name]: report.references[name][0] for name in SAFETY_REFERENCES},
        "this policy, states that it visits": limits.visited,
        **{f"this policy, {region.name}": region for region in report.regions[1:]},
    }
    fields = "step_reward cost violating_share safe_regret"
    yield table("Limits: reward and cost", "policy", scores, fields, detail=True)
    channels = {str(channel.channel): channel for channel in limits.channels}
    fields = "violating_share optimal_violating_share cost"
    yield table("Limits by action channel", "channel", channels, fields, detail=True)


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
    comparison = None
    if against is not None:
        other = _measurements(against, states, episodes, seed, report)
        comparison = _compare(subject, measured, against, other)
    return TaskDiagnosis.about(
        subject,
        level=level(measured),
        verdicts=judge(measured, subject.spec, comparison, subject.updates),
        comparison=comparison,
        measurements=measured,
    )


def judge(
    measured: Measurements,
    spec: SMESpec,
    comparison: Comparison | None = None,
    updates: int | None = None,
) -> tuple[Verdict, ...]:
    asked = {
        name: question
        for name, question in TASK_QUESTIONS.items()
        if not question.needs or getattr(measured, question.needs) is not None
    }
    case = TaskCase(measured, spec, comparison=comparison, updates=updates)
    return answer_all(asked, case)


def level(measurements: Measurements) -> Level:
    """Rank the policy among the optimum, the linear policy and the constant ½."""
    regret = measurements.policy.normalised_regret
    if regret <= THRESHOLDS["solved"]:
        return "solved"
    if regret >= THRESHOLDS["constant_level"]:
        return "no_better_than_constant"
    linear = measurements.uniform[LINEAR].normalised_regret
    return "worse_than_linear" if regret > linear else "better_than_linear"


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


def _compare(
    subject: Subject, measured: Measurements, other: Subject, other_measured: Measurements
) -> Comparison:
    values, other_values = _quantities(measured), _quantities(other_measured)
    answers, other_answers = (
        {v.question: v.answer for v in judge(numbers, run.spec, updates=run.updates)}
        for run, numbers in ((subject, measured), (other, other_measured))
    )
    return Comparison(
        name=other.name,
        spec_fields=_differing(subject.spec.every_field(), other.spec.every_field()),
        plan_fields=_differing(subject.plan, other.plan),
        differences=tuple(
            Difference(quantity=name, value=value, other=other_values[name])
            for name, value in values.items()
        ),
        answers={
            question: (answer, other_answers[question])
            for question, answer in answers.items()
            if question in other_answers and answer != other_answers[question]
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


def _quantities(measurements: Measurements) -> dict[str, float]:
    """The quantities that are compared; normalised regret, which verdicts use, is first."""
    on_policy = measurements.on_policy
    scores = {
        "": measurements.policy,
        "linear_": measurements.uniform[LINEAR],
        "on_policy_": on_policy.scores[POLICY],
        "outermost_shell_": measurements.shells[-1].scores[POLICY],
    }
    regrets = {
        f"{prefix}{quantity}": getattr(score, quantity)
        for prefix, score in scores.items()
        for quantity in ("normalised_regret", "regret")
    }
    rewarded = {
        "rewarded_share": on_policy.signal.rewarded,
        "random_rewarded_share": on_policy.random_signal.rewarded,
    }
    return regrets | rewarded
