"""`diagnose`: a subject to a `Diagnosis`. It takes seconds; the capacity probe takes longer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sme_registry.diagnosis import measure, rollouts, verdicts
from sme_registry.diagnosis.comparison import compare
from sme_registry.diagnosis.document import CapacityProbe, Diagnosis, Measurements
from sme_registry.diagnosis.questions import THRESHOLDS
from sme_registry.diagnosis.subject import Subject
from sme_registry.io import integer_in, versions
from sme_registry.spec import EvaluationProtocol
from sme_registry.task import Task, materialize
from sme_registry.training.numpy_policy import Perceptron

__all__ = ["EPISODES", "STATES", "diagnose"]

STATES, EPISODES = 8192, 64
_EXPLORATION_STATES = 256


def diagnose(
    subject: Subject,
    *,
    against: Subject | None = None,
    probe_capacity: bool = False,
    states: int = STATES,
    episodes: int = EPISODES,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Measure a policy and the references, and answer every question about its regret.

    Args:
      subject: from `load_run`, `load_cell` or `load_policy`.
      against: another run, e.g. with a single axis changed. It is measured in the same way.
      probe_capacity: fit a network of the same layers to a*; tens of seconds. Ignored if the
        policy's network is unknown.
      states: uniform states, in [64, 1,000,000]; fewer are used if a state is large.
      episodes: in [8, 10,000]; fewer are used if a state is large.
      seed: of everything random here, at least 0.
      progress: called with a description of each step.

    Raises:
      OptionError: an argument is out of range.
      PolicyError: the policy's actions are invalid.
      MissingDependencyError: the probe needs PyTorch, which is not installed.
      ResourceLimitError: the task does not fit in memory.
    """
    measurer = _Measurer(
        integer_in("states", states, 64, 1_000_000),
        integer_in("episodes", episodes, 8, 10_000),
        integer_in("seed", seed, 0, 2**53 - 1),
        progress or (lambda description: None),
    )
    measurements = measurer.measurements(subject, probe_capacity)
    judged, comparison = verdicts.judge(measurements, subject.spec), None
    if against is not None:
        other = measurer.measurements(against, False)
        comparison = compare(
            subject, measurements, judged, against, other, verdicts.judge(other, against.spec)
        )
        judged = verdicts.judge(measurements, subject.spec, comparison)
    return Diagnosis(
        name=subject.name,
        spec=subject.spec,
        spec_digest=subject.spec.digest,
        plan=subject.plan,
        checkpoint_step=subject.checkpoint_step,
        level=verdicts.level(measurements),
        verdicts=judged,
        comparison=comparison,
        thresholds=THRESHOLDS,
        measurements=measurements,
        versions=versions(("numpy", "scipy"), if_imported=("torch", "stable_baselines3")),
    )


@dataclass(frozen=True)
class _Measurer:
    """The amount and seed of the measurements, and where progress is reported."""

    states: int
    episodes: int
    seed: int
    report: Callable[[str], None]

    def measurements(self, subject: Subject, probe_capacity: bool) -> Measurements:
        task, policy, seed = materialize(subject.spec), subject.policy, self.seed
        self.report(f"{subject.name}: uniform states")
        references = measure.fit_references(task, self.states, seed)
        count = measure.affordable(task, self.states)
        protocol = EvaluationProtocol(states_per_region=count, seed=seed)
        states = measure.sample(policy, task, references, protocol, 0)
        uniform = measure.scores(task, states)
        time_dependence, time_variance = measure.time_dependence(policy, task, states)
        squared_error = measure.squared_error(policy, task, states, time_variance)
        response = measure.response(policy, task, states, seed)
        self.report(f"{subject.name}: shells")
        shells = measure.shells(policy, task, references, seed, uniform)
        self.report(f"{subject.name}: episodes")
        on_policy = rollouts.on_policy(policy, task, references, self.episodes, seed)
        training = None
        if subject.log is not None:
            constant = min(on_policy.scores[name].regret for name in rollouts.CONSTANTS)
            training = rollouts.training(subject.log, constant)
        return Measurements(
            uniform=uniform,
            channels=measure.channels(task, states),
            partitions=measure.partitions(task, states),
            shells=shells,
            squared_error=squared_error,
            response=response,
            time_dependence=time_dependence,
            on_policy=on_policy,
            training=training,
            exploration_sd=self._exploration_sd(subject, states),
            capacity=self._probe(subject, task) if probe_capacity else None,
        )

    def _exploration_sd(self, subject: Subject, states: measure.Sample) -> tuple[float, ...] | None:
        if subject.explore is None:
            return None
        from sme_registry.diagnosis.networks import exploration_sd

        observation = states.observation[:_EXPLORATION_STATES]
        return tuple(exploration_sd(subject.explore, observation, self.seed).tolist())

    def _probe(self, subject: Subject, task: Task) -> CapacityProbe | None:
        network = subject.policy.act
        if not isinstance(network, Perceptron):
            return None
        from sme_registry.diagnosis import networks

        def progress(done: int) -> None:
            if done % 1000 == 0:
                total = networks.GRADIENT_STEPS
                self.report(f"{subject.name}: capacity, {done:,} of {total:,} gradient steps")

        steps = subject.plan.get("steps")
        count = steps if isinstance(steps, int) and steps else networks.DEFAULT_STATES
        return networks.probe_capacity(network, task, count, self.seed, progress)
