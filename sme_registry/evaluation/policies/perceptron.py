"""`Perceptron`: a multilayer perceptron in NumPy, given by its arrays.

x ← f(x W + b)  for each layer

Perceptron([(W0, b0, "tanh"), (W1, b1, "identity")])     # of JAX, or of any other library
Perceptron([(W, b, "identity")])                          # a linear map
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.envs.types import Observation
from sme_registry.errors import PolicyError

Weights = npt.NDArray[np.float32]
Layer = tuple[Weights, Weights, str]


def _silu(x: Weights, out: Weights) -> None:
    out *= 1.0 / (1.0 + np.exp(-x))


def _sigmoid(x: Weights, out: Weights) -> None:
    out[:] = 1.0 / (1.0 + np.exp(-x))


def _relu(x: Weights, out: Weights) -> None:
    np.maximum(x, 0.0, out=out)


def _elu(x: Weights, out: Weights) -> None:
    out[:] = np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))


ACTIVATIONS: dict[str, Callable[..., Any]] = {
    "identity": lambda x, out: None,
    "relu": _relu,
    "tanh": np.tanh,
    "sigmoid": _sigmoid,
    "silu": _silu,
    "elu": _elu,
}


class Perceptron:
    """A function from observations `[B, O]` to actions `[B, A]`; deterministic.

    Attributes:
      layers: `(W [in, out], b [out], activation)` of each layer, copied as float32; the activation
        is one of `ACTIVATIONS`. Flax's and Haiku's kernels have this shape; PyTorch's and
        Equinox's weights are its transpose.
      low: `[A]`, lower bound of the action space. None: the outputs are the actions.
      high: `[A]`, upper bound. Outputs in [−1, 1] are then scaled to the action space.

    Examples:
      >>> from sme_registry.evaluation import Perceptron
      >>> W, b = np.zeros((10, 4)), np.full(4, 0.5)
      >>> policy = Perceptron([(W, b, "identity")])
      >>> policy(np.full((2, 10), 0.5, np.float32)).shape
      (2, 4)
    """

    def __init__(
        self,
        layers: Sequence[tuple[npt.ArrayLike, npt.ArrayLike, str]],
        low: Weights | None = None,
        high: Weights | None = None,
    ) -> None:
        if not layers:
            raise PolicyError("layers: must be at least one (W, b, activation).")
        self.layers: list[Layer] = []
        for index, layer in enumerate(layers):
            width = len(self.layers[-1][1]) if self.layers else None
            self.layers.append(_checked(index, layer, width))
        self.low, self.high = low, high

    @property
    def observation_dim(self) -> int:
        """O, entries of an observation."""
        return len(self.layers[0][0])

    @property
    def action_dim(self) -> int:
        """A, entries of an action."""
        return len(self.layers[-1][1])

    def outputs(self, observations: Observation) -> Iterator[Weights]:
        """The outputs `[B, out]` of each layer, in order; the last are not scaled to actions."""
        x: Weights = np.asarray(observations, np.float32)
        for W, b, activation in self.layers:
            x = x @ W
            x += b
            ACTIVATIONS[activation](x, out=x)
            yield x

    def hidden(self, observations: Observation) -> list[Weights]:
        """The outputs `[B, out]` of each layer but the last."""
        return list(self.outputs(observations))[:-1]

    def __call__(self, observations: Observation) -> Weights:
        """Actions `[B, A]` float32, not clipped."""
        *_, x = self.outputs(observations)
        if self.low is None or self.high is None:
            return x
        return self.low + 0.5 * (x + 1.0) * (self.high - self.low)


def _checked(index: int, layer: Any, width: int | None) -> Layer:
    """A layer as float32 arrays; `width` is that of the layer before, None for the first."""
    where = f"layers[{index}]"
    try:
        weights, bias, activation = layer
        W, b = (np.array(array, np.float32, order="C") for array in (weights, bias))
    except (TypeError, ValueError) as error:
        raise PolicyError(
            f"{where}: must be (W, b, activation), W and b arrays: {error}."
        ) from None
    if activation not in ACTIVATIONS:
        raise PolicyError(
            f"{where}: activation={activation!r:.40}: must be one of {', '.join(ACTIVATIONS)}."
        )
    fits = W.ndim == 2 and W.size > 0 and b.shape == W.shape[1:]
    if not fits or (width is not None and len(W) != width):
        inputs = "in" if width is None else str(width)
        raise PolicyError(
            f"{where}: W has shape {W.shape} and b {b.shape}: must be ({inputs}, out) and (out,). "
            "Transpose the weights of PyTorch or Equinox, W.T."
        )
    if not (np.isfinite(W).all() and np.isfinite(b).all()):
        raise PolicyError(f"{where}: contains NaN or infinity. Give finite numbers.")
    return W, b, activation
