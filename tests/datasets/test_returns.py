"""Exact returns compared with the environment, from any state, time and pending reward."""

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sme_registry import SMESpec, make, materialize
from sme_registry.datasets import DatasetRecipe, exact_return, positions
from sme_registry.datasets.collect import collect
from sme_registry.datasets.documents import parse_behaviour
from sme_registry.errors import ActionError, OptionError, PolicyError, SpecError, StateError

SPEC = SMESpec(state_dim=3, action_dim=2, horizon=30, seed=4)
STATES = np.random.default_rng(0).random((5, 3))


def policy(observations):
    """Near the optimum, row by row, so that no batch changes a bit; it reads the clock, too."""
    task = materialize(SPEC)
    optimal = task.optimal_action(observations[:, None, :3].astype(np.float64).reshape(-1, 3))
    return 0.8 * optimal + 0.1 * observations[:, 3:4] + 0.05 * observations[:, 4:5]


def by_environment(spec, state, gamma, skip=0):
    """An episode of the single environment: what it pays after its first `skip` steps."""
    env = make(spec)
    observation, _ = env.reset(options={"state": state})
    rewards, ended = [], False
    while not ended:
        observation, reward, terminated, truncated, _ = env.step(policy(observation[None])[0])
        rewards.append(reward)
        ended = terminated or truncated
    later = np.array(rewards[skip:], dtype=np.float64)
    return float(later.sum()), float((later * gamma ** np.arange(len(later))).sum())


VARIANTS = [
    {"k": 7},
    {"r_min": 0.6},
    {"k": 4, "D": 0.55, "r_min": 0.3},
    {"horizon": 1},
]


@pytest.mark.parametrize("changes", VARIANTS, ids=str)
def test_from_the_start_the_return_is_that_of_the_environment(changes):
    spec = SPEC.derive(**changes)
    found = exact_return(policy, spec, states=STATES, gamma=0.9)
    for row, state in enumerate(STATES):
        plain, discounted = by_environment(spec, state, 0.9)
        assert found.undiscounted.mean[row] == pytest.approx(plain, abs=1e-9)
        assert found.discounted.mean[row] == pytest.approx(discounted, abs=1e-9)
    np.testing.assert_array_equal(found.undiscounted.low, found.undiscounted.high)


@pytest.mark.parametrize("changes", VARIANTS[:-1], ids=str)
def test_from_the_middle_of_an_episode_the_return_is_the_rest(changes):
    spec, state = SPEC.derive(**changes), STATES[0]
    env = make(spec)
    observation, _ = env.reset(options={"state": state})
    for step in range(1, 12):
        observation, _, terminated, _, info = env.step(policy(observation[None])[0])
        if terminated:
            break
        here = env.unwrapped.state
        owed = float(info["accumulated_reward"])
        found = exact_return(policy, spec, states=here[None], t=step, r_cum=owed, gamma=0.9)
        plain, discounted = by_environment(spec, state, 0.9, skip=step)
        assert found.undiscounted.mean[0] == pytest.approx(plain, abs=1e-9)
        assert found.discounted.mean[0] == pytest.approx(discounted, abs=1e-9)
    assert step > 1


def test_rollouts_from_rows_of_a_data_set_repeat_its_rewards():
    spec = SPEC.derive(k=4)
    recipe = DatasetRecipe(spec=spec, behaviours=(parse_behaviour(0.6),), transitions=90, seed=1)
    transitions = collect(recipe, materialize(spec))
    rows = np.array([2, 31, 45, 88])
    where = positions(transitions, spec, rows)
    np.testing.assert_array_equal(where["t"], rows % 30)
    owed = [transitions.step_rewards[row - row % 30 % 4 : row].sum() for row in rows]
    np.testing.assert_allclose(where["r_cum"], owed, atol=1e-6)

    # With the set's own action first, the next state is the set's, and what is left is its value.
    first = exact_return(
        policy, spec, **where, actions=transitions.actions[rows].astype(np.float64)
    )
    after = {
        "states": transitions.next_states[rows],
        "t": where["t"] + 1,
        "r_cum": transitions.next_observations[rows, 4].astype(np.float64) * 4,
    }
    rest = exact_return(policy, spec, **after)
    np.testing.assert_allclose(
        first.undiscounted.mean, transitions.rewards[rows] + rest.undiscounted.mean, atol=1e-5
    )


def test_positions_are_found_behind_what_the_agent_sees():
    observed = {"distractors": 3, "mixing": "orthogonal"}
    spec = SPEC.derive(k=7, observation=observed)
    recipe = DatasetRecipe(spec=spec, behaviours=(parse_behaviour(0.4),), transitions=90)
    plain = recipe.model_copy(update={"spec": SPEC.derive(k=7)})
    found, expected = (
        positions(collect(each, materialize(each.spec)), each.spec) for each in (recipe, plain)
    )
    for name in ("states", "t", "r_cum"):
        np.testing.assert_array_equal(found[name], expected[name])
    assert found["r_cum"].max() > 1.0


def test_the_optimum_earns_one_in_every_remaining_step():
    spec = SPEC.derive(k=5, D=0.9)
    task = materialize(spec)

    def optimal(observations):
        # What a policy is shown is rounded to float32, of which D = 0.9 takes no notice.
        return task.optimal_action(observations[:, :3])

    found = exact_return(optimal, spec, states=STATES, t=[0, 1, 7, 28, 29], r_cum=[0, 1, 2, 3, 4])
    np.testing.assert_allclose(found.undiscounted.mean, [30, 30, 25, 5, 5], atol=1e-4)
    np.testing.assert_array_equal(found.lengths, [30, 29, 23, 2, 1])
    np.testing.assert_allclose(found.similarity, 1.0, atol=1e-6)


def test_many_states_at_different_times_keep_their_order():
    spec = SPEC.derive(state_dim=2, action_dim=1, horizon=4)
    states = np.random.default_rng(1).random((5000, 2))
    t = np.arange(5000) % 4
    found = exact_return(lambda o: np.full((len(o), 1), 0.5), spec, states=states, t=t)
    np.testing.assert_array_equal(found.lengths, 4 - t)
    last = t == 3
    expected = materialize(spec).step_reward(states[last], np.full((last.sum(), 1), 0.5))
    np.testing.assert_allclose(found.undiscounted.mean[last], expected, atol=1e-12)


@pytest.mark.parametrize("source", ["policy", "distractors"])
def test_the_interval_of_random_actions_contains_their_mean(source):
    """Of one step, whose return is known by quadrature, with uniform actions.

    The policy draws them, or they are a distractor, which is drawn anew in each rollout.
    """
    spec = SPEC.derive(state_dim=1, action_dim=1, horizon=1)
    states = np.random.default_rng(2).random((400, 1))
    optimal = materialize(spec).optimal_action(states)
    grid = (np.arange(20_000) + 0.5) / 20_000
    truth = np.array([np.maximum(0.0, 1.0 - 4.0 * np.abs(grid - a)).mean() for a in optimal])
    random = np.random.default_rng(3)
    act: Any
    if source == "policy":
        act, fault = (
            lambda o: random.random((len(o), 1)) * (o[:, :1] > 0),  # 0 in the state 0
            "the policy is stochastic",
        )
    else:
        act, fault = (lambda o: o[:, 1:2]), "the task has 1 distractors"
        spec = spec.derive(observation={"distractors": 1})
    found = exact_return(act, spec, states=states, rollouts=60).undiscounted
    held = ((found.low <= truth) & (truth <= found.high)).mean()
    assert 0.91 < held < 0.985  # 95 % of 400, and Student's t of so skewed a draw is not exact
    again = exact_return(act, spec, states=states, rollouts=60)
    over = again.over_states()[0]
    assert over.low < truth.mean() < over.high
    if source == "distractors":
        np.testing.assert_array_equal(found.mean, again.undiscounted.mean)
    with pytest.raises(OptionError, match=f"rollouts=1: {fault}"):
        exact_return(act, spec, states=states)
    with pytest.raises(OptionError, match="at least 2"):
        exact_return(act, spec, states=states[:1], rollouts=60).over_states()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"states": STATES[:, :2]}, StateError, r"must be of shape \(5, 3\)"),
        ({"states": STATES + 1}, StateError, "outside"),
        ({"t": 30}, StateError, r"t=30: must be an integer in \[0, 30\)"),
        ({"t": [1, 2]}, StateError, r"t=\[1, 2\], .* of shape \(5,\)"),
        ({"t": np.nan}, StateError, "t=nan: must be"),
        ({"r_cum": 0.1}, StateError, r"r_cum=0.1: must be in \[0, 0\] at t=0"),
        ({"actions": STATES}, ActionError, r"must be of shape \(5, 2\)"),
        ({"actions": np.full((5, 2), 1.5)}, OptionError, "in .0, 1."),
        ({"gamma": 1.1}, OptionError, "gamma=1.1"),
        ({"spec": "Team2"}, SpecError, "team"),
        ({"policy": lambda o: o}, PolicyError, "policy"),
    ],
)
def test_bad_input_is_refused(changes, error, message):
    arguments = {"policy": policy, "spec": SPEC, "states": STATES, **changes}
    with pytest.raises(error, match=message):
        exact_return(arguments.pop("policy"), arguments.pop("spec"), **arguments)


def test_fitted_q_and_exact_returns_rank_policies_equally():
    example = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples" / "ope.py"))
    values = example["compare"](SMESpec(), nu=1.0, seed=0, rows=4000)
    estimates, truths = ({name: row[i] for name, row in values.items()} for i in (0, 1))
    assert sorted(estimates, key=estimates.__getitem__) == sorted(truths, key=truths.__getitem__)
    # Near the data it is right to a tenth; of the optimum, off them, it knows far too little.
    near, far = "half optimal, half ½", "optimal"
    assert estimates[near] == pytest.approx(truths[near], rel=0.1)
    assert truths[far] == pytest.approx(10.0, abs=1e-3)  # Σ 0.9^i over 100 steps
    assert estimates[far] < 0.85 * truths[far]
