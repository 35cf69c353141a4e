"""Teams by the definition: who owns and sees what, what each is paid, and whose regret it is."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sme_registry.spec import SMESpec
from sme_registry.task import materialize, observe, step
from tests.strategies import specs


def team(*agents, reward="individual"):
    return {"agents": [{"action_dim": width, "observes": seen} for width, seen in agents],
            "reward": reward}  # fmt: skip


TRIO = SMESpec(action_dim=6, complexity=2, team=team((1, [0, 5]), (2, "all"), (3, [1, 2, 7])))


def near_optimal(task, B, seed=0):
    random = np.random.default_rng(seed)
    s = random.random((B, task.spec.state_dim))
    best = task.optimal_action(s)
    a = best + 0.4 * random.random((B, 1)) * (random.random(best.shape) - 0.5)
    return s, np.clip(a, 0.0, 1.0)


def same_layers(ours, theirs):
    assert len(ours) == len(theirs)
    for (W, b), (other_W, other_b) in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(W, other_W)
        np.testing.assert_array_equal(b, other_b)


@given(specs(team=False, plain=True), st.sampled_from(["individual", "team"]), st.integers(0, 9))
def test_a_team_of_one_is_the_single_agents_task_number_for_number(spec, reward, seed):
    lone = spec.derive(team=team((spec.action_dim, "all"), reward=reward))
    single, alone = materialize(spec), materialize(lone)
    assert lone.digest != spec.digest
    np.testing.assert_array_equal(single.W, alone.W)
    np.testing.assert_array_equal(single.b, alone.b)
    same_layers(single.policies[0], alone.policies[0])
    s, a = near_optimal(single, 7, seed)
    random = np.random.default_rng(seed)
    t, r_cum = random.integers(0, spec.horizon, 7), random.random((7, 1))
    ours, theirs = step(alone, s, t, r_cum, a), step(single, s, t, r_cum, a)
    for name in ours._fields:
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    np.testing.assert_array_equal(observe(lone, s, t, r_cum), observe(spec, s, t, r_cum))


def test_what_a_team_does_not_share_moves_nothing_that_it_had():
    agents = ((1, [0, 5]), (2, "all"), (3, [1, 2, 7]))
    base = materialize(TRIO.derive(complexity=3))
    more = materialize(TRIO.derive(complexity=3, action_dim=8, team=team(*agents, (2, "all"))))
    np.testing.assert_array_equal(base.b, more.b)
    np.testing.assert_array_equal(base.W, more.W[:6])
    deeper = materialize(TRIO.derive(complexity=4))
    wider = materialize(TRIO.derive(complexity=3, team=team((1, "all"), *agents[1:])))
    shared = materialize(TRIO.derive(complexity=3, team=team(*agents, reward="team")))
    np.testing.assert_array_equal(base.W, wider.W)
    for agent, policy in enumerate(base.policies):
        same_layers(policy, more.policies[agent])
        same_layers(policy, shared.policies[agent])
        same_layers(policy[:2], deeper.policies[agent][:2])
        same_layers(policy[-1:], deeper.policies[agent][-1:])
        first = 1 if agent == 0 else 0  # the first agent's first layer reads other channels
        same_layers(policy[first:], wider.policies[agent][first:])


def test_an_agents_optimal_action_moves_with_the_channels_that_it_observes_and_no_others():
    task, random = materialize(TRIO), np.random.default_rng(0)
    s = np.full((5, 8), 0.4)
    for own, channels in zip(task.owned, task.observed, strict=True):
        for channel in range(8):
            other = s.copy()
            other[:, channel] = random.uniform(0.9, 9.0, 5)
            moved = np.abs(task.optimal_action(other) - task.optimal_action(s))[:, own]
            assert (moved > 1e-6).all() if channel in channels else (moved == 0.0).all()


@given(specs(team=True), st.integers(0, 9))
def test_each_is_paid_for_its_own_channels_or_all_for_all(spec, seed):
    task = materialize(spec)
    s, a = near_optimal(task, 9, seed)
    n = len(task.names)
    done = step(task, s, np.zeros(9, np.int64), np.zeros((9, n)), a)
    missed = np.abs(a - done.optimal_action)
    for agent, own in enumerate(task.owned):
        similarity = 1.0 - missed[:, own].mean(axis=1)
        np.testing.assert_allclose(done.similarity[:, agent], similarity, rtol=0, atol=1e-14)
        if task.pays_the_team:
            np.testing.assert_array_equal(done.step_reward[:, agent], done.step_reward[:, 0])
            expected = task.reward_of(task.similarity_of(a, done.optimal_action))
        else:
            expected = task.reward_of(done.similarity[:, agent])
        np.testing.assert_array_equal(done.step_reward[:, agent], expected)


def test_names_and_channels_are_in_the_order_of_the_spec():
    task = materialize(TRIO)
    assert task.names == ("agent_0", "agent_1", "agent_2")
    assert task.owned == (slice(0, 1), slice(1, 3), slice(3, 6))
    assert task.observed == ((0, 5), tuple(range(8)), (1, 2, 7))
    assert [len(policy) for policy in task.layers] == [2, 2, 2]
    assert [policy[0].W.shape[1] for policy in task.policies] == [2, 8, 3]
    assert [policy[-1].W.shape[0] for policy in task.policies] == [1, 2, 3]


@given(specs(), st.integers(0, 9))
def test_regret_shares_add_up_to_the_teams_regret_and_none_is_negative(spec, seed):
    task = materialize(spec)
    s, a = near_optimal(task, 50, seed)
    kept = s.copy(), a.copy()
    shares, gains = task.regret_shares(s, a), task.difference_rewards(s, a)
    assert shares.shape == gains.shape == (50, len(task.names))
    assert (shares >= 0.0).all()
    np.testing.assert_allclose(shares.sum(axis=1), task.regret(s, a), rtol=0, atol=1e-12)
    if len(task.names) == 1 and spec.r_min == 0.0:
        np.testing.assert_allclose(gains[:, 0], task.regret(s, a), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(s, kept[0])
    np.testing.assert_array_equal(a, kept[1])
    np.testing.assert_allclose(task.regret_shares(s[0], a[0]), shares[0], rtol=0, atol=1e-11)
    assert task.difference_rewards(s[0], a[0]).shape == gains[0].shape


def test_shares_are_in_proportion_to_the_distance_of_each_agents_action():
    task = materialize(TRIO)
    s, _ = near_optimal(task, 1)
    best = task.optimal_action(s)
    away = np.where(best > 0.5, -0.1, 0.1)
    shares = task.regret_shares(s, best + away)[0]
    np.testing.assert_allclose(shares, 0.4 * np.array([1, 2, 3]) / 6, rtol=0, atol=1e-12)


@given(specs(), st.integers(0, 9))
def test_difference_rewards_are_those_of_brute_force(spec, seed):
    task = materialize(spec)
    s, a = near_optimal(task, 8, seed)
    got = task.difference_rewards(s, a)
    assert ((got >= 0.0) & (got <= 1.0)).all()
    for lane in range(8):
        first = 0
        for agent, width in enumerate(own.stop - own.start for own in task.owned):
            mended = a[lane].copy()
            mended[first : first + width] = task.optimal_action(s[lane])[first : first + width]
            first += width
            gain = task.step_reward(s[lane], mended) - task.step_reward(s[lane], a[lane])
            # BLAS may order the sums of one state and of a batch differently.
            if abs(gain - got[lane, agent]) > 1e-9:
                graded = 4.0 * (np.array([
                    task.similarity(s[lane], mended), task.similarity(s[lane], a[lane])
                ]) - 0.75)  # fmt: skip
                assert np.abs(graded - spec.r_min).min() < 1e-9
