"""`diagnose`: a subject to a `Diagnosis`; seconds, and with the capacity probe some more."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable
from importlib import metadata

from sme_registry.diagnosis import measure, rules
from sme_registry.diagnosis.report import Capacity, Diagnosis, Numbers
from sme_registry.diagnosis.subject import Subject
from sme_registry.errors import OptionError
from sme_registry.spec import EvaluationProtocol
from sme_registry.spec.document import plain_number
from sme_registry.task import Task, materialize
from sme_registry.training.numpy_policy import Perceptron

STATES, EPISODES = 8192, 64
_SPREAD_STATES = 256


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
    """Measure a policy beside the references, and say what follows.

    Args:
      subject: what `of_run`, `of_cell` or `of_policy` returned.
      against: another run, such as one with a single axis changed. It is measured in the same way.
      probe_capacity: fit a network of the same layers to a*; tens of seconds. Does nothing where
        the policy's network is not known.
      states: uniform states, in [64, 1,000,000]; fewer are taken where a state is large.
      episodes: side by side, in [8, 10,000]; likewise.
      seed: of everything random here, at least 0.
      progress: told what is being done.

    Raises:
      OptionError: an argument out of range.
      PolicyError: the policy's actions cannot be used.
      MissingDependencyError: PyTorch is needed for the probe and not installed.
      ResourceLimitError: a task would not fit in memory.
    """
    _within("states", states, 64, 1_000_000)
    _within("episodes", episodes, 8, 10_000)
    _within("seed", seed, 0, 2**53 - 1)
    say = progress or (lambda what: None)

    def numbers_of(one: Subject, probed: bool) -> Numbers:
        return _measure(one, probed, states, episodes, seed, say)

    numbers = numbers_of(subject, probe_capacity)
    comparison = None
    if against is not None:
        other = numbers_of(against, False)
        comparison = rules.compare(subject, numbers, against, other)
        there = {f.question: f.answer for f in rules.findings(other, against.spec)}
        here = rules.findings(numbers, subject.spec)
        answers = {
            f.question: (f.answer, there[f.question]) for f in here if f.answer != there[f.question]
        }
        comparison = comparison.model_copy(update={"answers": answers})
    found = rules.findings(numbers, subject.spec, comparison)
    return Diagnosis(
        name=subject.name,
        spec=subject.spec,
        spec_digest=subject.spec.digest,
        plan=subject.plan,
        note=subject.note,
        headline=rules.headline(numbers, found),
        findings=found,
        comparison=comparison,
        thresholds=rules.THRESHOLDS,
        numbers=numbers,
        versions=_versions(),
    )


def _measure(
    subject: Subject,
    probe_capacity: bool,
    states: int,
    episodes: int,
    seed: int,
    say: Callable[[str], None],
) -> Numbers:
    task, policy = materialize(subject.spec), subject.policy
    say(f"{subject.name}: uniform states")
    count = measure.affordable(task, states)
    fitted = measure.fitted_references(task, states, seed)
    protocol = EvaluationProtocol(states_per_region=count, seed=seed)
    found = measure.sample(policy, task, fitted, protocol, 0)
    uniform = measure.scores(task, found)
    clock, moved = measure.clock(policy, task, found)
    form = measure.form(policy, task, found, moved, seed)
    say(f"{subject.name}: shells")
    shells = measure.shells(policy, task, fitted, seed, uniform)
    say(f"{subject.name}: episodes")
    on_policy = measure.on_policy(policy, task, fitted, episodes, seed)
    training = spread = None
    if subject.log is not None:
        constant = min(on_policy.scores[name].regret for name in measure.CONSTANTS)
        training = measure.training(subject.log, constant)
    if subject.explore is not None:
        from sme_registry.diagnosis.networks import spread as spread_of

        spread = tuple(
            spread_of(subject.explore, found.observation[:_SPREAD_STATES], seed).tolist()
        )
    return Numbers(
        uniform=uniform,
        channels=measure.channels(task, found),
        partitions=measure.partitions(task, found),
        shells=shells,
        form=form,
        clock=clock,
        on_policy=on_policy,
        training=training,
        exploration_sd=spread,
        capacity=_probe(subject, task, seed, say) if probe_capacity else None,
    )


def _probe(subject: Subject, task: Task, seed: int, say: Callable[[str], None]) -> Capacity | None:
    network = subject.policy.act
    if not isinstance(network, Perceptron):
        return None
    from sme_registry.diagnosis import networks

    steps = subject.plan.get("steps")
    told = steps if isinstance(steps, int) and steps else networks.DEFAULT_STATES

    def tell(done: int) -> None:
        if done % 1000 == 0:
            say(f"{subject.name}: capacity, {done:,} of {networks.GRADIENT_STEPS:,} gradient steps")

    return networks.capacity(network, task, told, seed, tell)


def _within(name: str, value: int, low: int, high: int) -> None:
    number = plain_number(value)
    if type(number) is not int or not low <= number <= high:
        raise OptionError(f"{name}={value!r:.40}: must be an integer in [{low:,}, {high:,}].")


def _versions() -> dict[str, str]:
    from sme_registry import __version__

    names = ["numpy", "scipy"]
    names += [name for name in ("torch", "stable_baselines3") if name in sys.modules]
    found = {name: metadata.version(name) for name in names}
    return {"sme_registry": __version__, "python": platform.python_version(), **found}
