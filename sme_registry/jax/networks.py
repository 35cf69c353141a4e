"""Perceptrons whose weights have Stable-Baselines3's names; Adam; types of hyperparameters.

Weights are a flat dict from the names of SB3's `state_dict` to arrays in Torch's layout,
`[out, in]` for a layer, so that exchanging a model with SB3 is a copy. Only `initial_…` run on the
host; all other functions are pure, of one run, and vmapped over the runs of a program.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Annotated, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from pydantic import Field

from sme_registry.spec.document import Integer, Real, StrictModel, TupleOf

Weights = dict[str, jax.Array]
HostWeights = dict[str, npt.NDArray[np.float32]]


def perceptron(weights: Weights, prefix: str, x: jax.Array) -> jax.Array:
    """Outputs `[..., out]` of linear layers with ReLU between them; layer i is `<prefix>.<2 i>`."""
    last = sum(name.startswith(f"{prefix}.") for name in weights) // 2 - 1
    *_, x = x, *hidden_layers(weights, prefix, x, last, jax.nn.relu)
    return linear(weights, f"{prefix}.{2 * last}", x)


def hidden_layers(
    weights: Weights,
    prefix: str,
    x: jax.Array,
    layers: int,
    activation: Callable[[jax.Array], jax.Array],
) -> list[jax.Array]:
    """The outputs `[..., H]` of the first layers of `perceptron`, each with its activation."""
    outputs = []
    for i in range(layers):
        x = activation(linear(weights, f"{prefix}.{2 * i}", x))
        outputs.append(x)
    return outputs


def linear(weights: Weights, name: str, x: jax.Array) -> jax.Array:
    return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def initial_linear(rng: np.random.Generator, name: str, inputs: int, outputs: int) -> HostWeights:
    """Torch's default: weights and biases from U(−1/√in, 1/√in)."""
    bound = 1.0 / math.sqrt(inputs)
    return {
        f"{name}.weight": rng.uniform(-bound, bound, (outputs, inputs)).astype(np.float32),
        f"{name}.bias": rng.uniform(-bound, bound, outputs).astype(np.float32),
    }


def initial_orthogonal(
    rng: np.random.Generator, name: str, inputs: int, outputs: int, gain: float
) -> HostWeights:
    """`torch.nn.init.orthogonal_` with a gain, and biases of 0: SB3's on-policy default."""
    rows, columns = max(outputs, inputs), min(outputs, inputs)
    Q, R = np.linalg.qr(rng.standard_normal((rows, columns)))
    Q *= np.sign(np.diag(R))
    W = Q if outputs >= inputs else Q.T
    return {
        f"{name}.weight": np.ascontiguousarray(gain * W, np.float32),
        f"{name}.bias": np.zeros(outputs, np.float32),
    }


def initial_perceptron(rng: np.random.Generator, prefix: str, widths: Sequence[int]) -> HostWeights:
    """Torch's default for each layer of a perceptron of these widths, input first."""
    weights: HostWeights = {}
    for i, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        weights |= initial_linear(rng, f"{prefix}.{2 * i}", inputs, outputs)
    return weights


def network(weights: Weights, name: str) -> Weights:
    """The weights of one network: `actor`, `critic`, `critic_target`."""
    return {key: weight for key, weight in weights.items() if key.startswith(f"{name}.")}


class Adam(NamedTuple):
    """The state of `torch.optim.Adam`: moments of each weight, and the number of updates."""

    mean: Weights
    square: Weights
    updates: jax.Array

    @classmethod
    def initial(cls, weights: Weights) -> Adam:
        zeros = {name: jnp.zeros_like(w) for name, w in weights.items()}
        return cls(zeros, dict(zeros), jnp.zeros((), jnp.int32))


def adam(
    state: Adam,
    weights: Weights,
    gradients: Weights,
    learning_rate: float | jax.Array,
    epsilon: float = 1e-8,
) -> tuple[Adam, Weights]:
    """One update of `torch.optim.Adam`, in its order of operations."""
    count = state.updates + 1
    first, second = 0.9, 0.999
    t = count.astype(jnp.float64)
    step = (learning_rate / (1.0 - first**t)).astype(jnp.float32)
    root = jnp.sqrt(1.0 - second**t).astype(jnp.float32)
    mean = {n: m + (1.0 - first) * (gradients[n] - m) for n, m in state.mean.items()}
    square = {n: second * v + (1.0 - second) * gradients[n] ** 2 for n, v in state.square.items()}
    new = {
        name: weight - step * mean[name] / (jnp.sqrt(square[name]) / root + epsilon)
        for name, weight in weights.items()
    }
    return Adam(mean, square, count), new


def clipped(gradients: Weights, largest_norm: float) -> Weights:
    """`torch.nn.utils.clip_grad_norm_`: scaled to at most this norm over all weights."""
    norm = jnp.sqrt(sum(jnp.sum(gradient**2) for gradient in gradients.values()))
    scale = jnp.minimum(1.0, largest_norm / (norm + 1e-6))
    return {name: scale * gradient for name, gradient in gradients.items()}


Count = Annotated[Integer, Field(ge=1)]
CountFromZero = Annotated[Integer, Field(ge=0)]
Updates = Annotated[Integer, Field(ge=-1)]
"""In one go; −1 for as many as steps before them."""
Positive = Annotated[Real, Field(gt=0)]
NotNegative = Annotated[Real, Field(ge=0)]
Share = Annotated[Real, Field(ge=0, le=1)]
Widths = Annotated[TupleOf[Count], Field(min_length=1)]
"""Of hidden layers, such as [256, 256]."""


class PolicyKwargs(StrictModel):
    net_arch: Widths | None = None


class AgentSettings(StrictModel):
    """Hyperparameters, with the names of Stable-Baselines3 and of its `policy_kwargs`."""

    usual_widths: ClassVar[tuple[int, ...]]
    policy_kwargs: PolicyKwargs = PolicyKwargs()

    @property
    def net_arch(self) -> tuple[int, ...]:
        """The widths of the hidden layers of each network."""
        return self.policy_kwargs.net_arch or self.usual_widths
