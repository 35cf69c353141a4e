"""Safety in a report: the numbers of METHOD's section 8, for the policy and the references."""

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate, materialize
from sme_registry.errors import SpecError
from sme_registry.evaluation import evaluate_many
from sme_registry.evaluation.references import NAMES, POLICIES, SAFE_NAMES
from tests.evaluation.kinds import PROTOCOL, SAFE, linear, observations, report_of


@pytest.fixture
def report():
    return report_of("safe")


def test_numbers_are_those_of_the_definition(report):
    task = materialize(SAFE)
    for index, score in enumerate(report.safety.regions):
        o = observations(PROTOCOL, index, SAFE)
        s, a = o[:, :4].astype(np.float64), np.clip(linear(o), 0.0, 1.0).astype(np.float64)
        reward, best = task.step_reward(s, a), task.step_reward(s, task.safe_action(s))
        assert score.name == report.regions[index].name
        assert score.step_reward == pytest.approx(reward.mean(), abs=1e-12)
        assert score.cost == pytest.approx(task.cost(s, a).mean(), abs=1e-12)
        assert score.violating_share == (a > task.limit(s) + 1e-6).any(axis=1).mean()
        assert score.safe_regret == pytest.approx((best - reward).mean(), abs=1e-12)
        assert score.price_of_safety == pytest.approx(1.0 - best.mean(), abs=1e-12)


def test_every_reference_has_its_known_safety(report):
    safety = report.safety
    assert tuple(safety.references) == tuple(report.references) == (*NAMES, *SAFE_NAMES)
    for region, score in enumerate(safety.regions):
        of = {name: scores[region] for name, scores in safety.references.items()}
        assert {score.price_of_safety for score in of.values()} == {score.price_of_safety}
        assert of["optimal"].step_reward == 1.0
        assert of["optimal"].safe_regret == pytest.approx(-score.price_of_safety, abs=1e-12)
        assert of["optimal"].cost > 0.0 < score.price_of_safety
        assert of["safe_projection"].safe_regret == 0.0 < of["shrunk_optimal"].safe_regret
        for name in SAFE_NAMES:
            assert of[name].cost == of[name].violating_share == 0.0


def test_limits_bite_in_about_the_share_that_the_tightness_says():
    spec = SMESpec(action_dim=1, safety={"tightness": 0.2})  # one channel: a state is a channel
    tasks = [("constant", spec.derive(seed=seed)) for seed in range(6)]
    reports = evaluate_many(tasks, {"states_per_region": 2000, "epsilons": [0.5]})
    optimal = [each.safety.references["optimal"][0] for each in reports]
    assert np.mean([score.violating_share for score in optimal]) == pytest.approx(0.2, abs=0.03)


def test_a_safe_action_that_float32_rounds_up_does_not_violate():
    task = materialize(SAFE)

    def rounded_up(observations):
        a = task.safe_action(observations[:, :4]).astype(np.float32)
        return np.nextafter(a, np.float32(2.0))

    score = evaluate(rounded_up, SAFE, PROTOCOL).safety.regions[0]
    assert score.violating_share == 0.0
    assert 0.0 < score.cost < 1e-6


@pytest.mark.parametrize("name", SAFE_NAMES)
def test_safe_references_by_name_have_the_reports_numbers_and_need_limits(report, name):
    evaluated = evaluate(name, SAFE, PROTOCOL).safety.regions
    for one, other in zip(evaluated, report.safety.references[name], strict=True):
        assert one.cost == pytest.approx(other.cost, abs=1e-9)
        assert one.step_reward == pytest.approx(other.step_reward, abs=1e-9)
    assert name in POLICIES
    with pytest.raises(SpecError, match="needs a task with safety"):
        evaluate(name, SMESpec(), PROTOCOL)


def test_limits_change_no_other_number(report):
    plain = evaluate(linear, SAFE.derive(safety=None), PROTOCOL)
    assert report.regions == plain.regions
    assert {name: report.references[name] for name in NAMES} == plain.references
