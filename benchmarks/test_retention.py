"""The whole retention matrix of five phases against one NumPy pass of one phase's oracle.

Counted is all of `evaluate_stream`: the states, the oracles of all five tasks, the actions of five
policies (networks of two layers of 64 in NumPy, as `sme train` evaluates SB3's), the references and
the report.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from sme_registry import SMESpec, StreamSpec, materialize
from sme_registry.evaluation import Perceptron, evaluate_stream

SPEC = SMESpec(complexity=10)
PROTOCOL = {"states_per_region": 10_000, "epsilons": [0.2, 0.4, 0.6, 0.8, 1.0]}
STATES = 60_000
BLOCK = 4096
PHASES = 5


def network(seed: int) -> Perceptron:
    random = np.random.default_rng(seed)
    widths = [SPEC.state_dim + 2, 64, 64, SPEC.action_dim]
    kinds = ["tanh", "tanh", "identity"]
    return Perceptron(
        [
            (random.normal(size=(inputs, outputs)) / np.sqrt(inputs), np.zeros(outputs), kind)
            for inputs, outputs, kind in zip(widths, widths[1:], kinds, strict=False)
        ]
    )


def test_retention_matrix_of_five_phases(compare: Any) -> None:
    phases = [{"spec": SPEC.derive(seed=seed), "steps": 20_000} for seed in range(PHASES)]
    stream = StreamSpec(phases=phases)
    policies = [network(seed) for seed in range(PHASES)]

    def ours(times: int) -> None:
        for _ in range(times):
            evaluate_stream(policies, stream, PROTOCOL)

    task = materialize(SPEC)
    states = np.random.default_rng(0).random((STATES, SPEC.state_dim))

    def oracle(times: int) -> None:
        for _ in range(times):
            for first in range(0, STATES, BLOCK):
                task.optimal_action(states[first : first + BLOCK])

    # Target: under 3 times the time of one pass, although there are five tasks.
    title = f"evaluate_stream, {PHASES} × {PHASES} phases, {STATES:,} states, complexity 10"
    compare(
        title, "matrix", ours, 1, {"NumPy oracle, one pass": (oracle, 1, 1 / 3)},
        clock=time.process_time,
    )  # fmt: skip
