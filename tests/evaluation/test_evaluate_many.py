"""`evaluate_many`: the reports of `evaluate`, with one pass for all tasks of the same draw."""

from importlib import import_module

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate
from sme_registry.errors import PolicyError
from sme_registry.evaluation import evaluate_many, regions
from sme_registry.evaluation.policies import as_policy
from sme_registry.spec import EvaluationProtocol
from sme_registry.task.engine import engine

SPEC = SMESpec(state_dim=3, action_dim=2, complexity=2, hidden_width=8)
SIBLINGS = [SPEC, SPEC.derive(k=10), SPEC.derive(r_min=0.5, D=0.25), SPEC.derive(horizon=7)]
TEAM = {"agents": [{"name": "left_0", "action_dim": 1}, {"name": "right_0", "action_dim": 1}]}
PROTOCOL = EvaluationProtocol(states_per_region=300, epsilons=(0.2, 1.0))


def timed(observations):
    """Actions that depend on t/T and leave the range in some states."""
    return observations[:, :2] + observations[:, -2:-1] - 0.4


def overwriting(observations):
    observations[:] = -5.0
    return np.full((len(observations), 2), 0.3)


def failing(observations):
    return np.full((len(observations), 2), np.nan)


class Oracles:
    """Counts the engines that evaluations make."""

    def __init__(self, monkeypatch):
        self.engines = 0
        monkeypatch.setattr(import_module("sme_registry.evaluation.evaluate"), "engine", self)

    def __call__(self, task):
        self.engines += 1
        return engine(task)


def test_each_report_is_that_of_evaluate():
    subjects = [(policy, spec) for spec in SIBLINGS for policy in (timed, overwriting)]
    subjects[3:3] = [("linear", SPEC.derive(seed=1)), ("optimal", SPEC.derive(team=TEAM))]
    for fields in ({"D": 0.0, "safety": {"tightness": 0.3}}, {"observation": {"distractors": 3}}):
        subjects += [(timed, spec.derive(**fields)) for spec in (SIBLINGS[2], SIBLINGS[3])]
    reports = evaluate_many(subjects, PROTOCOL)
    assert reports == [evaluate(policy, spec, PROTOCOL) for policy, spec in subjects]
    gated, plain = (each.safety.regions[0].step_reward for each in reports[-4:-2])
    assert gated < plain


def test_prepared_policies_keep_their_names_and_ranges():
    prepared = as_policy(timed, SPEC, action_range="symmetric", name="mine")
    assert evaluate_many([(prepared, SPEC)], PROTOCOL) == [
        evaluate(timed, SPEC, PROTOCOL, action_range="symmetric", name="mine")
    ]


def test_tasks_of_one_draw_share_a_pass(monkeypatch):
    oracles = Oracles(monkeypatch)
    evaluate_many([(timed, spec) for spec in SIBLINGS], PROTOCOL)
    assert oracles.engines == 1
    evaluate_many([(timed, spec) for spec in (*SIBLINGS, SPEC.derive(seed=1))], PROTOCOL)
    assert oracles.engines == 3


@pytest.mark.parametrize(
    "fields", [{}, {"D": 0.0, "safety": {"tightness": 0.3}}, {"observation": {"distractors": 3}}]
)
def test_a_policy_that_fails_has_its_error_and_the_others_go_on(fields):
    specs = [spec.derive(**fields) for spec in SIBLINGS[:3]]
    policies = (timed, failing, timed)
    first, error, last = evaluate_many(list(zip(policies, specs, strict=True)), PROTOCOL)
    assert isinstance(error, PolicyError)
    assert "'failing'" in str(error)
    assert [first, last] == [evaluate(timed, spec, PROTOCOL) for spec in (specs[0], specs[2])]


def test_a_pass_ends_once_all_of_its_policies_have_failed():
    calls = []
    reports = evaluate_many([(failing, SPEC)], PROTOCOL, progress=lambda *done: calls.append(done))
    assert [type(report) for report in reports] == [PolicyError]
    assert not calls


def test_progress_counts_shared_states_once_batch_by_batch(monkeypatch):
    monkeypatch.setattr(regions, "BATCH_ROWS", 100)
    calls = []
    specs = [*SIBLINGS, SPEC.derive(seed=1)]
    evaluate_many(
        [(timed, spec) for spec in specs], PROTOCOL, progress=lambda *done: calls.append(done)
    )
    assert [done for done, _ in calls] == [100 * part for part in range(1, 19)]
    assert {total for _, total in calls} == {1800}
