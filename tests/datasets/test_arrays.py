"""`Transitions` and its conversion for d3rlpy: all rows are aligned."""

import dataclasses

import numpy as np
import pytest

import sme_registry
from sme_registry.datasets import DatasetRecipe, to_d3rlpy
from sme_registry.datasets.collect import (
    collect,
    constant_policy,
    episode_numbers,
    reference_scores,
    whole_episodes,
)
from sme_registry.datasets.documents import parse_behaviour
from sme_registry.spec import SMESpec
from sme_registry.task import materialize


def made(**fields):
    spec = SMESpec(horizon=20, **fields)
    recipe = DatasetRecipe(spec=spec, behaviours=(parse_behaviour(0.8),), transitions=250)
    return collect(recipe, materialize(spec))


@pytest.fixture(scope="module")
def fragile():
    """Trajectories that terminate, that time out, and one that is cut."""
    found = made(D=0.05)
    assert found.terminations.any()
    assert found.timeouts.any()
    return found


def test_the_digest_covers_every_array_its_name_type_and_shape(fragile):
    digests = {fragile.digest}
    for name, array in fragile.columns().items():
        changed = array.copy()
        changed.reshape(-1).view(np.uint8)[0] ^= 1
        digests.add(dataclasses.replace(fragile, **{name: changed}).digest)
    assert len(digests) == 1 + len(fragile.columns())
    swapped = dataclasses.replace(
        fragile, rewards=fragile.similarities, similarities=fragile.rewards
    )
    wider = dataclasses.replace(fragile, rewards=fragile.rewards.astype(np.float32))
    assert len({fragile.digest, swapped.digest, wider.digest}) == 3


def test_d3rlpy_gets_aligned_rows(fragile):
    given = to_d3rlpy(fragile)
    assert {len(array) for array in given.values()} == {250}
    np.testing.assert_array_equal(given["observations"], fragile.observations)
    np.testing.assert_array_equal(given["actions"], fragile.actions)
    np.testing.assert_array_equal(given["terminals"] > 0, fragile.terminations)
    np.testing.assert_array_equal(given["timeouts"] > 0, fragile.timeouts)
    assert not (given["terminals"] * given["timeouts"]).any()


def test_with_final_observations_each_timeout_has_its_successor(fragile):
    given = to_d3rlpy(fragile, final_observations=True)
    added = given["timeouts"] > 0
    assert added.sum() == fragile.timeouts.sum()
    assert {len(array) for array in given.values()} == {250 + int(added.sum())}
    np.testing.assert_array_equal(given["observations"][~added], fragile.observations)
    np.testing.assert_array_equal(given["actions"][~added], fragile.actions)
    np.testing.assert_array_equal(given["terminals"][~added] > 0, fragile.terminations)
    successors = np.roll(given["observations"], -1, axis=0)[~added]
    going_on = ~fragile.terminations
    np.testing.assert_array_equal(successors[going_on], fragile.next_observations[going_on])
    assert not given["rewards"][added].any()


def scored(acting=((0.5, 1.0),), transitions=2_000, **fields):
    spec = SMESpec.from_dict(fields)
    behaviours = tuple(parse_behaviour(what, weight) for what, weight in acting)
    recipe = DatasetRecipe(spec=spec, behaviours=behaviours, transitions=transitions)
    task = materialize(spec)
    found = collect(recipe, task)
    return reference_scores(recipe, task, found), found, task


def test_scores_on_the_data_sets_states_are_exact():
    scores, found, task = scored()
    half = np.full_like(found.optimal_actions, 0.5)
    assert scores.constant.similarity == pytest.approx(task.similarity(found.states, half).mean())
    assert scores.constant.step_reward == pytest.approx(task.step_reward(found.states, half).mean())
    acted = found.actions.astype(float)
    assert scores.behaviour.similarity == pytest.approx(
        task.similarity(found.states, acted).mean(), abs=1e-12
    )
    best = task.optimal_action(found.states)
    assert scores.optimum.similarity == task.similarity(found.states, best).mean() == 1.0
    assert scores.optimum.step_reward == task.step_reward(found.states, best).mean() == 1.0


def test_the_optimums_return_has_what_is_paid_on_top():
    scores, _, _ = scored(transitions=100, shaping={"scale": 30})
    optimum = scores.optimum.rollouts
    # T − P₀(s₀), and P₀ is 30 times a number that is ½ on average.
    assert optimum.mean_return == pytest.approx(100 - 15, abs=4 * optimum.standard_error)
    assert optimum.similarity == pytest.approx(1.0, abs=1e-6)
    scores, _, _ = scored(transitions=100, safety={"tightness": 0.4, "compensated": True})
    assert scores.optimum.rollouts.mean_return > 110


def test_the_returns_are_those_of_single_environments():
    task = materialize(SMESpec(k=3, D=0.02))
    returns, similarities, steps = whole_episodes(task, constant_policy(task), 4, "start", 20)
    assert len(set(steps)) > 3  # they end at different steps
    states = next(episode_numbers(4, "start", range(20), 8))
    env = sme_registry.make(task.spec)
    for episode in range(20):
        env.reset(options={"state": states[episode]})
        total, similarity, count, ended = 0.0, 0.0, 0, False
        while not ended:
            _, reward, terminated, truncated, info = env.step(np.full(4, 0.5, np.float32))
            total, similarity, count = total + reward, similarity + info["similarity"], count + 1
            ended = terminated or truncated
        assert (total, count) == (pytest.approx(returns[episode]), steps[episode])
        assert similarity == pytest.approx(similarities[episode])


def test_the_behaviour_score_is_the_weighted_mean_over_behaviours():
    scores, found, _ = scored([(0.0, 0.25), ("random", 0.75)])
    best, worst = scores.behaviours
    assert best.similarity > 0.999999
    assert worst.similarity < 0.75
    whole = 0.25 * best.rollouts.mean_return + 0.75 * worst.rollouts.mean_return
    assert scores.behaviour.rollouts.mean_return == pytest.approx(whole)
    assert scores.behaviour.similarity == found.similarities.mean()


def test_rollouts_of_the_behaviour_agree_with_the_data_set():
    scores, found, _ = scored(transitions=10_000)
    returns = np.add.reduceat(found.rewards, np.arange(0, 10_000, 100))
    error = np.hypot(scores.behaviour.rollouts.standard_error, returns.std() / 10)
    assert abs(scores.behaviour.rollouts.mean_return - returns.mean()) < 4 * error


def test_a_horizon_too_long_for_episodes_has_no_rollouts():
    scores, _, _ = scored(transitions=50, horizon=10**6)
    assert scores.behaviour.rollouts is None
    assert scores.constant.rollouts is None
    assert scores.optimum.rollouts.mean_return == 10**6


@pytest.mark.parametrize("reward", ["individual", "team"])
def test_a_teams_scores_are_the_mean_over_its_agents(reward):
    team = {"agents": [{"action_dim": 1}, {"action_dim": 3}], "reward": reward}
    scores, found, task = scored(team=team)
    half = np.full_like(found.optimal_actions, 0.5)
    each = task.similarities_of(half, found.optimal_actions)
    assert scores.constant.similarity == pytest.approx(each.mean())
    paid_for = task.similarity_of(half, found.optimal_actions) if reward == "team" else each
    assert scores.constant.step_reward == pytest.approx(task.reward_of(paid_for).mean())


def test_d3rlpy_gets_copies(fragile):
    for final_observations in (False, True):
        given = to_d3rlpy(fragile, final_observations=final_observations)
        before = fragile.digest
        for array in given.values():
            array[:] = -1.0
        assert fragile.digest == before
