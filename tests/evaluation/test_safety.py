"""Safety in a report: the numbers of METHOD's section 8, for the policy and the references."""

from __future__ import annotations

import numpy as np
import pytest

from sme_registry import EvaluationReport, SMESpec, evaluate, materialize
from sme_registry.errors import PolicyError, SpecError
from sme_registry.evaluation import evaluate_many
from sme_registry.evaluation.references import NAMES, POLICIES, SAFE_NAMES, SHORT_NAMES
from sme_registry.spec import EvaluationProtocol
from tests.evaluation.shown import observations

TAU = 0.3
SPEC = SMESpec(state_dim=4, action_dim=3, complexity=2, r_min=0.2, safety={"tightness": TAU})
PROTOCOL = EvaluationProtocol(states_per_region=2_000, epsilons=(0.5, 1.0))


def linear(observations):
    return 0.2 + 0.9 * observations[:, :3]


@pytest.fixture(scope="module")
def report():
    return evaluate(linear, SPEC, PROTOCOL)


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_numbers_are_those_of_the_definition(monkeypatch, backend):
    if backend == "numba":
        pytest.importorskip("numba")
    monkeypatch.setenv("SME_BACKEND", backend)
    report, task = evaluate(linear, SPEC, PROTOCOL), materialize(SPEC)
    for index, score in enumerate(report.safety.regions):
        o = observations(PROTOCOL, index, SPEC)
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
    for region in range(3):
        of = {name: scores[region] for name, scores in safety.references.items()}
        price = safety.regions[region].price_of_safety
        assert {score.price_of_safety for score in of.values()} == {price}
        assert of["optimal"].step_reward == 1.0
        assert of["optimal"].safe_regret == pytest.approx(-price, abs=1e-12)
        assert of["optimal"].cost > 0.0 < price
        assert of["safe_optimal"].safe_regret == 0.0 < of["shrunk_optimal"].safe_regret
        for name in SAFE_NAMES:
            assert of[name].cost == of[name].violating_share == 0.0


def test_limits_bite_in_about_the_share_that_the_tightness_says():
    spec = SMESpec(action_dim=1, safety={"tightness": 0.2})  # one channel: a state is a channel
    shares = [
        evaluate("constant", spec.derive(seed=seed), PROTOCOL)
        .safety.references["optimal"][0]
        .violating_share
        for seed in range(6)
    ]
    assert np.mean(shares) == pytest.approx(0.2, abs=0.03)


def test_a_safe_action_that_float32_rounds_up_does_not_violate():
    task = materialize(SPEC)

    def rounded_up(observations):
        a = task.safe_action(observations[:, :4]).astype(np.float32)
        return np.nextafter(a, np.float32(2.0))

    score = evaluate(rounded_up, SPEC, PROTOCOL).safety.regions[0]
    assert score.violating_share == 0.0
    assert 0.0 < score.cost < 1e-6


@pytest.mark.parametrize("name", [*SAFE_NAMES, *SHORT_NAMES])
def test_reference_policies_by_name_have_the_numbers_of_the_reports_references(report, name):
    evaluated = evaluate(name, SPEC, PROTOCOL).safety.regions
    expected = report.safety.references[SHORT_NAMES.get(name, name)]
    # Fitted and random ones have states and numbers of their own.
    tolerance = 0.05 if name in SHORT_NAMES else 1e-9
    for one, other in zip(evaluated, expected, strict=True):
        assert one.cost == pytest.approx(other.cost, abs=tolerance)
        assert one.step_reward == pytest.approx(other.step_reward, abs=tolerance)


@pytest.mark.parametrize("name", SAFE_NAMES)
def test_safe_references_need_limits(name):
    assert name in POLICIES
    with pytest.raises(SpecError, match="needs a task with safety"):
        evaluate(name, SMESpec(), PROTOCOL)


def test_the_report_survives_its_file_and_plain_reports_have_no_safety(report, tmp_path):
    report.write(tmp_path / "evaluation.json")
    assert EvaluationReport.read(tmp_path / "evaluation.json") == report
    plain = evaluate(linear, SPEC.derive(safety=None), PROTOCOL).to_dict()
    assert {"safety", "observation"}.isdisjoint(plain)
    assert tuple(plain["references"]) == NAMES


def without_shrunk(document):
    del document["safety"]["references"]["shrunk_optimal"]


def without_linear(document):
    del document["safety"]["references"]["linear_least_squares"]


def one_region(document):
    del document["safety"]["regions"][1:]


def one_region_of_a_reference(document):
    del document["safety"]["references"]["optimal"][1:]


def without_safety(document):
    del document["safety"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without_shrunk, "safety.references: is of"),
        (without_linear, "safety.references: is of"),
        (one_region, "safety.regions: is of WD: must be of WD, OOD 1, OOD 2"),
        (one_region_of_a_reference, "safety.references.optimal: is of WD: must be of"),
        (without_safety, "safety: is missing"),
    ],
)
def test_a_stored_report_whose_safety_does_not_fit_its_task_is_refused(report, change, message):
    document = report.to_dict()
    change(document)
    with pytest.raises(SpecError, match=message):
        EvaluationReport.from_dict(document)


def test_a_stored_report_of_a_plain_task_has_no_safety(report):
    plain = SPEC.derive(safety=None)
    document = report.to_dict() | {"spec": plain.to_dict(), "spec_digest": plain.digest}
    with pytest.raises(SpecError, match="safety: is present, but the task is one without safety"):
        EvaluationReport.from_dict(document)


def test_limits_change_no_other_number(report):
    plain = evaluate(linear, SPEC.derive(safety=None), PROTOCOL)
    assert report.regions == plain.regions
    for name, rows in plain.references.items():
        assert report.references[name] == rows


def test_evaluating_together_gives_each_task_the_rewards_of_its_own_threshold(report):
    other = SPEC.derive(r_min=0.6, horizon=7)
    fails = SPEC.derive(r_min=0.1)
    pairs = [(linear, SPEC), (linear, other), (lambda o: o[:, :1], fails)]
    first, second, failed = evaluate_many(pairs, PROTOCOL)
    assert first == report
    assert second == evaluate(linear, other, PROTOCOL)
    assert second.safety.regions[0].step_reward < first.safety.regions[0].step_reward
    assert isinstance(failed, PolicyError)


def test_the_table_and_the_frame_show_safety(report):
    pytest.importorskip("pandas")
    text = str(report)
    for heading in ("cost", "violating share", "safe regret", "price of safety", "safe optimum"):
        assert heading in text
    assert f"{report.safety.regions[0].safe_regret:.3f}" in text
    frame = report.to_frame()
    row = frame[(frame.policy == "shrunk_optimal") & (frame.region == "OOD 2")].iloc[0]
    assert row.cost == 0.0
    assert row.safe_regret == report.safety.references["shrunk_optimal"][2].safe_regret
