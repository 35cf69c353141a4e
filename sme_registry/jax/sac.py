"""SAC as in Stable-Baselines3: hyperparameters, initial weights, policy and update.

Source: Haarnoja et al. (2018), Soft Actor-Critic Algorithms and Applications. γ discount, `B`
batch, `A` action_dim, α entropy coefficient, H̄ target entropy; actions in [−1, 1].

    a = tanh(μ(s) + σ(s) ε),  ε ~ N(0, 1)
    log π(a|s) = Σ_A log N(μ + σ ε; μ, σ) − Σ_A log(1 − a² + 10⁻⁶)
    log α: minimise −log α · mean(log π + H̄)
    y = R + γ (1 − done) (min_i Q'_i(s', a') − α log π(a'|s')),  a' of the present policy
    critics: minimise ½ Σ_i mean (Q_i(s, a) − y)²
    policy: minimise mean(α log π(a_π|s) − min_i Q_i(s, a_π))
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sme_registry.errors import OptionError
from sme_registry.jax import critics
from sme_registry.jax.networks import (
    Adam,
    HostWeights,
    Weights,
    adam,
    initial_linear,
    initial_perceptron,
    linear,
)
from sme_registry.jax.off_policy import OffPolicyProgram, in_range
from sme_registry.jax.ranges import (
    Count,
    CountFromZero,
    Positive,
    Share,
    Updates,
    Weight,
    Widths,
)
from sme_registry.jax.replay import Transitions

_LEAST_LOG_STD, _GREATEST_LOG_STD = -20.0, 2.0
_ENTROPY = "log_ent_coef"  # an attribute of SB3's model, not of its policy


@dataclass(frozen=True)
class SAC:
    """Hyperparameters, with the names and defaults of `stable_baselines3.SAC`.

    `ent_coef` is "auto", "auto_" and the initial value, or a constant. `net_arch` is the widths of
    the hidden layers of actor and critics (`policy_kwargs.net_arch`). Without generalised
    state-dependent exploration and action noise, as is SB3's default.
    """

    learning_rate: Positive = 3e-4
    buffer_size: Count = 1_000_000
    learning_starts: CountFromZero = 100
    batch_size: Count = 256
    tau: Share = 0.005
    gamma: Share = 0.99
    train_freq: Count = 1
    gradient_steps: Updates = 1
    ent_coef: str | Weight = "auto"
    target_update_interval: Count = 1
    target_entropy: str | Weight = "auto"
    net_arch: Widths = (256, 256)

    def __post_init__(self) -> None:
        for name in ("ent_coef", "target_entropy"):
            _check_automatic(name, getattr(self, name))
        begins = self.initial_entropy_coefficient
        if not 0.0 <= begins < math.inf or (begins == 0.0 and self.learns_entropy):
            raise OptionError(
                f"hyperparameters.ent_coef={self.ent_coef!r}: must be finite and at least 0, and "
                "begin above 0 where its logarithm is learned."
            )

    @property
    def learns_entropy(self) -> bool:
        """Whether the entropy coefficient is learned."""
        return isinstance(self.ent_coef, str)

    @property
    def initial_entropy_coefficient(self) -> float:
        """α before the first update; 1 for "auto"."""
        return float(str(self.ent_coef).removeprefix("auto").removeprefix("_") or 1.0)


class Learner(NamedTuple):
    """What an update changes: all weights, by SB3's names, and the optimisers' states."""

    weights: Weights
    actor: Adam
    critic: Adam
    entropy: Adam


class SACProgram(OffPolicyProgram):
    draws = 2
    hidden = ("actor.latent_pi", jax.nn.relu)

    @staticmethod
    def initial_weights(
        settings: SAC, rng: np.random.Generator, observation_dim: int, action_dim: int
    ) -> HostWeights:
        """Actor, critics and their targets, by Torch's default initialisation; log α if learned."""
        *_, last = widths = [observation_dim, *settings.net_arch]
        actor = initial_perceptron(rng, "actor.latent_pi", widths)
        for head in ("mu", "log_std"):
            actor |= initial_linear(rng, f"actor.{head}", last, action_dim)
        both = critics.initial_critics(rng, observation_dim, action_dim, settings.net_arch)
        weights = critics.with_targets(actor | both, ("critic",))
        if settings.learns_entropy:
            log_alpha = math.log(settings.initial_entropy_coefficient)
            weights[_ENTROPY] = np.array([log_alpha], np.float32)
        return weights

    @staticmethod
    def initial_learner(weights: Weights) -> Learner:
        actor, critic = (critics.network(weights, name) for name in ("actor", "critic"))
        entropy = {name: weights[name] for name in weights if name == _ENTROPY}
        return Learner(weights, Adam.initial(actor), Adam.initial(critic), Adam.initial(entropy))

    @staticmethod
    def act(settings: SAC, weights: Weights, observations: jax.Array, symmetric: bool) -> jax.Array:
        return in_range(jnp.tanh(_gaussian(weights, observations)[0]), symmetric)

    @staticmethod
    def explore(
        weights: Weights, observation: jax.Array, noise: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """An action drawn from the policy."""
        return _sample(weights, observation, noise, mask)[0]

    @staticmethod
    def update(
        settings: SAC,
        learner: Learner,
        batch: Transitions,
        noise: jax.Array,
        mask: jax.Array,
        count: jax.Array,
        index: jax.Array,
    ) -> Learner:
        """See `OffPolicyProgram`; noise is for actions at the observations and at the next ones."""
        weights = learner.weights
        now, later = noise.transpose(1, 2, 0)

        (action, log_prob), pull_back = jax.vjp(
            lambda actor: _sample(actor, batch.observation, now, mask),
            critics.network(weights, "actor"),
        )
        coefficient = _coefficient(settings, weights)
        entropy, weights = _update_entropy(settings, learner.entropy, weights, log_prob, mask)

        next_action, next_log_prob = _sample(weights, batch.next_observation, later, mask)
        next_value = critics.smallest_value(
            weights, "critic_target", batch.next_observation, next_action
        )
        soft_value = next_value - coefficient * next_log_prob
        target = batch.reward + (1.0 - batch.done) * settings.gamma * soft_value
        critic, weights = critics.fit_critics(
            learner.critic, weights, batch, target, settings.learning_rate, scale=0.5
        )

        def loss(action: jax.Array, log_prob: jax.Array) -> jax.Array:
            values = critics.smallest_value(weights, "critic", batch.observation, action)
            return jnp.mean(coefficient * log_prob - values)

        # By the chain rule in two parts, the actor runs once for this loss and for the entropy's.
        (gradients,) = pull_back(jax.grad(loss, argnums=(0, 1))(action, log_prob))
        actor, moved = adam(
            learner.actor, critics.network(weights, "actor"), gradients, settings.learning_rate
        )
        weights = weights | moved
        weights = jax.lax.cond(
            index % settings.target_update_interval == 0,
            lambda weights: critics.follow(weights, "critic", settings.tau),
            lambda weights: weights,
            weights,
        )
        return Learner(weights, actor, critic, entropy)


def _check_automatic(name: str, value: str | float) -> None:
    """Raise OptionError unless it is a number or automatic."""
    forms = {"ent_coef": r"auto(_\d+(\.\d*)?(e-?\d+)?)?", "target_entropy": "auto"}
    if isinstance(value, str) and not re.fullmatch(forms[name], value):
        initial = ', "auto_0.1" (its initial value)' if name == "ent_coef" else ""
        raise OptionError(
            f'hyperparameters.{name}={value!r:.60}: must be "auto"{initial} or a number.'
        )


def _sample(
    weights: Weights, observation: jax.Array, noise: jax.Array, mask: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Actions `[..., A]`, 0 in padded channels, and log π `[...]` over the task's channels."""
    mean, log_std = _gaussian(weights, observation)
    action = jnp.tanh(mean + jnp.exp(log_std) * noise)
    normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2.0 * math.pi)
    density = normal - jnp.log(1.0 - action**2 + 1e-6)
    return jnp.where(mask, action, 0.0), jnp.sum(jnp.where(mask, density, 0.0), axis=-1)


def _gaussian(weights: Weights, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and log σ before the tanh, `[..., A]` each."""
    x = jax.nn.relu(critics.relu_perceptron(weights, "actor.latent_pi", observation))
    log_std = linear(weights, "actor.log_std", x)
    return linear(weights, "actor.mu", x), jnp.clip(log_std, _LEAST_LOG_STD, _GREATEST_LOG_STD)


def _coefficient(settings: SAC, weights: Weights) -> jax.Array:
    """α, learned or constant."""
    if settings.learns_entropy:
        return jnp.exp(weights[_ENTROPY][0])
    return jnp.asarray(settings.ent_coef, jnp.float32)


def _update_entropy(
    settings: SAC, state: Adam, weights: Weights, log_prob: jax.Array, mask: jax.Array
) -> tuple[Adam, Weights]:
    """Move log α, so that the policy's entropy approaches the target, −A where it is "auto"."""
    if not settings.learns_entropy:
        return state, weights
    target = -jnp.sum(mask, dtype=jnp.float32)
    if settings.target_entropy != "auto":
        target = jnp.asarray(settings.target_entropy, jnp.float32)
    gradients = {_ENTROPY: -jnp.mean(log_prob + target)[None]}
    own = {_ENTROPY: weights[_ENTROPY]}
    state, own = adam(state, own, gradients, settings.learning_rate)
    return state, weights | own
