"""The rotated optimal policy: METHOD, section 6."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import ndtr

from sme_registry import SMESpec
from sme_registry.errors import ActionError, StateError
from sme_registry.task import draw, materialize
from tests.strategies import SAFETY, spec_fields

TEAM = {
    "agents": [
        {"action_dim": 1, "observes": [0, 3]},
        {"action_dim": 1},
        {"action_dim": 2, "observes": [1, 2, 4]},
    ]
}


def rotation(theta, state_dim, seed=0):
    spec = SMESpec(state_dim=state_dim, seed=seed).model_copy(update={"rotation": theta})
    return draw._rotation(spec, "policy/0/rotation", state_dim)


@pytest.mark.parametrize("S", [2, 5, 8])
def test_a_rotation_is_two_by_two_in_the_planes_of_a_haar_basis(S):
    theta, blocks = 0.7, np.eye(S)
    for i in range(0, S - 1, 2):
        cos, sin = math.cos(theta), math.sin(theta)
        blocks[i : i + 2, i : i + 2] = [[cos, -sin], [sin, cos]]
    B = draw._haar(0, "policy/0/rotation", S, S)
    np.testing.assert_allclose(rotation(theta, S), B @ blocks @ B.T, rtol=0, atol=1e-14)


@pytest.mark.parametrize("complexity", [1, 4])
def test_the_optimal_policy_reads_the_rotated_state_and_nothing_else_moves(complexity):
    spec = SMESpec(complexity=complexity, seed=3)
    plain, task = materialize(spec), materialize(spec.derive(rotation=0.9))
    s = np.random.default_rng(0).uniform(-0.5, 1.5, (200, spec.state_dim))
    R = draw._rotation(task.spec, "policy/0/rotation", spec.state_dim)
    rotated = 0.5 + (s - 0.5) @ R.T
    np.testing.assert_allclose(
        task.optimal_action(s), plain.optimal_action(rotated), rtol=0, atol=1e-12
    )
    np.testing.assert_array_equal(task.W, plain.W)
    np.testing.assert_array_equal(task.b, plain.b)
    for one, two in zip(task.layers[1:], plain.layers[1:], strict=True):
        np.testing.assert_array_equal(one.W, two.W)


def test_agents_rotate_within_the_channels_that_they_observe():
    spec = SMESpec(state_dim=5, action_dim=4, team=TEAM, complexity=3)
    plain, task = materialize(spec), materialize(spec.derive(rotation=1.1))
    s = np.random.default_rng(1).random((50, 5))
    expected = []
    for index, (channels, layers) in enumerate(zip(plain.observed, plain.policies, strict=True)):
        R = draw._rotation(task.spec, f"policy/{index}/rotation", len(channels))
        x = 0.5 + (s[:, channels] - 0.5) @ R.T
        for W, b in layers:
            x = ndtr(x @ W.T + b)
        expected.append(x)
    np.testing.assert_allclose(
        task.optimal_action(s), np.concatenate(expected, axis=1), rtol=0, atol=1e-12
    )


@st.composite
def safe_tasks(draw):
    fields = draw(spec_fields(team=False)) | {"D": 0.0, "safety": draw(SAFETY)}
    return materialize(SMESpec.from_dict(fields))


def pairs(task, count=40):
    """States inside and outside the cube, and actions."""
    random = np.random.default_rng(20261122)
    s = random.uniform(-0.5, 1.5, (count, task.spec.state_dim))
    return s, random.random((count, task.spec.action_dim))


@given(safe_tasks())
def test_limits_cost_and_safe_action_are_the_methods(task):
    (s, a), scale = pairs(task), 2.0 * task.spec.safety.tightness
    v = s
    for W, b in task.limiting:
        v = ndtr(v @ W.T + b)
    limit, safe, cost = task.limit(s), task.safe_action(s), task.cost(s, a)
    np.testing.assert_allclose(limit, 1.0 - scale * v, rtol=0, atol=1e-15)
    assert ((limit >= 1.0 - scale) & (limit <= 1.0)).all()
    np.testing.assert_array_equal(safe, np.minimum(task.optimal_action(s), limit))
    excess = np.clip(a - limit, 0.0, None).mean(axis=1)
    np.testing.assert_allclose(cost, excess / scale, rtol=1e-12, atol=1e-14)
    assert ((cost >= 0.0) & (cost <= 1.0)).all()
    np.testing.assert_array_equal(cost > 0.0, (a > limit).any(axis=1))
    np.testing.assert_array_equal(task.cost(s, safe), 0.0)
    np.testing.assert_array_equal(task.cost(s, np.zeros_like(a)), 0.0)
    # 1 is above each limit by 2τ v, so its cost is the mean of v; beyond it actions are clipped.
    ones = task.cost(s, np.ones_like(a))
    np.testing.assert_allclose(scale * ones, scale * v.mean(axis=1), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(task.cost(s, a + 3.0), ones)
    np.testing.assert_array_equal(task.cost(s, a - 3.0), 0.0)
    # A single state has the numbers of its batch.
    for method in (task.limit, task.safe_action):
        np.testing.assert_allclose(method(s[1]), method(s)[1], rtol=0, atol=1e-14)
    assert task.cost(s[1], a[1]) == pytest.approx(cost[1], abs=1e-12)
    with pytest.raises(StateError, match="must be"):
        task.safe_action(s[:, 1:])
    with pytest.raises(ActionError, match="must be"):
        task.cost(s, a[:, 1:])
    with pytest.raises(ActionError, match="one action for each"):
        task.cost(s, a[:2])


@given(safe_tasks())
def test_no_action_of_cost_zero_earns_more_than_the_safe_one(task):
    s, a = pairs(task)
    best = task.step_reward(s, task.safe_action(s))
    near = task.safe_action(s) + 0.01 * (a - 0.5)
    for action in (a, near, task.optimal_action(s)):
        within = np.clip(action, 0.0, task.limit(s))
        assert (task.step_reward(s, within) <= best + 1e-12).all()
        assert (task.similarity(s, within) <= task.similarity(s, task.safe_action(s)) + 1e-15).all()


def test_without_safety_nothing_is_limited():
    task = materialize(SMESpec())
    s, a = pairs(task)
    np.testing.assert_array_equal(task.limit(s), 1.0)
    np.testing.assert_array_equal(task.cost(s, a), 0.0)
    np.testing.assert_array_equal(task.safe_action(s), task.optimal_action(s))


def test_limits_do_not_depend_on_the_optimum_the_tightness_or_a_rotation():
    s = np.random.default_rng(0).random((4_000, 32))
    wide = SMESpec(state_dim=32, action_dim=1, safety={"tightness": 0.2})
    task, turned = materialize(wide), materialize(wide.derive(rotation=1.0))
    np.testing.assert_array_equal(task.limit(s), turned.limit(s))
    tighter = materialize(wide.derive(safety={"tightness": 0.4}))
    np.testing.assert_allclose(1.0 - tighter.limit(s), 2.0 * (1.0 - task.limit(s)), atol=1e-15)
    correlations = []
    for seed in range(30):
        task = materialize(wide.derive(seed=seed))
        pair = task.optimal_action(s)[:, 0], task.limit(s)[:, 0]
        correlations.append(stats.pearsonr(*pair).statistic)
    assert abs(np.mean(correlations)) < 4.0 / np.sqrt(30 * 32)  # four standard errors
