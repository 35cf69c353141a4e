"""`RegretCallback`: the exact regret of each episode, in real trainings with each `VecEnv`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import sme_registry
from sme_registry import SMESpec
from sme_registry.errors import OptionError

pytest.importorskip("stable_baselines3")

SPEC = SMESpec(state_dim=2, action_dim=2, horizon=8, seed=5)


def make_env() -> Any:
    return sme_registry.make(SPEC, action_range="symmetric")


def vec_env(kind: str) -> Any:
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv

    from sme_registry.sb3 import SMEVecEnv

    if kind == "batch":
        return SMEVecEnv(SPEC, 2)
    return DummyVecEnv([lambda: Monitor(make_env())] * 2)


def ppo(env: Any) -> Any:
    from stable_baselines3 import PPO

    return PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=1, device="cpu")


@pytest.mark.parametrize("kind", ["batch", "dummy"])
def test_the_mean_regret_of_each_episode_is_logged(kind: str, tmp_path: Path) -> None:
    from stable_baselines3.common.logger import configure

    from sme_registry.sb3 import RegretCallback

    env = vec_env(kind)
    model = ppo(env)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    callback = RegretCallback()
    model.learn(32, callback=callback)
    model.logger.close()
    env.close()
    assert [episode.step for episode in callback.episodes] == [16, 16, 32, 32]
    for episode in callback.episodes:
        # With k = 1 and r_min = 0 the return is the horizon less the sum of regrets.
        assert episode.episode_return == pytest.approx(8 * (1 - episode.regret), abs=1e-5)
        assert episode.length == 8
        assert not episode.terminated
    header, first, *_ = (tmp_path / "progress.csv").read_text().splitlines()
    logged = dict(zip(header.split(","), first.split(","), strict=True))
    expected = np.mean([episode.regret for episode in callback.episodes])
    assert float(logged["rollout/regret"]) == pytest.approx(expected)
    assert "rollout/similarity" in logged


def test_a_second_learn_continues_the_episodes_or_begins_new_ones() -> None:
    from sme_registry.sb3 import RegretCallback

    model = ppo(vec_env("batch"))
    model.n_steps = model.rollout_buffer.buffer_size = 4
    callback = RegretCallback()
    model.learn(8, callback=callback)
    assert callback.episodes == []
    model.learn(8, callback=callback, reset_num_timesteps=False)
    assert [(e.step, e.length) for e in callback.episodes] == [(16, 8), (16, 8)]
    model.learn(8, callback=callback)
    model.learn(8, callback=callback)
    assert len(callback.episodes) == 2


def test_a_teams_agents_have_their_own_regret() -> None:
    from sme_registry.sb3 import RegretCallback, SMETeamVecEnv

    callback = RegretCallback()
    model = ppo(SMETeamVecEnv("Team2", 2, horizon=8))
    model.learn(64, callback=callback)
    assert [episode.step for episode in callback.episodes] == [16, 16, 32, 32]
    for episode in callback.episodes:
        assert episode.regret == pytest.approx(np.mean(episode.agents_regret))
        assert len(episode.agents_regret) == 2


def test_other_environments_are_rejected() -> None:
    from sme_registry.sb3 import RegretCallback

    with pytest.raises(OptionError, match="no 'regret'"):
        ppo(gymnasium.make("Pendulum-v1")).learn(16, callback=RegretCallback())
