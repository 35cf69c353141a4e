"""Credit: regret shares add up to the team's regret; difference rewards are brute force's."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sme_registry.spec import SMESpec
from sme_registry.task import materialize
from tests.strategies import specs

TRIO = SMESpec(
    action_dim=6,
    complexity=2,
    team={"agents": [{"action_dim": 1, "observes": [0]}, {"action_dim": 2}, {"action_dim": 3}]},
)


def drawn(spec, B=50, seed=0, spread=0.6):
    """A task, states, and actions up to `spread` / 2 from the optimal ones."""
    task, random = materialize(spec), np.random.default_rng(seed)
    s = random.random((B, spec.state_dim))
    noise = spread * random.random((B, 1)) * (random.random((B, spec.action_dim)) - 0.5)
    return task, s, np.clip(task.optimal_action(s) + noise, 0.0, 1.0)


@given(specs(), st.integers(0, 9))
def test_regret_shares_add_up_to_the_teams_regret_and_none_is_negative(spec, seed):
    task, s, a = drawn(spec, seed=seed)
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


def test_who_acts_optimally_is_charged_nothing_and_the_other_everything():
    task, s, a = drawn(TRIO)
    best = task.optimal_action(s)
    for agent, own in enumerate(task.owned):
        alone = best.copy()
        alone[:, own] = a[:, own]
        shares, regret = task.regret_shares(s, alone), task.regret(s, alone)
        np.testing.assert_allclose(shares[:, agent], regret, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(np.delete(shares, agent, axis=1), 0.0)
        # Then mending that agent mends the team, so its difference reward is all the regret.
        np.testing.assert_allclose(
            task.difference_rewards(s, alone)[:, agent], regret, rtol=0, atol=1e-12
        )


def test_shares_are_in_proportion_to_the_distance_of_each_agents_action():
    task, s, _ = drawn(TRIO, B=1)
    best = task.optimal_action(s)
    away = np.where(best > 0.5, -0.1, 0.1)
    shares = task.regret_shares(s, best + away)[0]
    np.testing.assert_allclose(shares, 0.4 * np.array([1, 2, 3]) / 6, rtol=0, atol=1e-12)


@given(specs(), st.integers(0, 9))
def test_difference_rewards_are_those_of_brute_force(spec, seed):
    task, s, a = drawn(spec, B=8, seed=seed)
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
