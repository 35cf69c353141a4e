"""TD3 as in Stable-Baselines3: hyperparameters, initial weights, policy and update.

Source: Fujimoto, van Hoof & Meger (2018), Addressing Function Approximation Error in Actor-Critic
Methods. γ discount, `B` batch, `A` action_dim; actions in [−1, 1].

    y = R + γ (1 − done) min_i Q'_i(s', clip(π'(s') + clip(σ ε, −c, c), −1, 1)),  ε ~ N(0, 1)
    critics: minimise Σ_i mean (Q_i(s, a) − y)²
    policy, and all targets, at every `policy_delay`-th update: maximise mean Q_1(s, π(s))
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sme_registry.jax import critics
from sme_registry.jax.networks import (
    Adam,
    HostWeights,
    Weights,
    adam,
    initial_perceptron,
)
from sme_registry.jax.off_policy import OffPolicyProgram, in_range
from sme_registry.jax.ranges import (
    Count,
    CountFromZero,
    NotNegative,
    Positive,
    Share,
    Updates,
    Widths,
)
from sme_registry.jax.replay import Transitions


@dataclass(frozen=True)
class TD3:
    """Hyperparameters, with the names and defaults of `stable_baselines3.TD3`; no action noise.

    `net_arch` is the widths of the hidden layers of actor and critics (`policy_kwargs.net_arch`).
    """

    learning_rate: Positive = 1e-3
    buffer_size: Count = 1_000_000
    learning_starts: CountFromZero = 100
    batch_size: Count = 256
    tau: Share = 0.005
    gamma: Share = 0.99
    train_freq: Count = 1
    gradient_steps: Updates = 1
    policy_delay: Count = 2
    target_policy_noise: NotNegative = 0.2
    target_noise_clip: NotNegative = 0.5
    net_arch: Widths = (400, 300)


class Learner(NamedTuple):
    """What an update changes: all weights, by SB3's names, and the optimisers' states."""

    weights: Weights
    actor: Adam
    critic: Adam


class TD3Program(OffPolicyProgram):
    draws = 1
    hidden = ("actor.mu", jax.nn.relu)

    @staticmethod
    def initial_weights(
        settings: TD3, rng: np.random.Generator, observation_dim: int, action_dim: int
    ) -> HostWeights:
        """Actor, critics and their targets, by Torch's default initialisation."""
        widths = [observation_dim, *settings.net_arch, action_dim]
        actor = initial_perceptron(rng, "actor.mu", widths)
        both = critics.initial_critics(rng, observation_dim, action_dim, settings.net_arch)
        return critics.with_targets(actor | both, ("actor", "critic"))

    @staticmethod
    def initial_learner(weights: Weights) -> Learner:
        actor, critic = (critics.network(weights, name) for name in ("actor", "critic"))
        return Learner(weights, Adam.initial(actor), Adam.initial(critic))

    @staticmethod
    def act(settings: TD3, weights: Weights, observations: jax.Array, symmetric: bool) -> jax.Array:
        return in_range(_action(weights, observations), symmetric)

    @staticmethod
    def explore(
        weights: Weights, observation: jax.Array, noise: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """The deterministic action: SB3 adds no noise by default."""
        return _action(weights, observation)

    @staticmethod
    def update(
        settings: TD3,
        learner: Learner,
        batch: Transitions,
        noise: jax.Array,
        mask: jax.Array,
        count: jax.Array,
        index: jax.Array,
    ) -> Learner:
        """See `OffPolicyProgram`; the noise smooths the target policy.

        Padded action channels need no mask: actions there are 0 and so are the weights that read
        them, whose gradients are 0, too.
        """
        weights = learner.weights
        clip = settings.target_noise_clip
        smoothing = jnp.clip(settings.target_policy_noise * noise[:, 0].T, -clip, clip)
        next_action = _action(weights, batch.next_observation, "actor_target") + smoothing
        next_value = critics.smallest_value(
            weights, "critic_target", batch.next_observation, jnp.clip(next_action, -1.0, 1.0)
        )
        target = batch.reward + (1.0 - batch.done) * settings.gamma * next_value
        critic, weights = critics.fit_critics(
            learner.critic, weights, batch, target, settings.learning_rate, scale=1.0
        )
        learner = Learner(weights, learner.actor, critic)
        after: Learner = jax.lax.cond(
            count % settings.policy_delay == 0,
            lambda learner: _update_policy(settings, learner, batch.observation),
            lambda learner: learner,
            learner,
        )
        return after


def _action(weights: Weights, observation: jax.Array, policy: str = "actor") -> jax.Array:
    """Deterministic actions `[..., A]` in [−1, 1] of the actor, or of `actor_target`."""
    return jnp.tanh(critics.relu_perceptron(weights, f"{policy}.mu", observation))


def _update_policy(settings: TD3, learner: Learner, observation: jax.Array) -> Learner:
    """Move the actor up the first critic's value, then all targets towards their networks."""
    weights = learner.weights

    def loss(actor: Weights) -> jax.Array:
        action = _action(actor, observation)
        return -jnp.mean(critics.value(weights, "critic.qf0", observation, action))

    actor = critics.network(weights, "actor")
    state, actor = adam(learner.actor, actor, jax.grad(loss)(actor), settings.learning_rate)
    weights = weights | actor
    for name in ("critic", "actor"):
        weights = critics.follow(weights, name, settings.tau)
    return Learner(weights, state, learner.critic)
