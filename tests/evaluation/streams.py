"""Small streams, and policies of their tasks."""

import numpy as np

from sme_registry import SMESpec
from sme_registry.evaluation import Perceptron
from sme_registry.spec import StreamSpec

SPEC = SMESpec(state_dim=4, action_dim=2, hidden_width=8, complexity=2, horizon=10)


def stream_of(*specs, steps=50, drift=None, **fields):
    """Phases of equal length, of which the last may drift."""
    phases = [{"spec": spec, "steps": steps} for spec in specs]
    if drift:
        phases[-1]["drift"] = drift
    return StreamSpec(phases=phases, **fields)


TWICE = stream_of(SPEC, SPEC.derive(seed=1), cycles=2)


def network(seed, inputs=SPEC.state_dim + 2):
    """A random linear policy."""
    W = np.random.default_rng(seed).normal(size=(inputs, SPEC.action_dim)) / 2
    return Perceptron([(W, np.full(SPEC.action_dim, 0.5), "identity")])


def half(observations):
    return np.full((len(observations), SPEC.action_dim), 0.5)
