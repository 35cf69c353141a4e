"""`diagnose`: a subject to a `Diagnosis`. It takes seconds; the capacity probe takes longer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sme_registry.diagnosis import measure, networks, rollouts
from sme_registry.diagnosis.document import Comparison, Diagnosis, TaskDiagnosis, Verdict
from sme_registry.diagnosis.measurements import POLICY, CapacityProbe, Measurements
from sme_registry.diagnosis.questions import Case, answer_all, compare, level, thresholds_of
from sme_registry.diagnosis.stream import diagnose_stream
from sme_registry.diagnosis.subject import AnySubject, StreamSubject, Subject
from sme_registry.diagnosis.team import diagnose_team
from sme_registry.diagnosis.where import WHERE
from sme_registry.diagnosis.why import WHY
from sme_registry.errors import OptionError
from sme_registry.evaluation import Policy, evaluate
from sme_registry.evaluation.networks import Perceptron
from sme_registry.io import integer_in, versions
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.task import Task, materialize

__all__ = ["EPISODES", "STATES", "TASK_QUESTIONS", "diagnose", "judge"]

STATES, EPISODES = 8192, 64

TASK_QUESTIONS = {**WHERE, **WHY}


def diagnose(
    subject: AnySubject,
    *,
    against: AnySubject | None = None,
    probe_capacity: bool = False,
    states: int = STATES,
    episodes: int = EPISODES,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Measure a policy and the references, and answer every question about its regret.

    The result is a `TaskDiagnosis`. Of a team it is a `TeamDiagnosis`: every agent is measured over
    its own action channels, and the verdicts say who is to blame for the team's regret. Of a life
    in a stream it is a `StreamDiagnosis`: the networks are measured at the ends of the visits, and
    the verdicts say which phases were costly, forgotten or not learnt, and whether plasticity was
    lost.

    `against` is another run of a single agent, such as with a single axis changed, measured in the
    same way. `probe_capacity` fits a network of the same layers to a*, in tens of seconds, where
    the policy's network is known. `states` are uniform, in [64, 1,000,000], and `episodes` in
    [8, 10,000]; fewer are used if a state is large.

    Examples:
      >>> from sme_registry.diagnosis import diagnose, load_policy
      >>> subject = load_policy("constant", sme_registry.load("Default"))
      >>> diagnosis = diagnose(subject, states=64, episodes=8)
      >>> diagnosis.level
      'no_better_than_constant'
    """
    states = integer_in("states", states, 64, 1_000_000)
    episodes = integer_in("episodes", episodes, 8, 10_000)
    seed = integer_in("seed", seed, 0, 2**53 - 1)
    report = progress or (lambda description: None)
    compared = () if against is None else (against,)
    if (compared or probe_capacity) and not all(map(_is_single, (subject, *compared))):
        raise OptionError(
            "against, probe_capacity: compare runs and fit networks of single agents on one task "
            "only. Leave them out for a team or a life in a stream."
        )
    if isinstance(subject, StreamSubject):
        return diagnose_stream(subject, states, seed, report)
    if subject.spec.team is not None:
        return diagnose_team(subject, states, episodes, seed, report)
    measured = _measurements(subject, states, episodes, seed, report)
    if probe_capacity:
        probe = _probe(subject, seed, report)
        measured = measured.model_copy(update={"capacity": probe})
    comparison = None
    if isinstance(against, Subject):
        other = _measurements(against, states, episodes, seed, report)
        comparison = compare(subject, measured, against, other, judge)
    return TaskDiagnosis(
        name=subject.name,
        spec=subject.spec,
        spec_digest=subject.spec.digest,
        task=subject.spec.name,
        plan=subject.plan,
        checkpoint_step=subject.checkpoint_step,
        updates=subject.updates,
        level=level(measured),
        verdicts=judge(measured, subject.spec, comparison, subject.updates),
        comparison=comparison,
        thresholds=thresholds_of(subject.spec),
        measurements=measured,
        versions=versions(("numpy", "scipy"), if_imported=("torch", "stable_baselines3")),
    )


def judge(
    measured: Measurements,
    spec: SMESpec,
    comparison: Comparison | None = None,
    updates: int | None = None,
) -> tuple[Verdict, ...]:
    """Answer all questions that the measurements can answer."""
    asked = {
        name: question
        for name, question in TASK_QUESTIONS.items()
        if not question.needs or getattr(measured, question.needs) is not None
    }
    return answer_all(asked, Case(measured, spec, comparison, updates), thresholds_of(spec))


def _is_single(subject: AnySubject) -> bool:
    return isinstance(subject, Subject) and subject.spec.team is None


def _measurements(
    subject: Subject, states: int, episodes: int, seed: int, report: Callable[[str], None]
) -> Measurements:
    task, policy = materialize(subject.spec), subject.policy
    assert isinstance(policy, Policy)  # of a single agent
    references = measure.fit_references(task, states, seed)
    report(f"{subject.name}: uniform states and shells")
    fields, sample = measure.fixed_states(policy, task, references, states, seed)
    report(f"{subject.name}: episodes")
    (runs,) = rollouts.episodes_of(policy.start(), task, references, episodes, seed)
    on_policy = rollouts.on_policy(task, runs)
    training = exploration_sd = None
    if subject.log is not None:
        constant = min(on_policy.scores[name].regret for name in rollouts.CONSTANTS)
        training = rollouts.training(subject.log, constant)
    if subject.explore is not None:
        exploration_sd = networks.exploration_sd(subject.explore, sample.observation, seed)
    if subject.spec.extended:
        report(f"{subject.name}: limits and distractors")
        fields |= _limits_and_distractors(policy, task, sample, runs[POLICY], seed)
    return Measurements(
        **fields, on_policy=on_policy, training=training, exploration_sd=exploration_sd
    )


def _limits_and_distractors(
    policy: Policy, task: Task, sample: measure.Sample, run: rollouts.Trajectories, seed: int
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
    network = getattr(subject.policy, "act", None)
    if not isinstance(network, Perceptron):
        return None

    def progress(done: int) -> None:
        total = networks.GRADIENT_STEPS
        report(f"{subject.name}: capacity, {done:,} of {total:,} gradient steps")

    steps = subject.plan.get("steps")
    count = steps if isinstance(steps, int) and steps else networks.DEFAULT_STATES
    return networks.probe_capacity(network, materialize(subject.spec), count, seed, progress)
