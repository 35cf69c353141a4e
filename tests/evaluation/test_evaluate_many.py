"""`evaluate_many`: the reports of `evaluate`, with one pass for all tasks of the same draw."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate
from sme_registry.compiled import engine
from sme_registry.errors import PolicyError
from sme_registry.evaluation import as_policy, evaluate_many
from sme_registry.spec import EvaluationProtocol

SPEC = SMESpec(state_dim=3, action_dim=2, complexity=2, hidden_width=8)
SIBLINGS = [SPEC, SPEC.derive(k=10), SPEC.derive(r_min=0.5, D=0.25), SPEC.derive(horizon=7)]
TEAM = {"agents": [{"name": "left_0", "action_dim": 1}, {"name": "right_0", "action_dim": 1}]}
PROTOCOL = EvaluationProtocol(states_per_region=300, epsilons=(0.2, 1.0))


def timed(observations: Any) -> Any:
    """Actions that depend on t/T and leave the range in some states."""
    return observations[:, :2] + observations[:, -2:-1] - 0.4


def overwriting(observations: Any) -> Any:
    observations[:] = -5.0
    return np.full((len(observations), 2), 0.3)


def failing(observations: Any) -> Any:
    return np.full((len(observations), 2), np.nan)


class Oracles:
    """Counts the engines that evaluations make."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.engines = 0
        monkeypatch.setattr(import_module("sme_registry.evaluation.evaluate"), "engine", self)

    def __call__(self, task: Any) -> Any:
        self.engines += 1
        return engine(task)


def test_each_report_is_that_of_evaluate() -> None:
    subjects: list[tuple[Any, SMESpec]] = [
        (policy, spec) for spec in SIBLINGS for policy in (timed, overwriting)
    ]
    subjects[3:3] = [("linear", SPEC.derive(seed=1)), ("optimal", SPEC.derive(team=TEAM))]
    reports = evaluate_many(subjects, PROTOCOL)
    assert reports == [evaluate(policy, spec, PROTOCOL) for policy, spec in subjects]


def test_prepared_policies_keep_their_names_and_ranges() -> None:
    prepared = as_policy(timed, SPEC, action_range="symmetric", name="mine")
    assert evaluate_many([(prepared, SPEC)], PROTOCOL) == [
        evaluate(timed, SPEC, PROTOCOL, action_range="symmetric", name="mine")
    ]


def test_tasks_of_one_draw_share_a_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    oracles = Oracles(monkeypatch)
    evaluate_many([(timed, spec) for spec in SIBLINGS], PROTOCOL)
    assert oracles.engines == 1
    evaluate_many([(timed, spec) for spec in (*SIBLINGS, SPEC.derive(seed=1))], PROTOCOL)
    assert oracles.engines == 3


def test_a_policy_that_fails_has_its_error_and_the_others_go_on() -> None:
    first, error, last = evaluate_many(
        [(timed, SPEC), (failing, SIBLINGS[1]), (timed, SIBLINGS[2])], PROTOCOL
    )
    assert isinstance(error, PolicyError)
    assert "'failing'" in str(error)
    assert [first, last] == [evaluate(timed, spec, PROTOCOL) for spec in (SPEC, SIBLINGS[2])]


def test_a_pass_ends_once_all_of_its_policies_have_failed() -> None:
    calls: list[tuple[int, int]] = []
    reports = evaluate_many([(failing, SPEC)], PROTOCOL, progress=lambda *done: calls.append(done))
    assert [type(report) for report in reports] == [PolicyError]
    assert not calls


def test_progress_counts_shared_states_once() -> None:
    calls: list[tuple[int, int]] = []
    specs = [*SIBLINGS, SPEC.derive(seed=1)]
    evaluate_many(
        [(timed, spec) for spec in specs], PROTOCOL, progress=lambda *done: calls.append(done)
    )
    assert [done for done, _ in calls] == [300 * part for part in range(1, 7)]
    assert {total for _, total in calls} == {1800}


def test_nothing_to_evaluate_gives_nothing() -> None:
    assert evaluate_many([], PROTOCOL) == []
