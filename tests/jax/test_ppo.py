"""PPO against Stable-Baselines3 from its weights and Adam's state in mid-run, and its program."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sme_registry import SMESpec
from sme_registry.jax import ppo
from sme_registry.jax.networks import Adam
from sme_registry.training.algorithms import silence
from sme_registry.training.monitored_env import MonitoredVecEnv

# Episodes end by D, by T, and by both; payouts are delayed.
SPEC = SMESpec(k=2, D=0.01, horizon=3)
SETTINGS = ppo.PPO(n_steps=512, n_epochs=40, clip_range_vf=0.2, ent_coef=0.01)
UPDATES = SETTINGS.n_steps // SETTINGS.batch_size * SETTINGS.n_epochs


@dataclass
class Recording:
    """SB3 in mid-run: a rollout, and the weights before and after the updates on it."""

    spec: SMESpec
    learner: ppo.Learner
    steps: ppo.Steps
    next_observation: jax.Array
    rollout: ppo.Rollout
    batches: jax.Array
    weights: list[dict[str, np.ndarray]] = field(default_factory=list)


@pytest.fixture(scope="module", params=[4, 16])
def recording(request: Any) -> Recording:
    from stable_baselines3 import PPO

    spec = SPEC.model_copy(update={"action_dim": request.param})
    env = RecordingEnv(spec, action_range="symmetric")
    names = ("n_steps", "n_epochs", "clip_range_vf", "ent_coef")
    model = PPO(
        "MlpPolicy", env, seed=3, device="cpu", **{name: getattr(SETTINGS, name) for name in names}
    )
    silence(model)
    model.learn(SETTINGS.n_steps)
    env.rows.clear()
    callback = model._setup_learn(SETTINGS.n_steps, None, False)[1]
    model.collect_rollouts(env, callback, model.rollout_buffer, SETTINGS.n_steps)
    buffer = model.rollout_buffer
    rewards, terminated, truncated, last = (np.stack(each) for each in zip(*env.rows, strict=True))
    rollout = ppo.Rollout(
        buffer.observations[:, 0],
        buffer.actions[:, 0],
        buffer.log_probs[:, 0],
        buffer.values[:, 0],
        buffer.advantages[:, 0],
    )
    steps = ppo.Steps(*rollout[:2], rewards, terminated, truncated, last)
    before = learner_of(model)
    weights: list[dict[str, np.ndarray]] = []
    model.policy.optimizer.register_step_post_hook(
        lambda *_: weights.append(weights_of(model)) if len(weights) < UPDATES else None
    )
    random = np.random.get_state()
    model.train()
    np.random.set_state(random)
    permutations = [np.random.permutation(SETTINGS.n_steps) for _ in range(SETTINGS.n_epochs)]
    batches = np.concatenate(permutations).reshape(UPDATES, SETTINGS.batch_size)
    return Recording(spec, before, steps, model._last_obs[0], rollout, batches, weights)


class RecordingEnv(MonitoredVecEnv):
    """An environment that keeps the rewards, ends and last observations of its steps."""

    rows: list[tuple[Any, ...]] = []

    def step_wait(self) -> Any:
        observation, rewards, dones, (info,) = super().step_wait()
        truncated = info["TimeLimit.truncated"]
        last = info.get("terminal_observation", observation[0])
        ends = info["terminated"], info["truncated"]
        self.rows.append((rewards[0], bool(dones[0]) and not truncated, truncated, last))
        return observation, rewards, dones, [info]


def weights_of(model: Any) -> dict[str, np.ndarray]:
    return {name: w.detach().numpy().copy() for name, w in model.policy.named_parameters()}


def learner_of(model: Any) -> ppo.Learner:
    names = list(weights_of(model))
    moments = model.policy.optimizer.state_dict()["state"]
    mean, square = (
        {name: moments[i][key].numpy().copy() for i, name in enumerate(names)}
        for key in ("exp_avg", "exp_avg_sq")
    )
    return ppo.Learner(weights_of(model), Adam(mean, square, np.int32(moments[0]["step"])))
