"""`Episodes`: the same sums for any number of steps at once, for teams, resets and costs."""

import numpy as np
import pytest

import sme_registry
from sme_registry.envs.episodes import Episodes, info_of_envs
from sme_registry.errors import OptionError


def steps_of(steps, lanes, agents=1, seed=0):
    """Rewards, info, terminated and ended of so many random steps."""
    random = np.random.default_rng(seed)
    shape = (steps, lanes, agents)
    info = {"regret": random.random(shape), "similarity": random.random(shape)}
    ends = random.random((2, steps, lanes, 1)) < 0.1
    terminated, truncated = np.broadcast_to(ends, (2, *shape))
    return random.random(shape), info, terminated, terminated | truncated


def without_seconds(episodes):
    return [episode._replace(wall_seconds=0.0) for episode in episodes]


@pytest.mark.parametrize("agents", [1, 3])
def test_steps_at_once_have_the_bits_of_steps_one_by_one(agents):
    rewards, info, terminated, ended = steps_of(200, 4, agents)
    together, alone = Episodes(4, agents), Episodes(4, agents)
    together.add(rewards, info, terminated, ended)
    for i in range(200):
        now = {key: values[i] for key, values in info.items()}
        alone.add(rewards[i], now, terminated[i], ended[i])
    assert len(together.finished) > 20
    assert without_seconds(together.finished) == without_seconds(alone.finished)
    assert (together.sums == alone.sums).all()
    assert together.steps == alone.steps == 800


def test_an_episode_is_the_mean_over_its_steps_and_a_teams_over_its_agents():
    episodes = Episodes(envs=1, agents=2, steps=10, clock=lambda: 5.0)
    info = {"regret": [0.25, 0.75], "similarity": [0.5, 0.5]}
    assert episodes.add([1.0, 3.0], info, [False] * 2, [False] * 2) == []
    [episode] = episodes.add([1.0, 3.0], info, [True] * 2, [True] * 2)
    assert episode[:8] == (1, 12, 4.0, 2, 0.5, 0.5, 1, 5.0)
    assert episode.agents_regret == (0.25, 0.75)
    assert episodes.online_regret == 0.5
    assert not episodes.sums.any()


def test_lanes_that_began_an_episode_count_no_step():
    episodes = Episodes(envs=2)
    info = {"regret": [0.5, 0.0], "similarity": [0.5, 0.0]}
    stepped = [True, False]
    [episode] = episodes.add([1.0, 0.0], info, [False, False], [True, False], stepped)
    assert episodes.online_regret == 0.5
    assert (episode.step, episode.length, episode.terminated) == (1, 1, 0)
    assert episodes.steps == 1
    assert not episodes.sums[:, 1].any()


def test_costs_are_means_and_violations_a_share():
    spec = sme_registry.load("Safety20")
    episodes = Episodes(spec=lambda: spec)
    lanes = [
        {"regret": 0.5, "similarity": 0.5, "cost": cost, "safe_regret": -0.5} for cost in (0.0, 0.5)
    ]
    for step, info in enumerate(lanes):
        finished = episodes.add([0.0], info_of_envs([info]), [False], [step == 1])
    assert finished[0].safety == (0.25, 0.5, -0.5)


def test_an_environment_without_regret_is_refused():
    with pytest.raises(OptionError, match="info has no 'regret'"):
        Episodes().add([0.0], {"similarity": [1.0]}, [False], [False])
    info = {"regret": [0.0], "similarity": [1.0], "cost": [0.0], "safe_regret": [0.0]}
    with pytest.raises(OptionError, match="Give spec"):
        Episodes().add([0.0], info, [False], [False])
