"""The whole six-region evaluation, references included, against one NumPy pass of the oracle."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import sme_registry
from sme_registry import EvaluationProtocol, SMESpec, materialize
from sme_registry.evaluation import evaluate_many

SPEC = SMESpec(complexity=10)
STATES = 6 * EvaluationProtocol().states_per_region
BLOCK = 4096


def linear_policy(seed: int) -> Any:
    random = np.random.default_rng(seed)
    weights = random.normal(size=(SPEC.state_dim, SPEC.action_dim)) / SPEC.state_dim
    return lambda observations: 0.5 + (observations[:, : SPEC.state_dim] - 0.5) @ weights


def test_six_regions_of_a_linear_policy(compare: Any) -> None:
    linear = linear_policy(0)

    def ours(times: int) -> None:
        for _ in range(times):
            sme_registry.evaluate(linear, SPEC, "paper-v1")

    task = materialize(SPEC)
    states = np.random.default_rng(0).random((STATES, SPEC.state_dim))

    def oracle(times: int) -> None:
        for _ in range(times):
            for first in range(0, STATES, BLOCK):
                task.optimal_action(states[first : first + BLOCK])

    # Target: at most 1.5 times the time of one pass.
    title = f"evaluate, {STATES:,} states, complexity 10"
    compare(title, "pass", ours, 1, {"NumPy oracle, one pass": (oracle, 1, 1 / 1.5)})


def test_three_policies_in_one_pass(compare: Any) -> None:
    policies = [(linear_policy(seed), SPEC.derive(k=k)) for seed, k in enumerate((1, 5, 10))]

    def together(times: int) -> None:
        for _ in range(times):
            evaluate_many(policies)

    def one_by_one(times: int) -> None:
        for _ in range(times):
            for policy, spec in policies:
                sme_registry.evaluate(policy, spec)

    title = "evaluate_many, 3 policies, complexity 10"
    compare(
        title, "pass", together, 1, {"evaluate, one by one": (one_by_one, 1, 2.0)},
        clock=time.process_time,
    )  # fmt: skip
