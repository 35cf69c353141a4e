"""Measurements agree with numbers computed by hand and with `evaluate`."""

import itertools

import numpy as np
import pytest

from sme_registry import evaluate, materialize
from sme_registry.diagnosis import behaviour
from sme_registry.diagnosis.measure import POLICY
from tests.diagnosis.policies import (
    DEEP,
    EXTENDED,
    SPEC,
    Noisy,
    diagnosis_of,
    distracted,
    optimum,
    shrunk,
    with_offset,
)


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

    def probe(widths, spec, states):
        *inner, last = [
            (np.zeros(pair, np.float32), np.zeros(pair[1], np.float32), "tanh")
            for pair in itertools.pairwise(widths)
        ]
        network = Perceptron((*inner, (*last[:2], "identity")))
        return behaviour.probe_capacity(network, materialize(spec), states, 0)

    monkeypatch.setattr(behaviour, "GRADIENT_STEPS", 300)
    monkeypatch.setattr(behaviour, "_MIN_STATES", 16)
    torch.manual_seed(5)
    state = torch.random.get_rng_state()
    wide = probe((10, 64, 4), SPEC, 5000)
    narrow = probe((10, 1, 4), SPEC, 5000)
    few = probe((10, 64, 64, 4), DEEP, 1)
    assert wide.layers == (10, 64, 4)
    assert wide.test_normalised_regret < 0.2 < 0.6 < narrow.train_normalised_regret
    assert few.states == 16
    assert few.train_normalised_regret < 0.5 * few.test_normalised_regret
    assert torch.equal(torch.random.get_rng_state(), state)
