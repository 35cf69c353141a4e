"""The reference policies, against what can be computed otherwise."""

import numpy as np
import pytest

from sme_registry.evaluation import references
from sme_registry.spec import SMESpec
from sme_registry.task import materialize


@pytest.fixture(scope="module")
def solved():
    task = materialize(SMESpec(state_dim=3, action_dim=2, complexity=5))
    s = np.random.default_rng(0).random((5_000, 3))
    return s, task.optimal_action(s)


def test_best_constant_cannot_be_improved_in_any_channel(solved):
    s, optimal = solved[0], solved[1] ** 3  # skewed, so that median and mean differ
    constant = references.fit(s, optimal).constant
    least = np.abs(constant - optimal).mean(axis=0)
    for moved in (constant - 0.01, constant + 0.01, np.full(2, 0.5), optimal.mean(axis=0)):
        assert (least <= np.abs(moved - optimal).mean(axis=0)).all()


def test_linear_policy_is_the_least_squares_fit_within_the_action_range(solved):
    s, optimal = solved
    fitted = references.fit(s, optimal)
    residual = (s - 0.5) @ fitted.slope + fitted.intercept - optimal
    assert np.abs(residual.mean(axis=0)).max() < 1e-12
    assert np.abs(s.T @ residual / len(s)).max() < 1e-12
    far = 0.5 + 20.0 * (s - 0.5)
    clipped = fitted.actions(far, optimal, optimal)["linear_least_squares"]
    assert (clipped.min(), clipped.max()) == (0.0, 1.0)
    affine = (s - 0.5) @ np.random.default_rng(1).uniform(-0.1, 0.1, (3, 2)) + [0.4, 0.6]
    recovered = references.fit(s, affine).actions(s, affine, affine)["linear_least_squares"]
    assert np.abs(recovered - affine).max() < 1e-12


def test_every_named_reference_acts(solved):
    s, optimal = solved
    random = np.random.default_rng(2).random(optimal.shape)
    actions = references.fit(s, optimal).actions(s, optimal, random)
    assert tuple(actions) == references.NAMES
    assert actions["optimal"] is optimal
    assert actions["uniform_random"] is random
    assert (actions["constant_half"] == 0.5).all()


def test_what_the_fit_keeps_is_bounded_however_large_a_state_is():
    assert references.fit_states(SMESpec()) >= 50_000  # all of WD under paper-v1
    wide = SMESpec(state_dim=2**20, action_dim=1)
    assert references.fit_states(wide) * 2**20 <= 2**24
