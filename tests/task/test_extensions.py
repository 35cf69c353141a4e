"""The parts of a task beside the plain one: rotation, limits, observation (METHOD, 6, 8, 9)."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import ndtr, ndtri

from sme_registry import SMESpec
from sme_registry.errors import ActionError, SpecError, StateError
from sme_registry.task import draw, materialize
from tests.strategies import SAFETY, observations, spec_fields

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


# --- Observation ----------------------------------------------------------------------------------


@st.composite
def observed_tasks(draw):
    fields = draw(spec_fields(team=False)) | {"observation": draw(observations())}
    return materialize(SMESpec.from_dict(fields))


def task_of(**observation):
    return materialize(SMESpec(seed=3, observation=observation))


def inside(task, count=40):
    """States and distractors in the cube."""
    random = np.random.default_rng(20261122)
    widths = task.spec.state_dim, task.spec.distractors
    return tuple(random.random((count, width)) for width in widths)


@given(observed_tasks())
def test_the_agent_sees_numbers_in_the_unit_cube_which_can_be_undone(task):
    s, d = inside(task)
    corners = (np.sign(s - 0.5) + 1) / 2, (np.sign(d - 0.5) + 1) / 2
    for states, distractors in ((s, d), corners):
        x = task.seen(states, distractors)
        assert x.shape == (40, task.spec.observation_dim - 2)
        assert ((x >= -1e-15) & (x <= 1.0 + 1e-15)).all()
    x = task.seen(s, d)
    np.testing.assert_allclose(task.seen(s[1], d[1]), x[1], rtol=0, atol=1e-14)
    for W, b in reversed(task.mixing):
        z = x if task.spec.observation.mixing == "orthogonal" else ndtri(x)
        x = np.linalg.solve(W, (z - b).T).T
    np.testing.assert_allclose(x, np.concatenate([s, d], axis=1), rtol=0, atol=1e-8)


def test_without_a_mixing_the_agent_sees_state_and_distractors():
    task = task_of(distractors=3)
    s, d = inside(task)
    np.testing.assert_array_equal(task.seen(s, d), np.concatenate([s, d], axis=1))
    plain = materialize(SMESpec())
    np.testing.assert_array_equal(plain.seen(s), s)
    assert (SMESpec().observation_dim, task.spec.observation_dim) == (10, 13)


@given(observed_tasks())
def test_distractors_move_by_the_equations_of_the_state(task):
    if task.distractor_transition is None:
        assert task.spec.observation.dynamics in (None, "noise")
        return
    W, b = task.distractor_transition
    _, d = inside(task)
    u = np.random.default_rng(2).random((40, task.spec.action_dim)).astype(np.float32)
    expected = np.arccos(np.cos(2.0 * np.pi * (d + u @ W + b))) / np.pi
    np.testing.assert_allclose(task.distractor_step(d, u), expected, rtol=0, atol=3e-8)
    np.testing.assert_array_equal(task.distractor_step(d[0], u[0]), task.distractor_step(d, u)[0])
    np.testing.assert_array_equal(W.sum(axis=1), 1.0)


def test_bad_distractors_are_refused_with_their_shape():
    task, plain = task_of(distractors=3, dynamics="driven"), materialize(SMESpec(seed=3))
    s, step = np.zeros(8), task.distractor_step
    for call in (lambda d: task.seen(s, d), lambda d: step(d, np.zeros(4))):
        with pytest.raises(StateError, match=r"distractors of shape \(2,\): must be \[3\]"):
            call(np.zeros(2))
        with pytest.raises(StateError, match="distractors: has NaN or infinite entries"):
            call(np.full(3, np.nan))
    for call, error, words in (
        (lambda: task.seen(s), StateError, r"distractors of shape \(0,\).* distractors is 3"),
        (lambda: step(np.zeros(3), np.zeros(3)), ActionError, r"action of shape \(3,\): .*\[4\]"),
        (lambda: task.seen(np.zeros(7), np.zeros(3)), StateError, "state of shape"),
        (
            lambda: task.seen(np.zeros((5, 8)), np.zeros((3, 3))),
            StateError,
            r"distractors of shape \(3, 3\): must be \[5, 3\], one",
        ),
        (
            lambda: step(np.zeros((5, 3)), np.zeros((3, 4))),
            ActionError,
            r"action of shape \(3, 4\): must be \[5, 4\], one",
        ),
        (lambda: plain.seen(s, np.zeros(3)), StateError, r"distractors .*\(3,\): must be \[0\]"),
        (lambda: plain.distractor_step(np.zeros(3), np.zeros(4)), SpecError, "this task has none"),
        (
            lambda: task_of(distractors=3).distractor_step(np.zeros(3), np.zeros(4)),
            SpecError,
            "drawn anew each step.*dynamics='autonomous'",
        ),
    ):
        with pytest.raises(error, match=words):
            call()


def test_a_state_is_seen_with_each_of_many_distractors_and_they_with_it():
    task = task_of(distractors=3, mixing="orthogonal")
    s, d = inside(task, 5)
    ones = np.ones((5, 1))
    assert np.array_equal(task.seen(s[0], d), task.seen(ones * s[0], d))
    assert np.array_equal(task.seen(s, d[0]), task.seen(s, ones * d[0]))
