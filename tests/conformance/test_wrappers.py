"""The wrappers that people put around environments work on these, and none changes the task."""

import functools

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector as vector_wrappers

import sme_registry
from sme_registry.errors import EpisodeError

T = 8
LOW, HIGH = np.float32(-1.0), np.float32(1.0)
AROUND_SINGLES = {
    name: getattr(wrappers, name)
    for name in (
        "Autoreset", "NormalizeObservation", "NormalizeReward", "PassiveEnvChecker",
        "RecordEpisodeStatistics", "TimeAwareObservation",
    )
} | {
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "RescaleAction": lambda env: wrappers.RescaleAction(env, LOW, HIGH),
}  # fmt: skip
AROUND_BATCHES = {
    "NormalizeObservation": vector_wrappers.NormalizeObservation,
    "RecordEpisodeStatistics": vector_wrappers.RecordEpisodeStatistics,
    "RescaleAction": lambda env: vector_wrappers.RescaleAction(env, LOW, HIGH),
    "DictInfoToList": vector_wrappers.DictInfoToList,
}


@pytest.mark.parametrize("name", AROUND_SINGLES)
def test_an_episode_runs_whole_within_a_common_wrapper(name):
    env = AROUND_SINGLES[name](sme_registry.make("Default", horizon=T, k=3))
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    env.action_space.seed(0)
    for t in range(1, T + 1):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        assert not terminated
        assert truncated == (t == T)
        assert 0.0 <= info["regret"] <= 1.0


@pytest.mark.parametrize("name", AROUND_BATCHES)
def test_a_batch_runs_on_over_episodes_within_a_common_wrapper(name):
    env = AROUND_BATCHES[name](sme_registry.make_vec("Default", 3, horizon=T, k=3))
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    ends = 0
    for _ in range(3 * T):
        observation, _, _, truncated, _ = env.step(env.action_space.sample())
        assert observation.shape == env.observation_space.shape
        ends += int(truncated.sum())
    assert ends == 6


@pytest.mark.parametrize("outside", [None, wrappers.Autoreset, wrappers.RecordEpisodeStatistics])
def test_a_time_limit_below_the_horizon_truncates_and_pays(outside):
    made = gymnasium.make("SME/Default-v1", horizon=T, k=T, max_episode_steps=3)
    by_hand = wrappers.TimeLimit(sme_registry.make("Default", horizon=T, k=T), 3)
    for env in (made, by_hand):
        wrapped = env if outside is None else outside(env)
        for seed in range(2):
            wrapped.reset(seed=seed)
            earned = 0.0
            for _ in range(3):
                optimal = env.unwrapped.task.optimal_action(env.unwrapped.state)
                observation, reward, _, truncated, info = wrapped.step(optimal)
                earned += info["step_reward"]
            assert truncated
            assert reward == earned > 2.9
            assert info["accumulated_reward"] == observation[-1] == 0.0
            assert observation[-2] == np.float32(3 / T)
            with pytest.raises(EpisodeError, match="has ended"):
                env.unwrapped.step(optimal)


def test_a_time_limit_around_repeated_actions_counts_its_own_steps():
    env = wrappers.TimeLimit(_Twice(sme_registry.make("Default", horizon=20, k=20)), 4)
    env.reset(seed=0)
    inner = env.unwrapped
    rewards = [env.step(inner.task.optimal_action(inner.state))[1] for _ in range(4)]
    assert rewards[:3] == [0.0] * 3
    assert rewards[3] > 3.9
    assert env.unwrapped._numbers[0] == 7.0  # the first step of its last action ends the episode


class _Twice(gymnasium.Wrapper):
    def step(self, action):
        total = 0.0
        for _ in range(2):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += reward
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_batch_below_the_horizon_is_its_singles_with_that_time_limit(mode):
    kwargs = {"horizon": T, "k": 2, "D": 0.7, "max_episode_steps": 3}
    native = gymnasium.make_vec("SME/Default-v1", 3, autoreset_mode=mode, **kwargs)
    make = functools.partial(gymnasium.make, "SME/Default-v1", **kwargs)
    singles = gymnasium.vector.SyncVectorEnv([make] * 3, autoreset_mode=native.autoreset_mode)
    native.reset(seed=1)
    singles.reset(seed=1)
    rng, ends = np.random.default_rng(0), np.zeros(2)
    for _ in range(25):
        optimal = [
            task.optimal_action(s)
            for task, s in zip(native.get_attr("task"), native.state, strict=True)
        ]
        action = np.float32(np.clip(optimal + rng.normal(0.0, 0.1, (3, 4)), 0.0, 1.0))
        step, expected = native.step(action), singles.step(action)
        for got, other in zip(step[:4], expected[:4], strict=True):
            np.testing.assert_array_equal(got, other)
        np.testing.assert_array_equal(
            step[4]["accumulated_reward"], expected[4]["accumulated_reward"]
        )
        ends += np.sum(step[2:4], axis=1)
    assert (ends > 0).all()
    assert native.spec.max_episode_steps == 3


def test_a_batch_takes_a_time_limit_of_the_horizon():
    env = gymnasium.make_vec("SME/Default-v1", 2, horizon=T, max_episode_steps=T)
    env.reset(seed=0)
    for _ in range(T):
        truncated = env.step(np.zeros((2, 4), np.float32))[3]
    assert truncated.all()


def test_frames_are_collected_and_can_be_observed():
    pytest.importorskip("pygame")
    collected = wrappers.RenderCollection(
        sme_registry.make("Default", horizon=T, render_mode="rgb_array")
    )
    collected.reset(seed=0)
    collected.step(np.zeros(4, np.float32))
    frames = collected.render()
    assert len(frames) == 2
    assert not np.array_equal(frames[0], frames[1])
    pixels = wrappers.AddRenderObservation(
        sme_registry.make("Default", horizon=T, render_mode="rgb_array"), render_only=True
    )
    assert pixels.observation_space.contains(pixels.reset(seed=0)[0])
