"""Verdicts on policies with a known fault; measurements agree with numbers by hand."""

import itertools

import numpy as np
import pytest

from sme_registry import evaluate, materialize
from sme_registry.diagnosis import Subject, behaviour, diagnose, load_policy
from sme_registry.diagnosis.behaviour import CapacityProbe, Log
from sme_registry.diagnosis.measure import POLICY
from sme_registry.diagnosis.questions import Comparison, Difference, label
from sme_registry.envs import SMEEnv
from sme_registry.errors import SMEError, UnknownNameError
from tests.diagnosis.policies import (
    DEEP,
    EXTENDED,
    SPEC,
    Noisy,
    diagnosis_of,
    distracted,
    faults,
    inside_only,
    left_half_only,
    near_the_centre_only,
    one_channel_constant,
    optimum,
    saturated,
    shrunk,
    time_dependent,
    verdicts_on,
    with_offset,
)

FAULTS = {
    "action_channels", "state_region", "out_of_distribution", "constant_offset", "response_scale",
    "linear_only", "saturation", "action_noise", "time_dependence",
}  # fmt: skip
SPARSE, DELAYED = SPEC.derive(r_min=0.75), SPEC.derive(k=5, horizon=50)
DEADLY = SPEC.derive(D=0.9)


@pytest.mark.parametrize(
    ("policy", "found", "reason", "evidence"),
    [
        # Most of the error is then that this channel does not follow the state.
        (
            one_channel_constant,
            ["action_channels", "response_scale"],
            "some_channels_unlearnt",
            {"channels": 4, "regret_share": (0.999999, 1.000001)},
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
def test_a_policy_with_one_known_fault_has_that_fault(policy, found, reason, evidence):
    diagnosis = diagnosis_of(policy)
    assert faults(diagnosis) & FAULTS == set(found)
    verdict = diagnosis.verdict(found[0])
    assert verdict.reason == reason
    for name, expected in evidence.items():
        value = verdict.evidence[name]
        if isinstance(expected, tuple):
            assert expected[0] < value < expected[1]
        else:
            assert value == expected
    if policy is one_channel_constant:
        assert [channel["channel"] for channel in verdict.evidence["unlearnt"]] == [3]


def test_the_optimum_has_no_fault_and_is_solved():
    diagnosis = diagnosis_of("optimal", DEEP)
    assert {v.answer for v in diagnosis.verdicts} == {"no"}
    assert {v.reason for v in diagnosis.verdicts if v.kind == "why"} == {"solved"}
    assert diagnosis.level == "solved"
    assert diagnosis.measurements.policy.regret == 0.0


@pytest.mark.parametrize(
    ("policy", "spec", "question", "answer", "reason"),
    [
        ("linear", DEEP, "linear_only", "yes", "nonlinear_part_unlearnt"),
        ("constant", SPARSE, "sparsity", "cannot tell", "learnt_little"),
        (shrunk, SPARSE, "sparsity", "yes", "rewards_gated"),
        ("constant", SPEC, "sparsity", "no", "no_reward_threshold"),
        ("constant", DELAYED, "credit_assignment", "cannot tell", "delayed_payout"),
        (shrunk, DEADLY, "survival", "yes", "episodes_cut_short"),
    ],
)
def test_a_task_that_is_hard_in_one_way_has_that_cause(policy, spec, question, answer, reason):
    verdict = diagnosis_of(policy, spec).verdict(question)
    assert (verdict.answer, verdict.reason) == (answer, reason)


def test_the_evidence_for_these_causes_is_measured():
    response = diagnosis_of("linear", DEEP).measurements.response
    assert response.linear_slope == pytest.approx(1.0, abs=0.05)
    assert response.nonlinear_slope == pytest.approx(0.0, abs=0.05)
    assert response.nonlinear_variance > 0.15
    sparse, plain = diagnosis_of("constant", SPARSE), diagnosis_of("constant")
    assert sparse.level == "no_better_than_constant"
    regrets = [each.measurements.policy.normalised_regret for each in (sparse, plain)]
    assert regrets[0] == regrets[1]
    signal = sparse.measurements.on_policy.signal
    assert signal.gated >= 0.25
    assert signal.rewarded + signal.gated + signal.flat == pytest.approx(1.0)
    assert diagnosis_of("constant", DELAYED).verdict("credit_assignment").evidence["k"] == 5
    deadly = diagnosis_of(shrunk, DEADLY).measurements.on_policy
    assert deadly.mean_length < 5
    assert deadly.alive[-1] < 0.1 or len(deadly.alive) < 10
    solved = diagnosis_of("optimal", DEADLY).measurements.on_policy
    assert solved.mean_length == DEADLY.horizon


def with_log(source, step, regret, unrewarded, spec=SPEC, **plan):
    """The diagnosis of a constant that training with this log left."""
    log = Log(source, step, regret, unrewarded, np.zeros(len(step)))
    policy = load_policy("constant", spec).policy
    return diagnose(Subject("it", spec, policy, plan, log), states=256, episodes=8)


@pytest.mark.parametrize(
    ("regret", "exploration", "budget"),
    [
        (np.linspace(0.95, 0.4, 100), "beat_constant_in_training", "learnt_little"),
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
def test_the_training_log_decides_exploration_and_budget(regret, exploration, budget):
    diagnosis = with_log("episodes", np.arange(1, 101) * 20.0, regret, regret >= 1)
    assert diagnosis.verdict("exploration").reason == exploration
    assert diagnosis.verdict("budget").reason == budget
    assert diagnosis.measurements.training is not None


def test_random_actions_without_reward_and_no_learning_make_exploration_the_cause():
    spec = SPEC.derive(r_min=0.9, action_dim=8)
    diagnosis = with_log("episodes", np.arange(1, 31) * 20.0, np.ones(30), np.ones(30), spec)
    exploration = diagnosis.verdict("exploration")
    assert (exploration.answer, exploration.reason) == ("cannot tell", "learnt_little")
    assert exploration.evidence["own_reason"] == "rewards_too_rare"
    assert diagnosis.verdict("sparsity").evidence["unrewarded_episodes"] == 1.0


@pytest.mark.parametrize(
    ("source", "row"), [("episodes", "complete episode"), ("evaluations", "ev")]
)
def test_steps_of_a_log_are_not_called_the_steps_of_training(source, row):
    step = np.arange(1, 82) * 100.0
    diagnosis = with_log(source, step, np.full(81, 0.93), np.zeros(81), steps=8192)
    for question in ("exploration", "budget"):
        text = diagnosis.verdict(question).sentence()
        assert f"training log (last {row}" in text
        assert "step 8,100)" in text
        assert "8,100 steps" not in text


def probe(train, test):
    return CapacityProbe(
        layers=(10, 4), states=1000, gradient_steps=1, train_normalised_regret=train,
        test_normalised_regret=test, seconds=0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("train", "test", "capacity", "dimension"),
    [
        (0.05, 0.06, "network_does_better", "states_sufficient"),
        (0.95, 0.96, "network_cannot_fit", "not_separated"),
        (0.05, 0.95, "network_fits_training_states_only", "too_few_states"),
        (0.6, 0.65, "probe_inconclusive", "not_separated"),
    ],
)
def test_the_probe_separates_capacity_from_too_few_states(train, test, capacity, dimension):
    measured = diagnosis_of("constant").measurements
    judged = verdicts_on(measured.model_copy(update={"capacity": probe(train, test)}), SPEC)
    reasons = {verdict.question: verdict.reason for verdict in judged}
    assert (reasons["capacity"], reasons["dimension"]) == (capacity, dimension)


# --- Comparisons --------------------------------------------------------------------------------


def test_a_comparison_in_one_field_decides_its_question_and_in_two_decides_none():
    k5 = SPEC.derive(k=5)
    better, worse = load_policy(shrunk, SPEC), load_policy(saturated, k5)
    diagnosis = diagnose(worse, against=better, states=256, episodes=8)
    assert diagnosis.comparison.spec_fields == {"k": (5, 1)}
    regret = diagnosis.comparison.differences[0]
    assert regret.quantity == "normalised_regret"
    assert regret.value == pytest.approx(diagnosis.measurements.policy.normalised_regret)
    alone = diagnosis_of(shrunk, states=256).measurements.policy
    assert regret.other == pytest.approx(alone.normalised_regret)
    verdict = diagnosis.verdict("credit_assignment")
    raised = regret.value - regret.other >= 0.1
    assert verdict.reason == ("field_raises_regret" if raised else "regret_same_or_lower")
    assert verdict.evidence["field"] == "k"
    two = load_policy(saturated, k5.derive(r_min=0.5))
    diagnosis = diagnose(two, against=better, states=256, episodes=8)
    assert diagnosis.verdict("credit_assignment").answer == "cannot tell"


def compared(spec, field, values, regrets, **measured):
    """The verdicts on a run against another that differs in one field, at these regrets."""
    plain = diagnosis_of("constant", spec, states=64).measurements
    policy = plain.policy.model_copy(update={"normalised_regret": regrets[0]})
    uniform = {**plain.uniform, "policy": policy}
    measurements = plain.model_copy(update={"uniform": uniform, **measured})
    regret = Difference(quantity="normalised_regret", value=regrets[0], other=regrets[1])
    comparison = Comparison(
        name="other", spec_fields={field: values}, plan_fields={}, differences=(regret,), answers={}
    )
    return {v.question: v for v in verdicts_on(measurements, spec, comparison)}


FIELDS = [
    ("credit_assignment", "k", (5, 1)),
    ("sparsity", "r_min", (0.75, 0.0)),
    ("capacity", "complexity", (10, 1)),
    ("dimension", "state_dim", (16, 8)),
    ("dimension", "action_dim", (8, 4)),
    ("survival", "D", (0.9, 0.0)),
]


@pytest.mark.parametrize(
    ("regrets", "answer", "reason"),
    [
        ((0.94, 0.5), "cannot tell", "field_raises_regret"),
        ((0.94, 0.83), "cannot tell", "field_raises_regret"),
        ((0.94, 0.85), "cannot tell", "other_run_learnt_little"),
        ((0.85, 0.85), "cannot tell", "other_run_learnt_little"),
        ((0.5, 0.85), "cannot tell", "other_run_learnt_little"),
        ((0.55, 0.5), "cannot tell", "difference_too_small"),
        ((0.51, 0.5), "no", "regret_same_or_lower"),
        ((0.3, 0.5), "no", "regret_same_or_lower"),
    ],
)
def test_a_field_is_cleared_only_by_a_run_that_has_learnt_and_is_no_better(regrets, answer, reason):
    for question, field, values in FIELDS:
        verdict = compared(SPEC.derive(**{field: values[0]}), field, values, regrets)[question]
        assert (verdict.answer, verdict.reason) == (answer, reason), field
        text = verdict.sentence()
        assert "not raise" not in text
        assert ("does not explain" in text) == (answer == "no")
        assert verdict.evidence["other_normalised_regret"] == regrets[1]
        assert verdict.thresholds["learnt_little"] == 0.8


def test_the_evidence_of_the_run_alone_is_kept_in_a_comparison():
    spec = SPEC.derive(r_min=0.75)
    alone = diagnosis_of("constant", spec, states=64).verdict("sparsity")
    assert alone.evidence["own_answer"] == "yes"
    verdict = compared(spec, "r_min", (0.75, 0.0), (0.94, 0.85))["sparsity"]
    assert verdict.answer == "cannot tell"
    own = {name: value for name, value in alone.evidence.items() if name != "learnt"}
    assert verdict.evidence.items() >= own.items()
    assert verdict.evidence["own_answer"] == "yes"
    assert verdict.evidence["own_reason"] == "rewards_gated"
    assert verdict.thresholds.items() >= alone.thresholds.items()
    text = verdict.sentence()
    assert "Without the comparison, the answer would be yes: " in text
    assert text.endswith(alone.sentence().rpartition(". ")[2])


def test_an_inconclusive_comparison_leaves_a_no_and_a_probe_as_they_are():
    regrets = (0.94, 0.85)
    survival = compared(SPEC, "D", (0.1, 0.0), regrets)["survival"]
    assert survival.reason != "other_run_learnt_little"
    found = compared(SPEC, "complexity", (10, 1), regrets, capacity=probe(0.95, 0.95))
    assert found["capacity"].reason == "network_cannot_fit"


@pytest.mark.parametrize(
    ("question", "field", "values", "reason"),
    [
        ("credit_assignment", "k", (1, 5), "paid_every_step"),
        ("sparsity", "r_min", (0.0, 0.5), "no_reward_threshold"),
        ("capacity", "complexity", (1, 10), "not_probed"),
        ("dimension", "state_dim", (8, 16), "not_separated"),
    ],
)
def test_a_field_at_its_easier_value_is_not_blamed(question, field, values, reason):
    # Worse at k = 1 than the other run at k = 5: k cannot be the cause.
    verdict = compared(SPEC, field, values, (0.9, 0.5))[question]
    assert verdict.reason == reason
    assert verdict.answer != "yes"


def test_a_verdict_has_the_name_that_is_shown_and_the_name_in_data():
    diagnosis = diagnosis_of(shrunk, states=64)
    by_data = diagnosis.verdict("credit_assignment")
    assert diagnosis.verdict("credit assignment") is by_data
    for question in [verdict.question for verdict in diagnosis.verdicts]:
        assert diagnosis.verdict(label(question)).question == question
    for name, message in {
        "sparcity": r"action_channels', .*Did you mean 'sparsity'",
        "": "question='': must be 'action_channels'",
    }.items():
        with pytest.raises(UnknownNameError, match=message):
            diagnosis.verdict(name)
    assert issubclass(UnknownNameError, SMEError)


# --- Measurements ---------------------------------------------------------------------------------


def test_the_regret_of_the_channels_adds_up_to_the_regret():
    measured = diagnosis_of(with_offset).measurements
    assert sum(c.regret for c in measured.channels) == pytest.approx(measured.policy.regret)
    assert np.mean([c.mae for c in measured.channels]) == pytest.approx(measured.policy.mae)


def test_the_shares_of_the_squared_error_are_those_of_its_causes():
    def affine_of_optimum(observation):  # within [0, 1], so nothing is clipped
        return 0.2 + 0.5 * optimum(SPEC)(observation)

    measured = diagnosis_of(affine_of_optimum).measurements
    error = measured.squared_error
    a = optimum(SPEC)(np.random.default_rng(0).random((20_000, 10), dtype=np.float32))
    offset = ((0.2 - 0.5 * a).mean(axis=0) ** 2).mean()
    scale = 0.25 * a.var(axis=0).mean()
    assert error.offset + error.scale + error.residual == pytest.approx(1.0)
    assert error.offset == pytest.approx(offset / (offset + scale), abs=0.01)
    assert error.residual == pytest.approx(0.0, abs=1e-6)
    assert measured.response.steepness == pytest.approx(0.5, abs=0.01)


def test_scores_and_shells_agree_with_evaluate():
    report = evaluate(shrunk, SPEC, {"states_per_region": 2048}, name="it")
    measured = diagnosis_of(shrunk).measurements
    assert measured.policy.mae == pytest.approx(report.regions[0].mae)
    for shell, region in zip(measured.shells, report.regions, strict=True):
        regret = shell.scores[POLICY].normalised_regret
        assert regret == pytest.approx(region.normalised_regret, abs=0.02)


def test_equal_seeds_give_equal_numbers_and_another_seed_other_numbers():
    diagnosis = diagnosis_of(distracted, EXTENDED)
    assert diagnosis_of.__wrapped__(distracted, EXTENDED) == diagnosis
    assert diagnosis_of(distracted, EXTENDED, seed=1).measurements != diagnosis.measurements


def test_on_noisy_tasks_and_with_noisy_actions_too():
    noisy = SPEC.derive(noise={"transition": 0.3})
    first, again = (diagnosis_of.__wrapped__(Noisy(), noisy) for _ in range(2))
    assert first == again
    sb3 = pytest.importorskip("stable_baselines3")
    noise = sb3.common.noise.NormalActionNoise(np.zeros(4), 0.1 * np.ones(4))
    agent = sb3.TD3("MlpPolicy", SMEEnv(SPEC, action_range="symmetric"), action_noise=noise)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    first, again = (diagnosis_of.__wrapped__(agent, SPEC) for _ in range(2))
    assert first.measurements.exploration_sd == again.measurements.exploration_sd
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002


def test_a_payout_over_k_independent_rewards_is_explained_by_one_kth():
    spec = SPEC.derive(k=5, horizon=50)
    for task, credit, tolerance in ((spec, 1 / 5, 0.05), (SPEC, 1.0, 1e-6)):
        measured = diagnosis_of(Noisy(task), task, episodes=64).measurements
        assert measured.on_policy.random_credit == pytest.approx(credit, abs=tolerance)


@pytest.mark.parametrize(
    "on_top",
    [
        {"shaping": {"scale": 30}},
        {"noise": {"reward": 3.0}},
        {"safety": {"tightness": 0.4, "compensated": True}},
    ],
    ids=lambda fields: next(iter(fields)),
)
def test_credit_is_of_the_payout_and_not_of_what_is_paid_on_top(on_top):
    for k, credit, tolerance in ((5, 1 / 5, 0.05), (1, 1.0, 1e-6)):
        task = SPEC.derive(k=k, horizon=50, **on_top)
        on_policy = diagnosis_of(Noisy(task), task, episodes=64).measurements.on_policy
        assert on_policy.random_credit == pytest.approx(credit, abs=tolerance)


def test_rewards_of_an_episode_that_D_terminated_before_a_payout_have_no_credit():
    reward = np.array([[1.0, 0.2], [0.5, 0.9], [0.0, 0.4], [0.0, 0.6]])
    payout = np.array([[0.0, 0.0], [0.0, 1.1], [0.0, 0.0], [0.0, 1.0]])
    alive = np.array([[1, 1], [1, 1], [0, 1], [0, 1]], bool)
    payout_due = np.array([[0, 0], [0, 1], [0, 0], [0, 1]], bool)
    zeros = np.zeros((4, 2))
    trajectories = behaviour.Trajectories(
        np.zeros((4, 2, 1)), np.zeros((4, 2, 1)), zeros, zeros, reward, payout, alive, payout_due,
        np.array([True, False]),
    )  # fmt: skip
    by_hand = np.corrcoef([0.2, 0.9, 0.4, 0.6], [1.1, 1.1, 1.0, 1.0])[0, 1] ** 2
    assert behaviour._credit(trajectories) == pytest.approx(by_hand)


def test_the_probe_fits_what_a_network_can_represent_and_fails_at_the_rest(monkeypatch):
    torch = pytest.importorskip("torch")
    from sme_registry.evaluation.networks import Perceptron

    def probe(widths, spec, states, visited=None):
        *inner, last = [
            (np.zeros(pair, np.float32), np.zeros(pair[1], np.float32), "tanh")
            for pair in itertools.pairwise(widths)
        ]
        network = Perceptron((*inner, (*last[:2], "identity")))
        return behaviour.probe_capacity(network, materialize(spec), states, 0, visited)

    activations = {"sigmoid": "Sigmoid", "silu": "SiLU", "elu": "ELU", "identity": "Identity"}
    for name, module in activations.items():
        network = Perceptron([(np.zeros((2, 2)), np.zeros(2), name)] * 2)
        names = [type(layer).__name__ for layer in behaviour._module(network)]
        assert names == ["Linear", module] * 2
    monkeypatch.setattr(behaviour, "GRADIENT_STEPS", 300)
    monkeypatch.setattr(behaviour, "_MIN_STATES", 16)
    torch.manual_seed(5)
    state = torch.random.get_rng_state()
    wide = probe((10, 64, 4), SPEC, 5000)
    narrow = probe((10, 1, 4), SPEC, 5000)
    few = probe((10, 64, 64, 4), DEEP, 1)
    of_one_state = probe((10, 64, 4), SPEC, 5000, np.full((5000, 8), 0.1))
    assert of_one_state.train_normalised_regret < 0.1 < 0.6 < of_one_state.test_normalised_regret
    assert wide.layers == (10, 64, 4)
    assert wide.test_normalised_regret < 0.2 < 0.6 < narrow.train_normalised_regret
    assert few.states == 16
    assert few.train_normalised_regret < 0.5 * few.test_normalised_regret
    assert torch.equal(torch.random.get_rng_state(), state)
