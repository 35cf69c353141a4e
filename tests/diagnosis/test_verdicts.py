"""Verdicts: a policy with a known fault is found to have that fault and no other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sme_registry.diagnosis import Subject, Verdict, diagnose, load_policy, verdicts
from sme_registry.diagnosis.document import CapacityProbe
from sme_registry.diagnosis.subject import Log
from sme_registry.evaluation.references import reference_policy
from tests.diagnosis.policies import (
    DEEP,
    SPEC,
    Noisy,
    diagnosis_of,
    faults,
    inside_only,
    left_half_only,
    near_the_centre_only,
    one_channel_constant,
    optimum,
    saturated,
    shrunk,
    time_dependent,
    with_offset,
)

FAULTS = {
    "action_channels", "state_region", "out_of_distribution", "constant_offset", "response_scale",
    "linear_only", "saturation", "action_noise", "time_dependence",
}  # fmt: skip


def constant(spec: Any) -> Any:
    return reference_policy("constant", spec)


@pytest.mark.parametrize(
    ("policy", "found", "reason", "evidence"),
    [
        # Most of the error is then that this channel does not follow the state.
        (
            one_channel_constant,
            ["action_channels", "response_scale"],
            "some_channels_unlearnt",
            {"channels": 4},
        ),
        (inside_only, ["out_of_distribution"], "similarity_lost", {"region": "OOD 5"}),
        (left_half_only, ["state_region"], "error_localised", {"state_channel": 5}),
        (
            near_the_centre_only,
            ["state_region", "out_of_distribution", "response_scale"],
            "error_localised",
            {"state_channel": None},
        ),
        (with_offset, ["constant_offset"], "offset_dominant", {"offset": (0.1, 0.16)}),
        (shrunk, ["response_scale"], "underreaction", {"slope": (0.299, 0.301)}),
        (saturated, ["saturation"], "saturated", {"saturation": 1.0}),
        (time_dependent, ["time_dependence"], "depends_on_time", {"time_share": (0.9, 1.2)}),
        (Noisy(), ["action_noise"], "noisy", {"share": (0.9, 1.1)}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_policy_with_one_known_fault_has_that_fault(
    policy: Any, found: list[str], reason: str, evidence: dict[str, Any]
) -> None:
    diagnosis = diagnosis_of(policy)
    assert faults(diagnosis) & FAULTS == set(found)
    verdict = diagnosis.verdict(found[0])
    assert verdict.reason == reason
    for name, expected in evidence.items():
        value: Any = verdict.evidence[name]
        if isinstance(expected, tuple):
            assert expected[0] < value < expected[1]
        else:
            assert value == expected


def test_the_unlearnt_channel_is_named() -> None:
    evidence: Any = diagnosis_of(one_channel_constant).verdict("action_channels").evidence
    assert [channel["channel"] for channel in evidence["unlearnt"]] == [3]
    assert evidence["regret_share"] == pytest.approx(1.0)


def test_the_optimum_has_no_fault_and_is_solved() -> None:
    diagnosis = diagnosis_of(optimum(DEEP), DEEP)
    assert {v.answer for v in diagnosis.verdicts} == {"no"}
    assert {v.reason for v in diagnosis.verdicts if v.kind == "why"} == {"solved"}
    assert diagnosis.level == "solved"
    assert diagnosis.measurements.policy.regret == 0.0


def test_a_linear_policy_of_a_deep_task_has_only_the_linear_part() -> None:
    diagnosis = diagnosis_of(reference_policy("linear", DEEP), DEEP)
    response = diagnosis.measurements.response
    assert diagnosis.verdict("linear_only").reason == "nonlinear_part_unlearnt"
    assert response.linear_slope == pytest.approx(1.0, abs=0.05)
    assert response.nonlinear_slope == pytest.approx(0.0, abs=0.05)
    assert response.nonlinear_variance > 0.15


def test_a_constant_whose_rewards_r_min_removes_fails_by_sparsity() -> None:
    spec = SPEC.derive(r_min=0.75)
    diagnosis = diagnosis_of(constant(spec), spec)
    signal = diagnosis.measurements.on_policy.signal
    assert diagnosis.level == "no_better_than_constant"
    assert diagnosis.verdict("sparsity").reason == "rewards_gated"
    assert diagnosis.verdict("sparsity").answer == "yes"
    assert signal.gated >= 0.25
    assert signal.rewarded + signal.gated + signal.flat == pytest.approx(1.0)
    same = diagnosis_of(constant(SPEC), SPEC)
    assert same.verdict("sparsity").reason == "no_reward_threshold"
    assert (
        same.measurements.policy.normalised_regret
        == diagnosis.measurements.policy.normalised_regret
    )


def test_one_run_with_delayed_payouts_does_not_show_whether_they_are_the_cause() -> None:
    spec = SPEC.derive(k=5, horizon=50)
    verdict = diagnosis_of(constant(spec), spec).verdict("credit_assignment")
    assert (verdict.answer, verdict.reason) == ("cannot tell", "delayed_payout")
    assert verdict.evidence["k"] == 5


def test_a_survival_threshold_that_terminates_episodes_is_found() -> None:
    spec = SPEC.derive(D=0.9)
    diagnosis = diagnosis_of(shrunk, spec)
    on_policy = diagnosis.measurements.on_policy
    assert diagnosis.verdict("survival").reason == "episodes_cut_short"
    assert on_policy.mean_length < 5
    assert on_policy.alive[-1] < 0.1 or len(on_policy.alive) < 10
    assert diagnosis_of(optimum(spec), spec).measurements.on_policy.mean_length == spec.horizon


@pytest.mark.parametrize(
    ("regret", "exploration", "budget"),
    [
        (np.linspace(0.95, 0.4, 100), "beat_constant_in_training", "still_improving"),
        (
            np.r_[np.linspace(0.95, 0.4, 30), np.full(70, 0.4)],
            "beat_constant_in_training",
            "plateaued",
        ),
        (np.r_[np.full(50, 0.4), np.full(50, 0.95)], "beat_constant_in_training", "regressed"),
        (np.full(100, 0.93), "rewards_found", "never_improved"),
    ],
    ids=["still improving", "plateaued", "regressed", "never improved"],
)
def test_the_training_log_decides_exploration_and_budget(
    regret: Any, exploration: str, budget: str
) -> None:
    log = Log("episodes", np.arange(1, 101) * 20.0, regret, regret >= 1, np.zeros(100))
    subject = Subject("it", SPEC, load_policy(constant(SPEC), SPEC).policy, {}, log)
    diagnosis = diagnose(subject, states=256, episodes=8)
    assert diagnosis.verdict("exploration").reason == exploration
    assert diagnosis.verdict("budget").reason == budget
    assert diagnosis.measurements.training is not None


def test_random_actions_without_reward_and_no_learning_make_exploration_the_cause() -> None:
    spec = SPEC.derive(r_min=0.9, action_dim=8)
    log = Log("episodes", np.arange(1, 31) * 20.0, np.ones(30), np.ones(30), np.zeros(30))
    policy = load_policy(constant(spec), spec).policy
    diagnosis = diagnose(Subject("it", spec, policy, {}, log), states=256, episodes=8)
    assert diagnosis.verdict("exploration").reason == "rewards_too_rare"
    assert diagnosis.verdict("sparsity").evidence["unrewarded_episodes"] == 1.0


@pytest.mark.parametrize(
    ("train", "test", "capacity", "dimension"),
    [
        (0.05, 0.06, "network_does_better", "states_sufficient"),
        (0.95, 0.96, "network_cannot_fit", "not_separated"),
        (0.05, 0.95, "network_fits_training_states_only", "too_few_states"),
        (0.6, 0.65, "probe_inconclusive", "not_separated"),
    ],
)
def test_the_probe_separates_capacity_from_too_few_states(
    train: float, test: float, capacity: str, dimension: str
) -> None:
    measured = diagnosis_of(constant(SPEC)).measurements
    probe = CapacityProbe(
        layers=(10, 4), states=1000, gradient_steps=1, train_normalised_regret=train,
        test_normalised_regret=test, seconds=0,
    )  # fmt: skip
    judged = verdicts.judge(measured.model_copy(update={"capacity": probe}), SPEC)
    reasons = {verdict.question: verdict.reason for verdict in judged}
    assert reasons["capacity"] == capacity
    assert reasons["dimension"] == dimension


def test_a_comparison_in_one_field_decides_its_question_and_in_two_decides_none() -> None:
    k5 = SPEC.derive(k=5)
    better, worse = load_policy(shrunk, SPEC), load_policy(saturated, k5)
    diagnosis = diagnose(worse, against=better, states=256, episodes=8)
    assert diagnosis.comparison is not None
    assert diagnosis.comparison.spec_fields == {"k": (5, 1)}
    regret = diagnosis.comparison.differences[0]
    expected = diagnosis_of(shrunk, states=256).measurements.policy.normalised_regret
    assert regret.quantity == "normalised_regret"
    assert regret.value - regret.other == pytest.approx(
        diagnosis.measurements.policy.normalised_regret - expected
    )
    verdict = diagnosis.verdict("credit_assignment")
    raised = regret.value - regret.other >= 0.1
    assert verdict.reason == ("field_raises_regret" if raised else "field_does_not_raise_regret")
    assert verdict.evidence["field"] == "k"
    two = load_policy(saturated, k5.derive(r_min=0.5))
    diagnosis = diagnose(two, against=better, states=256, episodes=8)
    assert diagnosis.verdict("credit_assignment").answer == "cannot tell"


def test_a_run_that_has_not_learnt_either_does_not_clear_a_field() -> None:
    def credit(policy: Any, other: Any, k: int = 100) -> Verdict:
        spec, other_spec = SPEC.derive(k=k, horizon=100), SPEC.derive(k=101 - k, horizon=100)
        subject, against = load_policy(policy, spec), load_policy(other, other_spec)
        return diagnose(subject, against=against, states=256, episodes=8).verdict(
            "credit_assignment"
        )

    unlearnt, learnt = constant(SPEC), shrunk
    verdict = credit(unlearnt, unlearnt)
    assert (verdict.answer, verdict.reason) == ("cannot tell", "other_run_unlearnt")
    assert verdict.evidence["field"] == "k"
    assert verdict.thresholds["unlearnt"] == 0.9
    # Any of these decides: the run itself has learnt, the other has, k = 1 needs no other run.
    assert credit(learnt, unlearnt).answer == "no"
    assert credit(learnt, learnt).answer == "no"
    assert credit(unlearnt, learnt).answer == "yes"
    assert credit(unlearnt, unlearnt, k=1).reason == "paid_every_step"
