"""Limits and distractors: a policy whose cause is known by construction has that cause."""

import functools

import numpy as np
import pytest

from sme_registry import evaluate
from sme_registry.diagnosis import Diagnosis, behaviour, diagnose, load_policy
from sme_registry.diagnosis.measure import POLICY
from sme_registry.diagnosis.questions import THRESHOLDS
from sme_registry.errors import OptionError
from sme_registry.evaluation.references import reference_policy
from tests.diagnosis.policies import (
    EXTENDED,
    SPEC,
    Noisy,
    diagnosis_of,
    distracted,
    network,
    optimum,
    shrunk,
)

MIXED = EXTENDED.derive(
    observation={"distractors": 4, "mixing": "nonlinear", "dynamics": "autonomous"}
)
ASKED = ("constraint_violation", "price_of_safety", "distraction", "distractors_outside")


def answers(diagnosis):
    return [diagnosis.verdict(question).answer for question in ASKED]


def verdict_of(policy, question):
    return diagnosis_of(policy, EXTENDED).verdict(question)


@functools.cache
def safe_projection():
    return reference_policy("safe_projection", EXTENDED)


def upper_bound_below(share):
    """The best safe action, or in this share of the states the upper bound in every channel."""
    return lambda o: np.where(o[:, :1] < share, 1.0, safe_projection()(o))


def third_channel(observation):
    a = safe_projection()(observation)
    a[:, 2] = 1.0
    return a


@pytest.mark.parametrize(
    ("policy", "answer", "reason"),
    [
        ("optimal", "yes", "beats_safe_projection"),
        ("safe_projection", "no", "within_limits"),
        ("constant", "no", "within_limits"),
        (distracted, "yes", "earns_by_violating"),
        (upper_bound_below(0.5), "yes", "violates_without_gain"),
        (upper_bound_below(0.02), "no", "rarely_violates"),
    ],
)
def test_violations_are_judged_by_what_they_earn(policy, answer, reason):
    verdict = verdict_of(policy, "constraint_violation")
    assert (verdict.answer, verdict.reason) == (answer, reason)
    if policy is distracted:
        assert verdict.evidence["safe_regret"] > 0.0
        assert verdict.evidence["gain"] > 0.01


def test_the_regret_of_the_safe_projection_is_the_price_of_safety_and_a_constant_has_no_fault():
    diagnosis = diagnosis_of("safe_projection", EXTENDED)
    assert answers(diagnosis) == ["no", "yes", "no", "no"]
    found = diagnosis.verdict("price_of_safety").evidence
    assert found["price_of_safety"] == pytest.approx(found["regret"])
    assert answers(diagnosis_of("constant", EXTENDED)) == ["no"] * 4


def test_the_channel_that_violates_is_named_and_costs_add_up():
    found = verdict_of(third_channel, "constraint_violation").evidence
    assert (found["channel"], found["channel_cost_share"]) == (3, pytest.approx(1.0))
    limits = diagnosis_of(third_channel, EXTENDED).measurements.limits
    costs = [channel.cost for channel in limits.channels]
    assert np.mean(costs) == pytest.approx(limits.report.regions[0].cost)
    assert limits.cut_off.cost == 0.0


def test_a_constant_that_violates_costs_as_much_where_it_goes_as_in_uniform_states():
    # The transition keeps the uniform distribution under a constant action.
    limits = diagnosis_of(upper_bound_below(np.inf), EXTENDED).measurements.limits
    uniform = limits.report.regions[0].cost
    assert limits.visited.cost == pytest.approx(uniform, rel=0.1)
    assert limits.visited.cost != pytest.approx(uniform, rel=1e-6)  # in other states
    assert limits.visited.violating_share == pytest.approx(1.0, abs=0.01)


def test_an_oracle_that_adds_a_function_of_the_distractors_owes_them_its_regret():
    diagnosis = diagnosis_of(distracted, EXTENDED)
    verdict = diagnosis.verdict("distraction")
    found = verdict.evidence
    assert (verdict.answer, verdict.reason) == ("yes", "distracted")
    # |a − a*| = 0.2 |d − ½|, of which the mean is 0.05: five points, but where it is clipped.
    assert found["owed_similarity"] == pytest.approx(5.0, abs=0.4)
    regret = diagnosis.measurements.policy.normalised_regret
    assert found["owed_regret"] == pytest.approx(regret, abs=0.02)
    assert found["averaged_regret"] < 0.02
    assert found["half_regret"] < 1e-6
    assert 0.95 < found["distractor_share"] <= 1.0
    rows = diagnosis.findings("Findings", diagnosis.verdicts).rows
    assert "distraction" in [question for question, _, _ in rows]


def test_the_share_of_the_error_is_of_the_states_that_the_variance_is_of():
    def sometimes(observation):  # in one state of ten
        rare = observation[:, :1] > 0.9
        return optimum(EXTENDED)(observation) + 0.6 * rare * (observation[:, 8:12] - 0.5)

    found = diagnosis_of(sometimes, EXTENDED).measurements.distraction
    assert 0.9 < found.distractor_share <= 1.0


def offset(observation):
    """Averaging over the distractors would remove nothing: the offset exceeds their effect."""
    return 0.5 * optimum(EXTENDED)(observation) - 0.2 + 0.02 * observation[:, 8:12]


@pytest.mark.parametrize(
    ("policy", "reasons", "low", "high"),
    [
        ("constant", ["invariant"], -1e-12, 1e-12),
        (offset, ["hardly_distracted"], 0.0, 0.01),
        (Noisy(EXTENDED), ["invariant", "hardly_distracted"], -1.0, 0.02),
    ],
    ids=["constant", "offset", "noisy"],
)
@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_what_is_not_owed_to_distractors(policy, reasons, low, high):
    verdict = verdict_of(policy, "distraction")
    assert verdict.answer == "no"
    assert verdict.reason in reasons
    assert low <= verdict.evidence["owed_regret"] <= high
    noise = verdict_of(policy, "action_noise").answer
    assert (noise == "yes") == isinstance(policy, Noisy)


def test_a_policy_that_fails_only_outside_the_distractors_cube_is_found():
    def inside_only(observation):
        d = observation[:, 8:-2]
        inside = ((d >= 0) & (d <= 1)).all(axis=1, keepdims=True)
        return np.where(inside, optimum(EXTENDED)(observation), 0.5)

    diagnosis = diagnosis_of(inside_only, EXTENDED)
    verdict = diagnosis.verdict("distractors_outside")
    assert (verdict.answer, verdict.evidence["region"]) == ("yes", "d-OOD 5")
    assert diagnosis.verdict("out_of_distribution").answer == "no"
    assert diagnosis.measurements.policy.normalised_regret < 1e-6


@pytest.mark.parametrize(
    ("kept", "answer", "reason"),
    [
        ((0, 14), "yes", "both_kept"),
        ((0, 8), "no", "state_alone_kept"),
        ((8, 14), "yes", "distractors_alone_kept"),
        ((0, 0), "no", "neither_kept"),
    ],
)
def test_what_the_last_hidden_layer_keeps(kept, answer, reason):
    verdict = verdict_of(network(*kept), "distractors_represented")
    assert (verdict.answer, verdict.reason) == (answer, reason)
    assert [layer["layer"] for layer in verdict.evidence["layers"]] == [0, 1]


def test_numbers_agree_with_evaluate():
    report = evaluate(distracted, EXTENDED, {"states_per_region": 2048})
    measured = diagnosis_of(distracted, EXTENDED).measurements
    assert measured.limits.report == report.safety
    assert measured.observation == report.observation
    assert measured.uniform[POLICY].mae == pytest.approx(report.regions[0].mae)


@pytest.mark.parametrize("name", ["optimal", "linear"])
def test_policies_and_references_see_the_state_behind_a_mixing(name):
    mixed = diagnosis_of(name, MIXED).measurements
    without = diagnosis_of(name, MIXED.derive(observation=None)).measurements
    on_policy = mixed.on_policy.scores, without.on_policy.scores
    # In episodes a rounding grows twofold at each step.
    for (scores, others), tolerance in (
        ((mixed.uniform, without.uniform), 1e-4),
        (on_policy, 0.02),
    ):
        for policy, score in scores.items():
            other = others[policy].normalised_regret
            assert score.normalised_regret == pytest.approx(other, abs=tolerance)
    assert mixed.response.steepness == pytest.approx(without.response.steepness, abs=1e-3)


def test_plain_tasks_and_mixings_alone_are_asked_nothing_of_limits_and_distractors():
    plain = diagnosis_of(shrunk)
    limited = diagnosis_of(shrunk, EXTENDED).thresholds
    assert set(limited) - set(plain.thresholds) == {
        "rarely_violating", "gain", "price_share", "distractor_loss", "kept_r2",
        "owed_to_distractors", "invariant",
    }  # fmt: skip
    assert THRESHOLDS.items() >= limited.items() >= plain.thresholds.items()
    assert not {"limits", "observation", "distraction"} & set(plain.to_dict()["measurements"])
    mixed = diagnosis_of("linear", SPEC.derive(observation={"mixing": "orthogonal"}))
    assert mixed.measurements.distraction is None
    assert "mixing=orthogonal" in mixed.title
    for diagnosis in (plain, mixed):
        asked = {verdict.question for verdict in diagnosis.verdicts}
        assert not asked & {*ASKED, "distractors_represented"}


def test_the_page_and_the_data_have_limits_distractors_and_layers():
    diagnosis = diagnosis_of(network(), EXTENDED)
    page = diagnosis.markdown(details=True)
    for heading in ("## Limits", "## Distractors", "## Layers"):
        assert heading in page
    assert Diagnosis.from_dict(diagnosis.to_dict(), "it") == diagnosis


def test_the_capacity_probe_sees_what_the_agent_sees(monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.setattr(behaviour, "GRADIENT_STEPS", 1000)
    subject = load_policy(network(), EXTENDED)
    said = []
    found = diagnose(subject, states=64, episodes=8, probe_capacity=True, progress=said.append)
    with pytest.raises(OptionError, match="'linear' are unknown"):
        diagnose(load_policy("linear", subject.spec), states=64, episodes=8, probe_capacity=True)
    assert any("capacity" in each for each in said)
    measured = found.measurements
    assert measured.capacity.layers == (EXTENDED.observation_dim, 16, EXTENDED.action_dim)
    assert measured.capacity.test_normalised_regret < 0.5
