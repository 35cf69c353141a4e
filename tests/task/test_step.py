"""Episodes by the definition: payouts, ends, and the optimum that earns the maximal return."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sme_registry.task import materialize, observe, step
from tests.strategies import specs


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


@given(specs())
def test_the_optimum_earns_exactly_the_horizon(spec):
    task = materialize(spec)
    steps = rollout(task, 3, lambda s, _: task.policy(s[:, None, :])[:, 0, :])
    assert not any(done.terminated.any() for done in steps)
    assert steps[-1].truncated.all()
    np.testing.assert_array_equal(np.sum([done.reward for done in steps], axis=0), spec.horizon)
    assert all((done.similarity == 1.0).all() for done in steps)


@given(specs())
def test_what_is_earned_is_paid_every_k_steps_and_at_the_horizon_and_shown_till_then(spec):
    task = materialize(spec)
    n = len(task.names)
    earned = paid = np.zeros((5, n))
    for t, done in enumerate(rollout(task, 5, mixed(task)), start=1):
        earned, paid = earned + done.step_reward, paid + done.reward
        np.testing.assert_allclose(paid + done.accumulated_reward, earned, rtol=0, atol=1e-12)
        if t % spec.k == 0 or t == spec.horizon:
            np.testing.assert_array_equal(done.accumulated_reward, 0.0)
        else:
            np.testing.assert_array_equal(done.reward, 0.0)
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
