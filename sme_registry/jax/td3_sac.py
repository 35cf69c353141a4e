"""TD3 and SAC as in Stable-Baselines3: hyperparameters, critics, policies and updates.

Critics are twins, and targets follow by Polyak averaging. γ discount, `B` batch, `A` action_dim;
actions in [−1, 1].
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import model_validator

from sme_registry.jax.env import to_unit
from sme_registry.jax.networks import (
    Adam,
    Count,
    HostWeights,
    NotNegative,
    Positive,
    Weights,
    adam,
    initial_linear,
    initial_perceptron,
    linear,
    network,
    perceptron,
)
from sme_registry.jax.off_policy import (
    OffPolicyLearner,
    OffPolicyProgram,
    OffPolicySettings,
    ReplayRows,
)
from sme_registry.spec.document import Real

_CRITICS = 2
_LEAST_LOG_STD, _GREATEST_LOG_STD = -20.0, 2.0
_ENTROPY = "log_ent_coef"  # an attribute of SB3's model, not of its policy


class TD3(OffPolicySettings):
    """Hyperparameters, with the defaults of `stable_baselines3.TD3`; no action noise."""

    usual_widths = (400, 300)
    learning_rate: Positive = 1e-3
    policy_delay: Count = 2
    target_policy_noise: NotNegative = 0.2
    target_noise_clip: NotNegative = 0.5


class SAC(OffPolicySettings):
    """Hyperparameters, with the defaults of `stable_baselines3.SAC`.

    `ent_coef` is "auto", "auto_" and the initial value, or a constant. Without generalised
    state-dependent exploration and action noise, as is SB3's default.
    """

    usual_widths = (256, 256)
    learning_rate: Positive = 3e-4
    ent_coef: str | Real = "auto"
    target_update_interval: Count = 1
    target_entropy: str | Real = "auto"

    @model_validator(mode="after")
    def _coefficients_are_numbers_or_automatic(self) -> Self:
        forms = {"ent_coef": r"auto(_\d+(\.\d*)?(e-?\d+)?)?", "target_entropy": "auto"}
        for name, form in forms.items():
            value = getattr(self, name)
            if isinstance(value, str) and not re.fullmatch(form, value):
                initial = ', "auto_0.1" (its initial value)' if name == "ent_coef" else ""
                raise ValueError(f'{name}={value!r:.60}: must be "auto"{initial} or a number.')
        begins = self.initial_entropy_coefficient
        if not 0.0 <= begins < math.inf or (begins == 0.0 and self.learns_entropy):
            raise ValueError(
                f"ent_coef={self.ent_coef!r}: must be finite and at least 0, and begin above 0 "
                "where its logarithm is learned."
            )
        return self

    @property
    def learns_entropy(self) -> bool:
        return isinstance(self.ent_coef, str)

    @property
    def initial_entropy_coefficient(self) -> float:
        """α before the first update; 1 for "auto"."""
        return float(str(self.ent_coef).removeprefix("auto").removeprefix("_") or 1.0)


class TD3Program(OffPolicyProgram):
    """Source: Fujimoto, van Hoof & Meger (2018), Addressing Function Approximation Error.

    y = R + γ (1 − done) min_i Q'_i(s', clip(π'(s') + clip(σ ε, −c, c), −1, 1)),  ε ~ N(0, 1)
    critics: minimise Σ_i mean (Q_i(s, a) − y)²
    policy, and all targets, at every `policy_delay`-th update: maximise mean Q_1(s, π(s))
    """

    draws = 1
    hidden = ("actor.mu", jax.nn.relu)

    @staticmethod
    def initial_weights(
        settings: TD3, rng: np.random.Generator, observation_dim: int, action_dim: int
    ) -> HostWeights:
        widths = [observation_dim, *settings.net_arch, action_dim]
        actor = initial_perceptron(rng, "actor.mu", widths)
        both = initial_critics(rng, observation_dim, action_dim, settings.net_arch)
        return with_targets(actor | both, ("actor", "critic"))

    @staticmethod
    def act(settings: TD3, weights: Weights, observations: jax.Array, symmetric: bool) -> jax.Array:
        return _in_range(_deterministic(weights, observations), symmetric)

    @staticmethod
    def explore(
        weights: Weights, observation: jax.Array, noise: jax.Array, channels: jax.Array
    ) -> jax.Array:
        """The deterministic action: SB3 adds no noise by default."""
        return _deterministic(weights, observation)

    @staticmethod
    def update(
        settings: TD3,
        learner: OffPolicyLearner,
        batch: ReplayRows,
        noise: jax.Array,
        channels: jax.Array,
        count: jax.Array,
        index: jax.Array,
    ) -> OffPolicyLearner:
        weights = learner.weights
        clip = settings.target_noise_clip
        smoothing = jnp.clip(settings.target_policy_noise * noise[:, 0].T, -clip, clip)
        next_action = _deterministic(weights, batch.next_observation, "actor_target") + smoothing
        next_value = smallest_value(
            weights, "critic_target", batch.next_observation, jnp.clip(next_action, -1.0, 1.0)
        )
        target = batch.reward + (1.0 - batch.done) * settings.gamma * next_value
        rate = settings.learning_rate
        critic, weights = fit_critics(
            learner.critic, weights, *batch[:2], target, learning_rate=rate, scale=1.0
        )
        learner = learner._replace(weights=weights, critic=critic)
        after: OffPolicyLearner = jax.lax.cond(
            count % settings.policy_delay == 0,
            lambda learner: _improved_policy(settings, learner, batch.observation),
            lambda learner: learner,
            learner,
        )
        return after


def _deterministic(weights: Weights, observation: jax.Array, policy: str = "actor") -> jax.Array:
    """Actions `[..., A]` of TD3's actor, or of `actor_target`."""
    return jnp.tanh(perceptron(weights, f"{policy}.mu", observation))


def _improved_policy(
    settings: TD3, learner: OffPolicyLearner, observation: jax.Array
) -> OffPolicyLearner:
    """Move TD3's actor up the first critic's value, then all targets."""
    weights = learner.weights

    def loss(actor: Weights) -> jax.Array:
        action = _deterministic(actor, observation)
        return -jnp.mean(critic_value(weights, "critic.qf0", observation, action))

    actor = network(weights, "actor")
    state, actor = adam(learner.actor, actor, jax.grad(loss)(actor), settings.learning_rate)
    weights = weights | actor
    for name in ("critic", "actor"):
        weights = follow(weights, name, settings.tau)
    return learner._replace(weights=weights, actor=state)


class SACProgram(OffPolicyProgram):
    """Source: Haarnoja et al. (2018), Soft Actor-Critic Algorithms and Applications.

    a = tanh(μ(s) + σ(s) ε),  ε ~ N(0, 1)
    log π(a|s) = Σ_A log N(μ + σ ε; μ, σ) − Σ_A log(1 − a² + 10⁻⁶)
    log α: minimise −log α · mean(log π + H̄),  H̄ the target entropy
    y = R + γ (1 − done) (min_i Q'_i(s', a') − α log π(a'|s')),  a' of the present policy
    critics: minimise ½ Σ_i mean (Q_i(s, a) − y)²
    policy: minimise mean(α log π(a_π|s) − min_i Q_i(s, a_π))
    """

    draws = 2
    hidden = ("actor.latent_pi", jax.nn.relu)

    @staticmethod
    def initial_weights(
        settings: SAC, rng: np.random.Generator, observation_dim: int, action_dim: int
    ) -> HostWeights:
        *_, last = widths = [observation_dim, *settings.net_arch]
        actor = initial_perceptron(rng, "actor.latent_pi", widths)
        for head in ("mu", "log_std"):
            actor |= initial_linear(rng, f"actor.{head}", last, action_dim)
        both = initial_critics(rng, observation_dim, action_dim, settings.net_arch)
        weights = with_targets(actor | both, ("critic",))
        if settings.learns_entropy:
            log_alpha = math.log(settings.initial_entropy_coefficient)
            weights[_ENTROPY] = np.array([log_alpha], np.float32)
        return weights

    @staticmethod
    def initial_learner(weights: Weights) -> OffPolicyLearner:
        entropy = {name: weights[name] for name in weights if name == _ENTROPY}
        learner = OffPolicyProgram.initial_learner(weights)
        return learner._replace(entropy=Adam.initial(entropy))

    @staticmethod
    def act(settings: SAC, weights: Weights, observations: jax.Array, symmetric: bool) -> jax.Array:
        return _in_range(jnp.tanh(_gaussian(weights, observations)[0]), symmetric)

    @staticmethod
    def explore(
        weights: Weights, observation: jax.Array, noise: jax.Array, channels: jax.Array
    ) -> jax.Array:
        """An action drawn from the policy."""
        return _sample(weights, observation, noise, channels)[0]

    @staticmethod
    def update(
        settings: SAC,
        learner: OffPolicyLearner,
        batch: ReplayRows,
        noise: jax.Array,
        channels: jax.Array,
        count: jax.Array,
        index: jax.Array,
    ) -> OffPolicyLearner:
        weights, rate = learner.weights, settings.learning_rate
        now, later = noise.transpose(1, 2, 0)

        (action, log_prob), pull_back = jax.vjp(
            lambda actor: _sample(actor, batch.observation, now, channels),
            network(weights, "actor"),
        )
        alpha = _entropy_coefficient(settings, weights)
        learner = _updated_entropy(settings, learner, log_prob, action.shape[-1])
        weights = learner.weights

        next_action, next_log_prob = _sample(weights, batch.next_observation, later, channels)
        next_value = smallest_value(weights, "critic_target", batch.next_observation, next_action)
        soft_value = next_value - alpha * next_log_prob
        target = batch.reward + (1.0 - batch.done) * settings.gamma * soft_value
        critic, weights = fit_critics(
            learner.critic, weights, *batch[:2], target, learning_rate=rate, scale=0.5
        )

        def loss(action: jax.Array, log_prob: jax.Array) -> jax.Array:
            values = smallest_value(weights, "critic", batch.observation, action)
            return jnp.mean(alpha * log_prob - values)

        # By the chain rule in two parts, the actor runs once for this loss and for the entropy's.
        (gradients,) = pull_back(jax.grad(loss, argnums=(0, 1))(action, log_prob))
        actor, moved = adam(learner.actor, network(weights, "actor"), gradients, rate)
        weights = jax.lax.cond(
            index % settings.target_update_interval == 0,
            lambda weights: follow(weights, "critic", settings.tau),
            lambda weights: weights,
            weights | moved,
        )
        return learner._replace(weights=weights, actor=actor, critic=critic)


def _sample(
    weights: Weights, observation: jax.Array, noise: jax.Array, channels: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Actions `[..., A]` of SAC's policy, and their log π `[...]`; see `TaskParams.channels`."""
    mean, log_std = _gaussian(weights, observation)
    action = jnp.tanh(mean + jnp.exp(log_std) * noise)
    normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2.0 * math.pi)
    density = normal - jnp.log(1.0 - action**2 + 1e-6)
    log_prob = jnp.sum(jnp.where(channels, density, 0.0), axis=-1)
    return jnp.where(channels, action, 0.0), log_prob


def _gaussian(weights: Weights, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and log σ before the tanh, `[..., A]` each."""
    x = jax.nn.relu(perceptron(weights, "actor.latent_pi", observation))
    log_std = linear(weights, "actor.log_std", x)
    mean = linear(weights, "actor.mu", x)
    return mean, jnp.clip(log_std, _LEAST_LOG_STD, _GREATEST_LOG_STD)


def _entropy_coefficient(settings: SAC, weights: Weights) -> jax.Array:
    """α, learned or constant."""
    if settings.learns_entropy:
        return jnp.exp(weights[_ENTROPY][0])
    return jnp.asarray(settings.ent_coef, jnp.float32)


def _updated_entropy(
    settings: SAC, learner: OffPolicyLearner, log_prob: jax.Array, action_dim: int
) -> OffPolicyLearner:
    """Move log α, so that the policy's entropy approaches the target, −A where it is "auto"."""
    if not settings.learns_entropy:
        return learner
    automatic = settings.target_entropy == "auto"
    target = jnp.asarray(-action_dim if automatic else settings.target_entropy, jnp.float32)
    gradients = {_ENTROPY: -jnp.mean(log_prob + target)[None]}
    coefficient = {_ENTROPY: learner.weights[_ENTROPY]}
    assert learner.entropy is not None
    entropy, coefficient = adam(learner.entropy, coefficient, gradients, settings.learning_rate)
    return learner._replace(weights=learner.weights | coefficient, entropy=entropy)


def _in_range(action: jax.Array, symmetric: bool) -> jax.Array:
    """Actions in [−1, 1], in the action range of the environment."""
    return action if symmetric else to_unit(action, symmetric=True, dtype=jnp.float32)


def initial_critics(
    rng: np.random.Generator, observation_dim: int, action_dim: int, net_arch: Sequence[int]
) -> HostWeights:
    """Two critics from (observation, action) to a value, by Torch's default."""
    widths = [observation_dim + action_dim, *net_arch, 1]
    weights: HostWeights = {}
    for i in range(_CRITICS):
        weights |= initial_perceptron(rng, f"critic.qf{i}", widths)
    return weights


def with_targets(weights: HostWeights, networks: Sequence[str]) -> HostWeights:
    """The weights and, for these networks, targets that equal them: `actor` → `actor_target`."""
    targets = {
        f"{network}_target{name.removeprefix(network)}": weight.copy()
        for network in networks
        for name, weight in weights.items()
        if name.startswith(f"{network}.")
    }
    return weights | targets


def critic_value(
    weights: Weights, critic: str, observation: jax.Array, action: jax.Array
) -> jax.Array:
    x = jnp.concatenate([observation, action], axis=-1)
    return perceptron(weights, critic, x)[..., 0]


def smallest_value(
    weights: Weights, critics: str, observation: jax.Array, action: jax.Array
) -> jax.Array:
    """min over both critics of Q(observation, action), `[B]`; `critics` is their prefix."""
    names = [f"{critics}.qf{i}" for i in range(_CRITICS)]
    return jnp.minimum(*(critic_value(weights, name, observation, action) for name in names))


def fit_critics(
    state: Adam,
    weights: Weights,
    observation: jax.Array,
    action: jax.Array,
    target: jax.Array,
    *,
    learning_rate: float,
    scale: float,
) -> tuple[Adam, Weights]:
    """One update of both critics towards `target` `[B]`, by `scale` times their squared errors."""

    def loss(critic: Weights) -> jax.Array:
        errors = [
            critic_value(critic, f"critic.qf{i}", observation, action) - target
            for i in range(_CRITICS)
        ]
        return scale * jnp.sum(jnp.stack([jnp.mean(error**2) for error in errors]))

    critic = network(weights, "critic")
    state, critic = adam(state, critic, jax.grad(loss)(critic), learning_rate)
    return state, weights | critic


def follow(weights: Weights, name: str, tau: float) -> Weights:
    """All weights, after the targets of a network moved: target ← (1 − τ) target + τ weight."""
    moved = {}
    for key, weight in network(weights, name).items():
        target = f"{name}_target{key.removeprefix(name)}"
        moved[target] = (1.0 - tau) * weights[target] + tau * weight
    return weights | moved
