"""`diagnose`: a subject to a `Diagnosis`. It takes seconds; the capacity probe takes longer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias, overload

from sme_registry.diagnosis import extended, measure, networks, rollouts, verdicts
from sme_registry.diagnosis.comparison import compare
from sme_registry.diagnosis.document import Diagnosis
from sme_registry.diagnosis.measurements import POLICY, CapacityProbe, Measurements
from sme_registry.diagnosis.questions import thresholds_of
from sme_registry.diagnosis.stream import diagnose_stream
from sme_registry.diagnosis.stream_document import StreamDiagnosis
from sme_registry.diagnosis.stream_subject import StreamSubject
from sme_registry.diagnosis.subject import AnySubject, Subject, TeamSubject
from sme_registry.diagnosis.team import diagnose_team
from sme_registry.diagnosis.team_document import TeamDiagnosis
from sme_registry.errors import OptionError
from sme_registry.evaluation import evaluate
from sme_registry.evaluation.networks import Perceptron
from sme_registry.io import integer_in, versions
from sme_registry.spec import EvaluationProtocol
from sme_registry.task import Task, materialize

__all__ = ["EPISODES", "STATES", "AnyDiagnosis", "diagnose"]

AnyDiagnosis: TypeAlias = Diagnosis | TeamDiagnosis | StreamDiagnosis

STATES, EPISODES = 8192, 64


@overload
def diagnose(
    subject: Subject,
    *,
    against: AnySubject | None = None,
    probe_capacity: bool = False,
    states: int = STATES,
    episodes: int = EPISODES,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis: ...


@overload
def diagnose(
    subject: StreamSubject,
    *,
    against: AnySubject | None = None,
    probe_capacity: bool = False,
    states: int = STATES,
    episodes: int = EPISODES,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> StreamDiagnosis: ...


@overload
def diagnose(
    subject: TeamSubject,
    *,
    against: AnySubject | None = None,
    probe_capacity: bool = False,
    states: int = STATES,
    episodes: int = EPISODES,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> TeamDiagnosis: ...


def diagnose(
    subject: AnySubject,
    *,
    against: AnySubject | None = None,
    probe_capacity: bool = False,
    states: int = STATES,
    episodes: int = EPISODES,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> AnyDiagnosis:
    """Measure a policy and the references, and answer every question about its regret.

    Of a team, it measures every agent over its own action channels, and answers who is to blame for
    the team's regret. Of a life in a stream, it measures the networks at the ends of the visits,
    and answers which phases were costly, forgotten or not learnt, and whether plasticity was lost.

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
    if not isinstance(subject, Subject) and against is None and not probe_capacity:
        if isinstance(subject, StreamSubject):
            return diagnose_stream(subject, states, seed, report)
        return diagnose_team(subject, states, episodes, seed, report)
    if not isinstance(subject, Subject) or not isinstance(against, Subject | None):
        raise OptionError(
            "against, probe_capacity: compare runs and fit networks of single agents on one task "
            "only. Leave them out for a team or a life in a stream."
        )
    measurements = _measurements(subject, states, episodes, seed, report)
    if probe_capacity:
        probe = _probe(subject, seed, report)
        measurements = measurements.model_copy(update={"capacity": probe})
    comparison = None
    if against is not None:
        other = _measurements(against, states, episodes, seed, report)
        comparison = compare(subject, measurements, against, other)
    return Diagnosis(
        name=subject.name,
        spec=subject.spec,
        spec_digest=subject.spec.digest,
        task=subject.spec.name,
        plan=subject.plan,
        checkpoint_step=subject.checkpoint_step,
        level=verdicts.level(measurements),
        verdicts=verdicts.judge(measurements, subject.spec, comparison),
        comparison=comparison,
        thresholds=thresholds_of(subject.spec),
        measurements=measurements,
        versions=versions(("numpy", "scipy"), if_imported=("torch", "stable_baselines3")),
    )


def _measurements(
    subject: Subject, states: int, episodes: int, seed: int, report: Callable[[str], None]
) -> Measurements:
    task, policy = materialize(subject.spec), subject.policy
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
    more: dict[str, Any] = {}
    if subject.spec.extended:
        report(f"{subject.name}: limits and distractors")
        more = _extended(subject, task, sample, runs[POLICY], seed)
    return Measurements(
        **fields, **more, on_policy=on_policy, training=training, exploration_sd=exploration_sd
    )


def _extended(
    subject: Subject, task: Task, sample: measure.Sample, run: rollouts.Trajectories, seed: int
) -> dict[str, Any]:
    """The fields of `Measurements` that tasks with `safety` or `observation` have."""
    protocol = EvaluationProtocol(states_per_region=len(sample.s), seed=seed)
    evaluated = evaluate(subject.policy, subject.spec, protocol)
    fields: dict[str, Any] = {"observation": evaluated.observation}
    if evaluated.safety is not None:
        fields["limits"] = extended.limits(task, sample, run, evaluated.safety)
    if subject.spec.distractors:
        fields["distraction"] = extended.distraction(subject.policy, task, sample, seed)
    return fields


def _probe(subject: Subject, seed: int, report: Callable[[str], None]) -> CapacityProbe | None:
    network = subject.policy.act
    if not isinstance(network, Perceptron):
        return None

    def progress(done: int) -> None:
        total = networks.GRADIENT_STEPS
        report(f"{subject.name}: capacity, {done:,} of {total:,} gradient steps")

    steps = subject.plan.get("steps")
    count = steps if isinstance(steps, int) and steps else networks.DEFAULT_STATES
    return networks.probe_capacity(network, materialize(subject.spec), count, seed, progress)
