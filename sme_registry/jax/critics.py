"""The twin critics of TD3 and SAC, and targets that follow by Polyak averaging.

Names are those of Stable-Baselines3's `state_dict`: `critic.qf0.0.weight`, `critic_target.…`.
`B` batch.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from sme_registry.jax.networks import (
    Adam,
    HostWeights,
    Weights,
    adam,
    initial_perceptron,
    perceptron,
)
from sme_registry.jax.replay import Transitions

_CRITICS = 2


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
        f"{network}_target{name.removeprefix(network)}": value.copy()
        for network in networks
        for name, value in weights.items()
        if name.startswith(f"{network}.")
    }
    return weights | targets


def network(weights: Weights, name: str) -> Weights:
    """The weights of one network: `actor`, `critic`, `critic_target`."""
    return {each: weights[each] for each in weights if each.startswith(f"{name}.")}


def relu_perceptron(weights: Weights, prefix: str, x: jax.Array) -> jax.Array:
    """Outputs of a perceptron with ReLU between its layers, as many as it has weights for."""
    layers = sum(name.startswith(f"{prefix}.") for name in weights) // 2
    return perceptron(weights, prefix, x, layers, jax.nn.relu)


def value(weights: Weights, critic: str, observation: jax.Array, action: jax.Array) -> jax.Array:
    """Q(observation, action) `[B]` of one critic, such as `critic.qf0`."""
    x = jnp.concatenate([observation, action], axis=-1)
    return relu_perceptron(weights, critic, x)[..., 0]


def smallest_value(
    weights: Weights, critics: str, observation: jax.Array, action: jax.Array
) -> jax.Array:
    """min over both critics of Q(observation, action), `[B]`; `critics` is their prefix."""
    names = [f"{critics}.qf{i}" for i in range(_CRITICS)]
    return jnp.minimum(*(value(weights, name, observation, action) for name in names))


def fit_critics(
    state: Adam,
    weights: Weights,
    batch: Transitions,
    target: jax.Array,
    learning_rate: float,
    scale: float,
) -> tuple[Adam, Weights]:
    """One update of both critics towards the values `target` `[B]`.

    Minimises `scale` times the sum over critics of their mean squared errors.
    """

    def loss(critic: Weights) -> jax.Array:
        errors = [
            value(critic, f"critic.qf{i}", batch.observation, batch.action) - target
            for i in range(_CRITICS)
        ]
        return scale * jnp.sum(jnp.stack([jnp.mean(error**2) for error in errors]))

    critic = network(weights, "critic")
    state, critic = adam(state, critic, jax.grad(loss)(critic), learning_rate)
    return state, weights | critic


def follow(weights: Weights, name: str, tau: float) -> Weights:
    """All weights, after the targets of a network moved: target ← (1 − τ) target + τ weight."""
    moved = {}
    for each, weight in network(weights, name).items():
        target = f"{name}_target{each.removeprefix(name)}"
        moved[target] = (1.0 - tau) * weights[target] + tau * weight
    return weights | moved
