"""Policies with one known fault each, and short diagnoses of them."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable
from typing import Any

import numpy as np
from rich.console import Console

from sme_registry import SMESpec
from sme_registry.diagnosis import Diagnosis, diagnose, load_policy
from sme_registry.evaluation import Perceptron
from sme_registry.evaluation.references import reference_policy
from sme_registry.terminal import out

SPEC = SMESpec(horizon=20)
DEEP = SMESpec(horizon=20, complexity=10, seed=1)
DISTRACTORS = 6
EXTENDED = SMESpec(
    horizon=20,
    safety={"tightness": 0.2},
    observation={"distractors": DISTRACTORS},
    policy_init="unit_variance",
)


def optimum(spec: SMESpec) -> Any:
    """π* of observations."""
    return reference_policy("optimal", spec)


def diagnosis_of(policy: Any, spec: SMESpec = SPEC, **options: Any) -> Diagnosis:
    settings = {"states": 2048, "episodes": 8, **options}
    return diagnose(load_policy(policy, spec), **settings)


def printed(parts: Iterable[Any], width: int | None) -> list[str]:
    """The lines on a terminal of this width, or in a pipe."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        console = out()
        if width is not None:
            console = Console(file=text, width=width, force_terminal=True, color_system=None)
        for part in parts:
            console.print(part)
    return [line.rstrip() for line in text.getvalue().splitlines()]


def faults(diagnosis: Diagnosis) -> set[str]:
    """The "where" questions that are answered yes."""
    return {v.question for v in diagnosis.verdicts if v.kind == "where" and v.answer == "yes"}


def one_channel_constant(observation: Any) -> Any:
    a = optimum(SPEC)(observation)
    a[:, 2] = 0.5
    return a


def inside_only(observation: Any) -> Any:
    s = observation[:, :8]
    inside = ((s >= 0) & (s <= 1)).all(axis=1, keepdims=True)
    return np.where(inside, optimum(SPEC)(observation), 0.5)


def left_half_only(observation: Any) -> Any:
    return np.where(observation[:, 4:5] < 0.5, optimum(SPEC)(observation), 0.5)


def near_the_centre_only(observation: Any) -> Any:
    near = np.abs(observation[:, :8] - 0.5).max(axis=1, keepdims=True) < 0.44
    return np.where(near, optimum(SPEC)(observation), 0.5)


def with_offset(observation: Any) -> Any:
    return optimum(SPEC)(observation) + 0.15


def shrunk(observation: Any) -> Any:
    return 0.5 + 0.3 * (optimum(SPEC)(observation) - 0.5)


def saturated(observation: Any) -> Any:
    return (optimum(SPEC)(observation) > 0.5).astype(float)


def time_dependent(observation: Any) -> Any:
    return optimum(SPEC)(observation) + 0.4 * (observation[:, 8:9] - 0.5)


class Noisy:
    def __init__(self) -> None:
        self.generator = np.random.default_rng(0)

    def __call__(self, observation: Any) -> Any:
        a = optimum(SPEC)(observation)
        return a + 0.1 * self.generator.standard_normal(a.shape)


def distracted(observation: Any) -> Any:
    """π* that adds a known function of the first four distractors."""
    return optimum(EXTENDED)(observation) + 0.2 * (observation[:, 8:12] - 0.5)


def network(hidden: int = 16, *, keeps: slice = slice(0, 8 + DISTRACTORS)) -> Perceptron:
    """A random network, whose only hidden layer has a linear image of these channels."""
    generator = np.random.default_rng(0)
    inside = np.zeros((EXTENDED.observation_dim, hidden))
    width = len(range(*keeps.indices(len(inside))))
    inside[keeps] = generator.normal(size=(width, hidden))
    outside = generator.normal(size=(hidden, EXTENDED.action_dim)) / (4 * hidden)
    return Perceptron(
        [
            (inside, np.zeros(hidden), "identity"),
            (outside, np.full(EXTENDED.action_dim, 0.5), "identity"),
        ]
    )
