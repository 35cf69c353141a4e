"""Exact values: those that an environment pays, those of the optimum by formula, and bad input."""

import numpy as np
import pytest

import sme_registry
from sme_registry.errors import SMEError

STATES = np.random.default_rng(0).uniform(size=(5, 8))


def policy(observations):
    """Deterministic, with the same bits for a row alone as in a batch."""
    return np.clip(observations[:, :4] * 0.5 + 0.3 * observations[:, 8:9], 0, 1)


@pytest.mark.parametrize(
    "fields", [{}, {"k": 7, "r_min": 0.1}, {"D": 0.05}], ids=["plain", "k and r_min", "D"]
)
def test_a_value_is_the_discounted_reward_that_an_environment_still_pays(fields):
    env = sme_registry.make("Default", **fields)
    spec, gamma, t = env.unwrapped.sme_spec, 0.9, 3 if "D" in fields else 9
    near = {"state": np.full(8, 0.5)} if "D" in fields else None
    observation, info = env.reset(seed=1, options=near)
    rewards, ended = [], False
    while not ended:
        if len(rewards) == t:
            point = env.unwrapped.state.copy(), info["accumulated_reward"]
        action = policy(observation[None])[0]
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        ended = terminated or truncated
    if len(rewards) <= t:  # the episode was over before: from its first state
        t, point = 0, (np.full(8, 0.5), 0.0)
    expected = sum(gamma**j * r for j, r in enumerate(rewards[t:]))
    (value,) = sme_registry.values(
        spec, policy, point[0][None], gamma=gamma, t=t, accumulated=point[1]
    )
    assert value == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("gamma", [0.0, 0.9, 1.0])
def test_the_formula_of_the_optimum_is_what_its_roll_out_earns(gamma):
    task, t = sme_registry.materialize(sme_registry.load("Default")), [0, 30, 60, 90, 99]
    formula = sme_registry.values(task, "optimal", STATES, gamma=gamma, t=t)
    first = task.optimal_action(STATES)
    played = sme_registry.values(task, "optimal", STATES, gamma=gamma, t=t, actions=first)
    assert formula == pytest.approx(played, abs=1e-4)  # the policy sees float32
    assert formula[-1] == 1.0


def test_the_value_of_an_action_is_of_its_step_and_then_of_the_policy():
    task = sme_registry.materialize(sme_registry.load("Default"))
    actions = np.random.default_rng(1).uniform(size=(5, 4))
    value = sme_registry.values(task, policy, STATES, gamma=0.0, actions=actions)
    assert value == pytest.approx(task.step_reward(STATES, actions))
    assert (value != sme_registry.values(task, policy, STATES, gamma=0.0)).any()


def test_a_continuing_value_goes_on_after_the_end():
    value = sme_registry.values("Default", "optimal", STATES, gamma=0.9, t=95, horizon="continuing")
    assert value == pytest.approx(10.0, abs=1e-3)  # 1 / (1 − γ)
    finite, on = (
        sme_registry.values("Default", policy, STATES, gamma=0.9, t=99, horizon=horizon)
        for horizon in ("finite", "continuing")
    )
    assert np.ptp(on - finite) == pytest.approx(0, abs=1e-12)  # one tail for all
    assert (on > finite).all()


def test_nothing_goes_on_after_a_termination_at_the_last_step():
    spec = sme_registry.SMESpec(D=0.05, horizon=1)
    actions = policy(np.column_stack([STATES, np.zeros((5, 2))]))
    reward = sme_registry.materialize(spec).step_reward(STATES, actions)
    finite, on = (
        sme_registry.values(spec, policy, STATES, gamma=0.9, horizon=horizon)
        for horizon in ("finite", "continuing")
    )
    assert 0 < (reward < 0.05).sum() < len(STATES)
    np.testing.assert_array_equal(on == finite, reward < 0.05)


def test_a_stochastic_policy_is_averaged_over_samples():
    rng = np.random.default_rng(3)

    def noisy(observations):
        return np.clip(policy(observations) + rng.normal(0, 0.2, (len(observations), 4)), 0, 1)

    one, other = (
        sme_registry.values("Default", noisy, STATES, gamma=0.0, samples=samples)
        for samples in (1, 400)
    )
    task = sme_registry.materialize(sme_registry.load("Default"))
    observations = np.column_stack([STATES, np.zeros((5, 2))])
    draws = [task.step_reward(STATES, noisy(observations)) for _ in range(400)]
    assert other == pytest.approx(np.mean(draws, axis=0), abs=0.1)
    assert np.abs(one - other).max() > 0.01


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"gamma": 1.1}, "gamma=1.1"),
        ({"gamma": float("nan")}, "gamma=nan"),
        ({"gamma": 1.0, "horizon": "continuing"}, 'horizon="finite"'),
        ({"horizon": "endless"}, "continuing"),
        ({"samples": 0}, "samples=0"),
        ({"t": 100}, r"t=100.* in \[0, 99\]"),
        ({"t": [1, 2]}, "one integer or 5"),
        ({"t": 1.5}, "t=1.5: must be one integer"),
        ({"t": "soon"}, "t='soon'"),
        ({"gamma": "much"}, "gamma='much'"),
        ({"seed": "s"}, "seed='s'"),
        ({"states": [[1, 2], [3]]}, r"\[B, 8\]"),
        ({"states": "all"}, r"\[B, 8\]"),
        ({"accumulated": 1.5}, "accumulated=1.5"),
        ({"actions": np.zeros((5, 3))}, r"\(5, 4\)"),
        ({"states": np.zeros((5, 3))}, r"\[B, 8\]"),
        ({"states": np.full((5, 8), np.nan)}, "finite"),
        ({"task": "Team2"}, "single|make_parallel"),
    ],
)
def test_bad_input_is_refused_with_what_would_do(arguments, says):
    known = {"task": "Default", "policy": policy, "states": STATES, "gamma": 0.9}
    with pytest.raises(SMEError, match=says):
        sme_registry.values(**known | arguments)
