"""Evaluations compared with SB3's `evaluate_policy`, training steps compared with Pendulum-v1."""

from __future__ import annotations

import time
import warnings
from typing import Any

import pytest

import sme_registry
from sme_registry import SMESpec, materialize
from sme_registry.evaluation.rollouts import rollouts, start_states
from sme_registry.training.algorithms import one_thread
from sme_registry.training.numpy_policy import numpy_policy

sb3 = pytest.importorskip("stable_baselines3")

SPEC = SMESpec()
EPISODES = 5
# Steps per round; PPO learns at the end of each rollout of 2,048 steps.
ROUND = {"PPO": 2048, "TD3": 40, "SAC": 40}


def learner(algorithm: str, env: Any) -> Any:
    settings = {} if algorithm == "PPO" else {"buffer_size": 20_000, "learning_starts": 10}
    model = getattr(sb3, algorithm)("MlpPolicy", env, seed=0, device="cpu", **settings)
    model.set_logger(sb3.common.logger.Logger(None, []))
    return model


@pytest.mark.parametrize("algorithm", ["TD3", "SAC", "PPO"])
def test_evaluations_of_five_episodes(compare: Any, algorithm: str) -> None:
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    from sme_registry.sb3 import SMEVecEnv

    model, task = learner(algorithm, SMEVecEnv(SPEC)), materialize(SPEC)
    env = Monitor(sme_registry.make(SPEC, action_range="symmetric"))
    env.reset(seed=0)

    def ours(times: int) -> None:
        for evaluation in range(times):  # each evaluation copies the weights
            rollouts(
                numpy_policy(model, SPEC),
                task,
                start_states(0, evaluation, EPISODES, SPEC.state_dim),
            )

    def sb3_evaluations(times: int) -> None:
        for _ in range(times):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                evaluate_policy(model, env, EPISODES)

    with one_thread():
        compare(
            f"{algorithm}, an evaluation of {EPISODES} episodes", "pass", ours, 5,
            {"SB3's evaluate_policy": (sb3_evaluations, 1, 5.0)}, clock=time.thread_time,
        )  # fmt: skip


@pytest.mark.parametrize("algorithm", ROUND)
def test_training_steps(compare: Any, algorithm: str) -> None:
    from sme_registry.sb3 import SMEVecEnv

    def training(env: Any) -> Any:
        model = learner(algorithm, env)
        model.learn(ROUND[algorithm])
        return lambda steps: model.learn(steps, reset_num_timesteps=False)

    env, steps = SMEVecEnv(SPEC), ROUND[algorithm]
    with one_thread():
        compare(
            f"{algorithm}, a step of training", "step", training(env), steps,
            {"the same on Pendulum-v1": (training("Pendulum-v1"), steps, 0.0)},
            clock=time.thread_time,
        )  # fmt: skip
