"""Policies with one known fault each, and short diagnoses of them."""

import contextlib
import functools
import io

import numpy as np
from rich.console import Console

from sme_registry import SMESpec
from sme_registry.diagnosis import diagnose, load_policy
from sme_registry.diagnosis.task import TASK_QUESTIONS
from sme_registry.evaluation import Perceptron
from sme_registry.evaluation.references import reference_policy
from sme_registry.io.terminal import out

SPEC = SMESpec(horizon=20)
DEEP = SMESpec(horizon=20, complexity=10, seed=1)
DISTRACTORS = 6
EXTENDED = SMESpec(
    horizon=20,
    safety={"tightness": 0.2},
    observation={"distractors": DISTRACTORS},
    policy_init="unit_variance",
)


@functools.cache
def optimum(spec):
    """π* of observations."""
    return reference_policy("optimal", spec)


@functools.cache
def diagnosis_of(policy, spec=SPEC, **options):
    """The diagnosis of a policy or of a reference policy by name, made once."""
    settings = {"states": 2048, "episodes": 8, **options}
    return diagnose(load_policy(policy, spec), **settings)


def verdicts_on(measurements, spec, comparison=None, updates=None):
    """The verdicts on a run that was measured, compared with another run or not."""
    fields = {
        "measurements": measurements, "spec": spec, "comparison": comparison, "updates": updates,
    }  # fmt: skip
    run = diagnosis_of("constant", states=64).model_copy(update=fields)
    return run.judged(TASK_QUESTIONS).verdicts


def printed(diagnosis, width=None, details=False):
    """The lines on a terminal of this width, or in a pipe."""
    parts = diagnosis.terminal(details=details)
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        console = out()
        if width is not None:
            console = Console(file=text, width=width, force_terminal=True, color_system=None)
        for part in parts:
            console.print(part)
    return [line.rstrip() for line in text.getvalue().splitlines()]


def faults(diagnosis):
    """The "where" questions that are answered yes."""
    return {v.question for v in diagnosis.verdicts if v.kind == "where" and v.answer == "yes"}


def one_channel_constant(observation):
    a = optimum(SPEC)(observation)
    a[:, 2] = 0.5
    return a


def inside_only(observation):
    s = observation[:, :8]
    inside = ((s >= 0) & (s <= 1)).all(axis=1, keepdims=True)
    return np.where(inside, optimum(SPEC)(observation), 0.5)


def left_half_only(observation):
    return np.where(observation[:, 4:5] < 0.5, optimum(SPEC)(observation), 0.5)


def near_the_centre_only(observation):
    near = np.abs(observation[:, :8] - 0.5).max(axis=1, keepdims=True) < 0.44
    return np.where(near, optimum(SPEC)(observation), 0.5)


def with_offset(observation):
    return optimum(SPEC)(observation) + 0.15


def shrunk(observation):
    return 0.5 + 0.3 * (optimum(SPEC)(observation) - 0.5)


def saturated(observation):
    return (optimum(SPEC)(observation) > 0.5).astype(float)


def time_dependent(observation):
    return optimum(SPEC)(observation) + 0.4 * (observation[:, 8:9] - 0.5)


class Noisy:
    def __init__(self, spec=SPEC):
        self.optimum = optimum(spec)
        self.generator = np.random.default_rng(0)

    def __call__(self, observation):
        a = self.optimum(observation)
        return a + 0.1 * self.generator.standard_normal(a.shape)


def distracted(observation):
    """π* that adds a known function of the first four distractors."""
    return optimum(EXTENDED)(observation) + 0.2 * (observation[:, 8:12] - 0.5)


@functools.cache
def network(first=0, last=8 + DISTRACTORS):
    """A random network, whose only hidden layer has a linear image of these channels."""
    generator = np.random.default_rng(0)
    inside = np.zeros((EXTENDED.observation_dim, 16))
    inside[first:last] = generator.normal(size=(last - first, 16))
    outside = generator.normal(size=(16, EXTENDED.action_dim)) / 64
    half = np.full(EXTENDED.action_dim, 0.5)
    return Perceptron([(inside, np.zeros(16), "identity"), (outside, half, "identity")])
