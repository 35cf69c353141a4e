"""The equations, and episodes by them: payouts, ends, and the optimum of maximal return."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sme_registry.errors import ActionError, SpecError, StateError
from sme_registry.spec import SMESpec
from sme_registry.task import materialize, observe, step
from tests.strategies import specs


def rng():
    return np.random.default_rng(20261121)


@given(specs())
def test_the_transition_is_the_arc_cosine_of_the_method_and_stays_in_the_cube(spec):
    task = materialize(spec)
    s, a = rng().random((50, spec.state_dim)), rng().random((50, spec.action_dim))
    s[0], s[1], a[:2] = 0.0, 1.0, 0.5
    a = a.astype(np.float32).astype(np.float64)
    expected = np.arccos(np.cos(2.0 * np.pi * (s + a @ task.W + task.b))) / np.pi
    moved = task.transition(s, a)
    # arccos loses half of the digits where its argument is ±1.
    np.testing.assert_allclose(moved, expected, rtol=0, atol=3e-8)
    assert ((moved >= 0.0) & (moved <= 1.0)).all()


@given(specs())
def test_the_optimum_has_similarity_of_exactly_one(spec):
    task = materialize(spec)
    s = rng().uniform(-0.5, 1.5, (20, spec.state_dim))
    a = task.optimal_action(s)
    np.testing.assert_array_equal(task.similarity(s, a), 1.0)
    np.testing.assert_array_equal(task.step_reward(s, a), 1.0)
    np.testing.assert_array_equal(task.regret(s, a), 0.0)
    assert task.similarity(s[0], task.optimal_action(s[0])) == 1.0


@given(specs())
def test_similarity_reward_and_regret_are_the_methods(spec):
    task = materialize(spec)
    s, a = rng().random((50, spec.state_dim)), rng().random((50, spec.action_dim))
    a[25:] = np.clip(task.optimal_action(s[25:]) + 0.1 * (a[25:] - 0.5), 0.0, 1.0)
    similarity = 1.0 - np.abs(a - task.optimal_action(s)).mean(axis=1)
    np.testing.assert_allclose(task.similarity(s, a), similarity, rtol=0, atol=1e-15)
    graded = np.maximum(0.0, 4.0 * (task.similarity(s, a) - 0.75))
    reward = np.where(graded > spec.r_min, graded, 0.0)
    np.testing.assert_array_equal(task.step_reward(s, a), reward)
    np.testing.assert_array_equal(task.regret(s, a), 1.0 - reward)


def test_the_reward_threshold_is_strict():
    task = materialize(SMESpec(r_min=0.5))
    np.testing.assert_array_equal(
        task.reward_of([0.75, 0.875, np.nextafter(0.875, 1.0), 1.0]),
        [0.0, 0.0, 4.0 * (np.nextafter(0.875, 1.0) - 0.75), 1.0],
    )
    assert materialize(SMESpec()).reward_of(0.75) == 0.0


@given(specs())
def test_a_single_state_is_answered_as_its_row_of_a_batch(spec):
    task = materialize(spec)
    s, a = rng().random((7, spec.state_dim)), rng().random((7, spec.action_dim))
    for i in range(3):
        np.testing.assert_array_equal(task.transition(s[i], a[i]), task.transition(s, a)[i])
        np.testing.assert_allclose(
            task.optimal_action(s[i]), task.optimal_action(s)[i], rtol=0, atol=1e-13
        )
        assert task.similarity(s[i], a[i]) == pytest.approx(task.similarity(s, a)[i], abs=1e-13)
    assert task.transition(s[0], a[0]).shape == (spec.state_dim,)
    assert task.optimal_action(s[0]).shape == (spec.action_dim,)
    assert np.ndim(task.similarity(s[0], a[0])) == 0
    assert np.ndim(task.step_reward(s[0], a[0])) == 0
    assert task.transition(s[0], a).shape == (7, spec.state_dim)


@given(specs())
def test_actions_out_of_range_are_clipped(spec):
    task = materialize(spec)
    s, a = rng().random((20, spec.state_dim)), rng().uniform(-1.0, 2.0, (20, spec.action_dim))
    inside = np.clip(a, 0.0, 1.0)
    np.testing.assert_array_equal(task.transition(s, a), task.transition(s, inside))
    np.testing.assert_array_equal(task.similarity(s, a), task.similarity(s, inside))
    assert (task.similarity(s, a) >= 0.0).all()


def test_numbers_of_any_kind_size_and_batch_are_answered():
    task, empty = materialize(SMESpec()), np.zeros((0, 8))
    expected = task.similarity(np.zeros(8), np.ones(4))
    assert task.similarity([0] * 8, [True] * 4) == expected
    assert task.transition(empty, np.zeros((0, 4))).shape == (0, 8)
    assert task.optimal_action(empty).shape == (0, 4)
    assert task.similarity(empty, np.zeros((0, 4))).shape == (0,)
    for far, complexity in itertools.product((1.0, 10.0, 1e299), (1, 3)):
        outside = far * rng().uniform(-1.0, 1.0, (50, 8))
        a = materialize(SMESpec(complexity=complexity)).optimal_action(outside)
        assert ((a >= 0.0) & (a <= 1.0)).all()


def test_a_task_is_drawn_of_a_spec_or_its_fields_and_equal_specs_share_it():
    assert materialize({"k": 3}).spec == SMESpec(k=3)
    assert materialize(SMESpec(seed=77)) is materialize(SMESpec(seed=77))
    for thing in ("Default-v1", None, 3):
        with pytest.raises(SpecError, match="must be an SMESpec or a mapping of its fields"):
            materialize(thing)


BAD_STATES = [
    ([0.5] * 7, "state of shape (7,): must be [8] or [B, 8] (this task's state_dim is 8)."),
    (np.zeros((2, 3, 8)), "state of shape (2, 3, 8): must be [8] or [B, 8]"),
    ([np.nan] + [0.5] * 7, "state: has NaN or infinite entries."),
    ([1e301] + [0.5] * 7, "below 1e+300 in size."),
    (["0.5"] * 8, "must be an array of 8 numbers."),
    ([[0.5] * 8, [0.5] * 7], "must be an array of 8 numbers."),
    ([1j] * 8, "must be an array of 8 numbers."),
]


@pytest.mark.parametrize(("state", "message"), BAD_STATES)
def test_a_bad_state_is_refused(state, message):
    task = materialize(SMESpec())
    for ask in (
        lambda: task.optimal_action(state),
        lambda: task.transition(state, [0.5] * 4),
        lambda: task.similarity(state, [0.5] * 4),
        lambda: task.step_reward(state, [0.5] * 4),
        lambda: task.regret(state, [0.5] * 4),
    ):
        with pytest.raises(StateError) as caught:
            ask()
        assert message in str(caught.value)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([0.5] * 3, "action of shape (3,): must be [4] or [B, 4]"),
        ([0.5, 0.5, 0.5, -np.inf], "action: has NaN or infinite entries."),
        ("left", "must be an array of 4 numbers."),
        (np.zeros((2, 4)), "action of shape (2, 4): must be [3, 4], one action for each"),
    ],
)
def test_a_bad_action_is_refused(action, message):
    task = materialize(SMESpec())
    s = np.full((3, 8), 0.5)
    for ask in (task.transition, task.similarity, task.step_reward, task.regret):
        with pytest.raises(ActionError) as caught:
            ask(s, action)
        assert message in str(caught.value)


def rollout(task, B, act, seed=0):
    """Steps of `B` episodes side by side until the horizon; ends are recorded, not obeyed."""
    random = np.random.default_rng(seed)
    s, t = random.random((B, task.spec.state_dim)), np.zeros(B, np.int64)
    r_cum = np.zeros((B, len(task.names)))
    steps = []
    for _ in range(task.spec.horizon):
        steps.append(step(task, s, t, r_cum, act(s, random)))
        s, t, r_cum = steps[-1].state, t + 1, steps[-1].accumulated_reward
    return steps


def mixed(task):
    """Actions between the optimum and noise, so that rewards of every size occur."""

    def act(s, random):
        best = task.policy(s[:, None, :])[:, 0, :]
        return best + random.random((len(s), 1)) ** 2 * (random.random(best.shape) - best)

    return act


def payout(done):
    """R, the reward of a step without what is paid on top."""
    return done.reward - (done.price + done.shaping + done.reward_noise)


@given(specs())
def test_the_optimum_is_paid_exactly_the_horizon(spec):
    task = materialize(spec)
    steps = rollout(task, 3, lambda s, _: task.policy(s[:, None, :])[:, 0, :])
    assert not any(done.terminated.any() for done in steps)
    assert steps[-1].truncated.all()
    plain = spec.shaping is None and not spec.compensated
    paid = np.sum([done.reward if plain else payout(done) for done in steps], axis=0)
    np.testing.assert_allclose(paid, spec.horizon, rtol=0, atol=0.0 if plain else 1e-10)
    assert all((done.similarity == 1.0).all() for done in steps)


@given(specs())
def test_what_is_earned_is_paid_every_k_steps_and_at_the_horizon_and_shown_till_then(spec):
    task = materialize(spec)
    n = len(task.names)
    earned = paid = np.zeros((5, n))
    for t, done in enumerate(rollout(task, 5, mixed(task)), start=1):
        earned, paid = earned + done.step_reward, paid + payout(done)
        np.testing.assert_allclose(paid + done.accumulated_reward, earned, rtol=0, atol=1e-10)
        if t % spec.k == 0 or t == spec.horizon:
            np.testing.assert_array_equal(done.accumulated_reward, 0.0)
        else:
            np.testing.assert_array_equal(payout(done), 0.0)
        assert (done.truncated == (t >= spec.horizon)).all()
        np.testing.assert_array_equal(done.terminated, (done.step_reward < spec.D).any(axis=1))
        seen = observe(spec, done.state, np.full(5, t), done.accumulated_reward)
        assert seen.dtype == np.float32
        assert ((seen >= 0.0) & (seen <= 1.0)).all()
        parts = done.state, np.full((5, 1), t / spec.horizon), done.accumulated_reward / spec.k
        np.testing.assert_array_equal(seen, np.concatenate(parts, axis=1).astype(np.float32))


@given(specs(), st.integers(1, 9))
def test_a_batch_is_its_single_lanes_bit_for_bit(spec, B):
    task = materialize(spec)
    random = np.random.default_rng(B)
    s, a = random.random((B, spec.state_dim)), random.random((B, spec.action_dim))
    t, r_cum = random.integers(0, spec.horizon, B), random.random((B, len(task.names)))
    whole = step(task, s, t, r_cum, a)
    for i in range(B):
        lane = slice(i, i + 1)
        single = step(task, s[lane], t[lane], r_cum[lane], a[lane])
        for field in whole._fields:
            np.testing.assert_array_equal(getattr(whole, field)[lane], getattr(single, field))
