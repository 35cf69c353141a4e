"""PPO as in Stable-Baselines3: hyperparameters, weights, advantages, updates, and `PPOProgram`.

Source: Schulman et al. 2017; order of operations and defaults: SB3's `PPO` with `MlpPolicy`.
`n` steps of a rollout, `O` observation width, `A` action channels, `B` a minibatch. Functions are
of one lane, and vmapped. Padded observation columns are 0; padded action channels have weights and
noise of 0 and are masked in densities, so that they get no gradients.

    ã ~ N(μ(o), σ²)                         action; clipped to the range only for the environment
    δ_t = R_t + γ V(o_{t+1}) − V(o_t)       V(o_{t+1}) is 0 after the end of an episode, but
                                            R_t includes γ V(last observation) after a truncation
    Â_t = δ_t + γ λ Â_{t+1}                 Â_{t+1} is 0 after the end of an episode
    loss = −mean min(ρ Â, clip(ρ, 1 ± ε) Â) + c_V mean (V − Â − V_old)² − c_H mean entropy
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sme_registry.jax.networks import (
    Adam,
    HostWeights,
    Weights,
    adam,
    clipped,
    initial_orthogonal,
    linear,
    perceptron,
)

_LOG_ROOT_TAU = 0.5 * math.log(2.0 * math.pi)
_ADAM_EPSILON = 1e-5  # SB3's for on-policy algorithms


@dataclass(frozen=True)
class PPO:
    """Hyperparameters, with Stable-Baselines3's names and defaults."""

    learning_rate: float = 3e-4
    n_steps: int = 2048
    batch_size: int = 64
    n_epochs: int = 10
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    clip_range_vf: float | None = None
    normalize_advantage: bool = True
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    net_arch: tuple[int, ...] = (64, 64)


class Learner(NamedTuple):
    """What an update changes: weights by SB3's names, and the optimiser's state."""

    weights: Weights
    optimiser: Adam


class Steps(NamedTuple):
    """The steps of a rollout, as the environment answered.

    Attributes:
      observation: `[n, O]` before the step.
      action: `[n, A]`, not clipped.
      reward: `[n]` R, float32.
      terminated: `[n]`.
      truncated: `[n]`.
      last_observation: `[n, O]` after the step, and before the next episode begins.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    last_observation: jax.Array


class Rollout(NamedTuple):
    """What updates learn from.

    Attributes:
      observation: `[n, O]`.
      action: `[n, A]`, not clipped.
      log_density: `[n]` log π of the action when it was taken.
      value: `[n]` V when it was taken.
      advantage: `[n]` Â.
    """

    observation: jax.Array
    action: jax.Array
    log_density: jax.Array
    value: jax.Array
    advantage: jax.Array


def initial_weights(
    settings: PPO, rng: np.random.Generator, observation_dim: int, action_dim: int
) -> HostWeights:
    """SB3's initial weights: orthogonal; biases and log σ are 0."""
    weights: HostWeights = {"log_std": np.zeros(action_dim, np.float32)}
    for network, head, outputs, gain in (
        ("policy_net", "action_net", action_dim, 0.01),
        ("value_net", "value_net", 1, 1.0),
    ):
        width = observation_dim
        for i, units in enumerate(settings.net_arch):
            name = f"mlp_extractor.{network}.{2 * i}"
            weights |= initial_orthogonal(rng, name, width, units, math.sqrt(2.0))
            width = units
        weights |= initial_orthogonal(rng, head, width, outputs, gain)
    return weights


def act(settings: PPO, weights: Weights, observation: jax.Array) -> jax.Array:
    """μ `[..., A]` of observations `[..., O]`: the deterministic action before it is clipped."""
    return linear(weights, "action_net", _latent(settings, weights, "policy_net", observation))


def value(settings: PPO, weights: Weights, observation: jax.Array) -> jax.Array:
    """V `[...]` of observations `[..., O]`."""
    latent = _latent(settings, weights, "value_net", observation)
    return linear(weights, "value_net", latent)[..., 0]


def log_density(
    settings: PPO, weights: Weights, observation: jax.Array, action: jax.Array, mask: jax.Array
) -> jax.Array:
    """log π `[...]` of actions `[..., A]`; only the channels of the mask `[A]` count."""
    log_std = weights["log_std"]
    z = (action - act(settings, weights, observation)) * jnp.exp(-log_std)
    return jnp.sum(jnp.where(mask, -0.5 * z**2 - log_std - _LOG_ROOT_TAU, 0.0), axis=-1)


def rollout(
    settings: PPO, weights: Weights, steps: Steps, next_observation: jax.Array, mask: jax.Array
) -> Rollout:
    """Densities, values and advantages of the steps of one lane.

    An episode that was truncated would have gone on: the value of its last observation is added to
    its last reward.

    Args:
      settings: the hyperparameters.
      weights: with which the actions were drawn.
      steps: the steps.
      next_observation: `[O]` with which the next rollout begins.
      mask: `[A]` which action channels exist.
    """
    values = value(settings, weights, steps.observation)
    cut = steps.truncated & ~steps.terminated
    last_value = value(settings, weights, steps.last_observation)
    reward = steps.reward + jnp.where(cut, settings.gamma * last_value, 0.0)
    ended = steps.terminated | steps.truncated
    next_value = value(settings, weights, next_observation)
    return Rollout(
        steps.observation,
        steps.action,
        log_density(settings, weights, steps.observation, steps.action, mask),
        values,
        advantages(settings, reward, values, next_value, ended),
    )


def advantages(
    settings: PPO, reward: jax.Array, values: jax.Array, next_value: jax.Array, ended: jax.Array
) -> jax.Array:
    """Generalised advantage estimates Â `[n]` (Schulman et al. 2016).

    Args:
      settings: γ and λ.
      reward: `[n]` R, with the value of the last observation where an episode was truncated.
      values: `[n]` V of the observations.
      next_value: V of the observation after the last step.
      ended: `[n]` whether the step ended an episode.
    """
    goes_on = 1.0 - ended.astype(jnp.float32)
    following = jnp.append(values[1:], next_value)
    delta = reward + settings.gamma * following * goes_on - values
    decay = settings.gamma * settings.gae_lambda * goes_on

    def step(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        advantage = now[0] + now[1] * later
        return advantage, advantage

    return jax.lax.scan(step, jnp.zeros((), jnp.float32), (delta, decay), reverse=True)[1]


def update(
    settings: PPO,
    learner: Learner,
    rollout: Rollout,
    batches: jax.Array,
    mask: jax.Array,
) -> Learner:
    """One update for each minibatch.

    Args:
      settings: the hyperparameters.
      learner: the state before.
      rollout: the steps.
      batches: `[updates, B]` which steps are in each minibatch.
      mask: `[A]` which action channels exist.
    """

    def one(learner: Learner, batch: jax.Array) -> tuple[Learner, None]:
        weights, optimiser = learner
        chosen = Rollout(*(each[batch] for each in rollout))
        gradients = jax.grad(_loss, argnums=1)(settings, weights, chosen, mask)
        gradients = clipped(gradients, settings.max_grad_norm)
        rate = settings.learning_rate
        optimiser, weights = adam(optimiser, weights, gradients, rate, _ADAM_EPSILON)
        return Learner(weights, optimiser), None

    return jax.lax.scan(one, learner, batches)[0]


def _loss(settings: PPO, weights: Weights, batch: Rollout, mask: jax.Array) -> jax.Array:
    density = log_density(settings, weights, batch.observation, batch.action, mask)
    ratio = jnp.exp(density - batch.log_density)
    advantage = batch.advantage
    if settings.normalize_advantage:
        advantage = (advantage - advantage.mean()) / (advantage.std(ddof=1) + 1e-8)
    limited = jnp.clip(ratio, 1.0 - settings.clip_range, 1.0 + settings.clip_range)
    policy_loss = -jnp.minimum(advantage * ratio, advantage * limited).mean()

    values = value(settings, weights, batch.observation)
    if settings.clip_range_vf is not None:
        change = jnp.clip(values - batch.value, -settings.clip_range_vf, settings.clip_range_vf)
        values = batch.value + change
    value_loss = ((batch.advantage + batch.value - values) ** 2).mean()
    entropy = jnp.sum(jnp.where(mask, 0.5 + _LOG_ROOT_TAU + weights["log_std"], 0.0))
    return policy_loss + settings.vf_coef * value_loss - settings.ent_coef * entropy


def _latent(settings: PPO, weights: Weights, network: str, observation: jax.Array) -> jax.Array:
    """The last hidden layer of the policy's or the value's perceptron."""
    layers = len(settings.net_arch)
    hidden = perceptron(weights, f"mlp_extractor.{network}", observation, layers, jnp.tanh)
    return jnp.tanh(hidden)
