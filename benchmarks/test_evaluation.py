"""The whole six-region evaluation, references included, against one NumPy pass of the oracle."""

from __future__ import annotations

from typing import Any

import numpy as np

import sme_registry
from sme_registry import EvaluationProtocol, SMESpec, materialize

SPEC = SMESpec(complexity=10)
STATES = 6 * EvaluationProtocol().states_per_region
BLOCK = 4096


def test_six_regions_of_a_linear_policy(compare: Any) -> None:
    random = np.random.default_rng(0)
    weights = random.normal(size=(SPEC.state_dim, SPEC.action_dim)) / SPEC.state_dim

    def linear(observations: Any) -> Any:
        return 0.5 + (observations[:, : SPEC.state_dim] - 0.5) @ weights

    def ours(times: int) -> None:
        for _ in range(times):
            sme_registry.evaluate(linear, SPEC, "paper-v1")

    task = materialize(SPEC)
    states = random.random((STATES, SPEC.state_dim))

    def oracle(times: int) -> None:
        for _ in range(times):
            for first in range(0, STATES, BLOCK):
                task.optimal_action(states[first : first + BLOCK])

    # Target: at most 1.5 times the time of one pass.
    title = f"evaluate, {STATES:,} states, complexity 10"
    compare(title, "pass", ours, 1, {"NumPy oracle, one pass": (oracle, 1, 1 / 1.5)})
