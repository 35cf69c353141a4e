"""Limits and distractors: a policy whose cause is known by construction has that cause."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sme_registry import SMESpec, evaluate
from sme_registry.diagnosis import Diagnosis, diagnose, load_policy, render
from sme_registry.diagnosis.figures import draw
from sme_registry.diagnosis.measurements import POLICY
from sme_registry.diagnosis.questions import EXTENDED_THRESHOLDS, THRESHOLDS
from sme_registry.evaluation.references import reference_policy
from tests.diagnosis.policies import (
    EXTENDED,
    SPEC,
    diagnosis_of,
    distracted,
    network,
    optimum,
    printed,
    shrunk,
)
from tests.geometry import assert_readable

MIXED = EXTENDED.derive(
    observation={"distractors": 4, "mixing": "nonlinear", "dynamics": "autonomous"}
)
ASKED = ("constraint_violation", "price_of_safety", "distraction", "distractors_outside",
         "distractors_represented")  # fmt: skip


def answers(diagnosis: Diagnosis) -> dict[str, str]:
    return {question: diagnosis.verdict(question).answer for question in ASKED[:4]}


def evidence(diagnosis: Diagnosis, question: str) -> dict[str, Any]:
    return diagnosis.verdict(question).evidence


def named(name: str, spec: SMESpec = EXTENDED) -> Diagnosis:
    return diagnosis_of(reference_policy(name, spec), spec)


def test_the_optimum_violates_limits_in_the_share_of_the_tightness_and_earns_by_it() -> None:
    diagnosis = named("optimal")
    assert answers(diagnosis) == {
        "constraint_violation": "yes", "price_of_safety": "no", "distraction": "no",
        "distractors_outside": "no",
    }  # fmt: skip
    verdict = diagnosis.verdict("constraint_violation")
    assert verdict.reason == "beats_safe_optimum"
    found: Any = verdict.evidence
    assert found["violating_entries"] == pytest.approx(0.2, abs=0.04)
    assert found["cost"] == found["optimal_cost"]
    assert found["gain"] == pytest.approx(found["price_of_safety"])
    assert found["safe_regret"] == pytest.approx(-found["price_of_safety"])
    assert "Near the optimum without limits" in render.headline(diagnosis)
    assert "Limits: constraint violation." in render.headline(diagnosis)


def test_the_safe_optimum_violates_nothing_and_its_regret_is_the_price_of_safety() -> None:
    diagnosis = named("safe_optimal")
    assert answers(diagnosis) == {
        "constraint_violation": "no", "price_of_safety": "yes", "distraction": "no",
        "distractors_outside": "no",
    }  # fmt: skip
    assert diagnosis.verdict("constraint_violation").reason == "within_limits"
    found = evidence(diagnosis, "price_of_safety")
    assert found["price_of_safety"] == pytest.approx(found["regret"])


def test_a_constant_is_neither_distracted_nor_unsafe() -> None:
    diagnosis = named("constant")
    assert set(answers(diagnosis).values()) == {"no"}
    assert diagnosis.verdict("constraint_violation").reason == "within_limits"
    assert diagnosis.verdict("distraction").reason == "invariant"
    assert evidence(diagnosis, "distraction")["owed_regret"] == pytest.approx(0.0, abs=1e-12)


def test_an_oracle_that_adds_a_function_of_the_distractors_owes_them_its_regret() -> None:
    diagnosis = diagnosis_of(distracted, EXTENDED)
    verdict = diagnosis.verdict("distraction")
    assert (verdict.answer, verdict.reason) == ("yes", "distracted")
    found: Any = verdict.evidence
    # |a − a*| = 0.2 |d − ½|, of which the mean is 0.05: five points, but where it is clipped.
    assert found["owed_similarity"] == pytest.approx(5.0, abs=0.4)
    assert found["owed_regret"] == pytest.approx(
        diagnosis.measurements.policy.normalised_regret, abs=0.02
    )
    assert found["averaged_regret"] < 0.02
    assert found["half_regret"] < 1e-6
    assert 0.95 < found["distractor_share"] <= 1.0
    assert "Why: distraction." in render.headline(diagnosis)


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_the_share_of_the_error_is_of_the_states_that_the_variance_is_of(channel: int) -> None:
    def sometimes(observation: Any) -> Any:  # in one state of ten
        rare = observation[:, channel : channel + 1] > 0.9
        return optimum(EXTENDED)(observation) + 0.6 * rare * (observation[:, 8:12] - 0.5)

    found = diagnosis_of(sometimes, EXTENDED).measurements.distraction
    assert found is not None
    assert 0.9 < found.distractor_share <= 1.0


def test_distractors_that_only_hide_another_fault_owe_little() -> None:
    # Averaging over the distractors would remove nothing: the offset is larger than their effect.
    def offset(observation: Any) -> Any:
        return 0.5 * optimum(EXTENDED)(observation) - 0.2 + 0.02 * observation[:, 8:12]

    verdict = diagnosis_of(offset, EXTENDED).verdict("distraction")
    assert (verdict.answer, verdict.reason) == ("no", "hardly_distracted")
    assert 0.0 <= verdict.evidence["owed_regret"] < 0.01


def test_a_random_policy_is_noisy_and_not_distracted() -> None:
    generator = np.random.default_rng(0)

    def noisy(observation: Any) -> Any:
        a = optimum(EXTENDED)(observation)
        return a + 0.1 * generator.standard_normal(a.shape)

    diagnosis = diagnosis_of(noisy, EXTENDED)
    assert diagnosis.verdict("action_noise").answer == "yes"
    assert diagnosis.verdict("distraction").answer == "no"
    assert evidence(diagnosis, "distraction")["owed_regret"] < 0.02


def test_a_policy_that_fails_only_outside_the_distractors_cube_is_found() -> None:
    def inside_only(observation: Any) -> Any:
        d = observation[:, 8:-2]
        inside = ((d >= 0) & (d <= 1)).all(axis=1, keepdims=True)
        return np.where(inside, optimum(EXTENDED)(observation), 0.5)

    diagnosis = diagnosis_of(inside_only, EXTENDED)
    verdict = diagnosis.verdict("distractors_outside")
    assert (verdict.answer, verdict.evidence["region"]) == ("yes", "d-OOD 5")
    assert diagnosis.verdict("out_of_distribution").answer == "no"
    assert diagnosis.measurements.policy.normalised_regret < 1e-6


@pytest.mark.parametrize(
    ("above", "answer", "reason"),
    [(0.5, "yes", "violates_without_gain"), (0.02, "no", "rarely_violates")],
)
def test_a_violation_without_gain_and_a_rare_one(above: float, answer: str, reason: str) -> None:
    """The best safe action, or in a share of the states the upper bound in every channel."""
    safe = reference_policy("safe_optimal", EXTENDED)

    def sometimes(observation: Any) -> Any:
        return np.where(observation[:, :1] < above, 1.0, safe(observation))

    verdict = diagnosis_of(sometimes, EXTENDED).verdict("constraint_violation")
    assert (verdict.answer, verdict.reason) == (answer, reason)


def test_a_policy_that_earns_by_violating_without_beating_the_safe_optimum() -> None:
    verdict = diagnosis_of(distracted, EXTENDED).verdict("constraint_violation")
    assert verdict.reason == "earns_by_violating"
    assert verdict.evidence["safe_regret"] > 0.0
    assert verdict.evidence["gain"] > 0.01


def test_the_channel_that_violates_is_named_and_costs_add_up() -> None:
    safe = reference_policy("safe_optimal", EXTENDED)

    def third_channel(observation: Any) -> Any:
        a = safe(observation)
        a[:, 2] = 1.0
        return a

    diagnosis = diagnosis_of(third_channel, EXTENDED)
    found = evidence(diagnosis, "constraint_violation")
    assert (found["channel"], found["channel_cost_share"]) == (3, pytest.approx(1.0))
    limits = diagnosis.measurements.limits
    assert limits is not None
    costs = [channel.cost for channel in limits.channels]
    assert np.mean(costs) == pytest.approx(limits.report.regions[0].cost)
    assert limits.cut_off.cost == 0.0


@pytest.mark.parametrize(
    ("keeps", "answer", "reason"),
    [
        (slice(0, 14), "yes", "both_kept"),
        (slice(0, 8), "no", "state_alone_kept"),
        (slice(8, 14), "yes", "distractors_alone_kept"),
        (slice(0, 0), "no", "neither_kept"),
    ],
)
def test_what_the_last_hidden_layer_keeps(keeps: slice, answer: str, reason: str) -> None:
    verdict = diagnosis_of(network(keeps=keeps), EXTENDED).verdict("distractors_represented")
    assert (verdict.answer, verdict.reason) == (answer, reason)
    layers: Any = verdict.evidence["layers"]
    assert [layer["layer"] for layer in layers] == [0, 1]


def test_numbers_agree_with_evaluate() -> None:
    report = evaluate(distracted, EXTENDED, {"states_per_region": 2048})
    measured = diagnosis_of(distracted, EXTENDED).measurements
    assert measured.limits is not None
    assert measured.limits.report == report.safety
    assert measured.observation == report.observation
    assert measured.uniform[POLICY].mae == pytest.approx(report.regions[0].mae)


@pytest.mark.parametrize("name", ["optimal", "linear"])
def test_policies_and_references_see_the_state_behind_a_mixing(name: str) -> None:
    plain = MIXED.derive(observation=None)
    mixed = diagnosis_of(reference_policy(name, MIXED), MIXED).measurements
    without = diagnosis_of(reference_policy(name, plain), plain).measurements
    on_policy = mixed.on_policy.scores, without.on_policy.scores
    # In episodes a rounding grows twofold at each step.
    for (scores, others), tolerance in (
        ((mixed.uniform, without.uniform), 1e-4),
        (on_policy, 0.02),
    ):
        for policy, score in scores.items():
            other = others[policy].normalised_regret
            assert score.normalised_regret == pytest.approx(other, abs=tolerance)
    assert mixed.response.sensitivity == pytest.approx(without.response.sensitivity, abs=1e-3)


def test_equal_seeds_give_equal_diagnoses_although_distractors_are_random() -> None:
    assert diagnosis_of(distracted, EXTENDED) == diagnosis_of(distracted, EXTENDED)


def test_visited_states_have_the_cost_of_the_environment() -> None:
    """A constant that violates has the same mean cost wherever its states are uniform."""
    limits = diagnosis_of(lambda observation: np.ones((len(observation), 4)), EXTENDED)
    measured = limits.measurements.limits
    assert measured is not None
    # The transition keeps the uniform distribution under a constant action.
    assert measured.visited.cost == pytest.approx(measured.report.regions[0].cost, rel=0.1)
    assert measured.visited.violating_share == pytest.approx(1.0, abs=0.01)


def test_documents_of_plain_tasks_have_none_of_it() -> None:
    plain = diagnosis_of(shrunk, SPEC)
    assert not set(EXTENDED_THRESHOLDS) & set(plain.thresholds)
    assert plain.thresholds == THRESHOLDS
    assert not {verdict.question for verdict in plain.verdicts} & set(ASKED)
    assert not {"limits", "observation", "distraction"} & set(plain.to_dict()["measurements"])


def test_a_mixing_alone_asks_nothing_of_distractors() -> None:
    spec = SPEC.derive(observation={"mixing": "orthogonal"})
    diagnosis = diagnosis_of(reference_policy("linear", spec), spec)
    assert not {verdict.question for verdict in diagnosis.verdicts} & set(ASKED)
    assert diagnosis.measurements.distraction is None
    assert "mixing=orthogonal" in render.title(diagnosis)


def test_the_page_the_terminal_and_the_data_have_limits_distractors_and_layers(
    tmp_path: Any, figures: list[Any]
) -> None:
    diagnosis = diagnosis_of(network(), EXTENDED, states=256)
    names = [path.name for path in draw(diagnosis, tmp_path) if path.suffix == ".png"]
    assert {"limits.png", "distraction.png", "layers.png"} <= set(names)
    for figure in figures:
        assert_readable(figure)
    page = render.markdown(diagnosis, names)
    for heading in ("## Limits", "## Distractors", "## Layers"):
        assert heading in page
    tables = [line for line in page.splitlines() if line.startswith("|")]
    assert all(line.endswith("|") for line in tables)
    shown = " ".join(" ".join(printed(render.terminal(diagnosis), None)).split())
    for verdict in diagnosis.verdicts:
        assert render.sentence(verdict) in shown
        assert render.sentence(verdict).replace("|", r"\|") in page
    assert Diagnosis.from_dict(diagnosis.to_dict(), "it") == diagnosis


def test_the_capacity_probe_sees_what_the_agent_sees() -> None:
    pytest.importorskip("torch")
    subject = load_policy(network(), EXTENDED)
    measured = diagnose(subject, states=64, episodes=8, probe_capacity=True).measurements
    assert measured.capacity is not None
    assert measured.capacity.layers == (EXTENDED.observation_dim, 16, EXTENDED.action_dim)
    assert measured.capacity.test_normalised_regret < 0.5
