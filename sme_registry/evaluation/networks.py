"""Policies as networks in NumPy: `Perceptron`, given by its arrays; `OfflinePolicy`, an .npz file.

    Perceptron       x ← f(x W + b)  for each layer
    OfflinePolicy    h_0 = o,  h_i = max(0, W_i h_{i−1} + b_i),  a = (1 + tanh(W_n h_{n−1} + b_n))/2
    OfflineCritic    h_0 = (o, 2a − 1), likewise,                Q = W_n h_{n−1} + b_n

An .npz file holds `W0`, `b0`, `W1`, … in order, and `about`, a JSON text. Reading it runs no code.
"""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError, PolicyError, SMEError
from sme_registry.io import choice, parse_json, read_regular, to_json, write_atomically
from sme_registry.task.task import Observation

Weights = npt.NDArray[np.float32]
Layer = tuple[Weights, Weights, str]
OfflineLayer = tuple[Weights, Weights]

_MAX_LAYERS = 64
_MAX_BYTES = 2**28


ACTIVATIONS: dict[str, Callable[[Any], Any]] = {
    "identity": lambda x: x,
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "sigmoid": lambda x: 1.0 / (1.0 + np.exp(-x)),
    "silu": lambda x: x * (1.0 / (1.0 + np.exp(-x))),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
}


def _check_layer(where: str, W: Weights, b: Weights, inputs: int | None) -> None:
    """W `[in, out]` and b `[out]` fit each other and, but for the first, the layer before."""
    fits = W.ndim == 2 and W.size > 0 and b.shape == W.shape[1:]
    if not fits or inputs not in (None, len(W)):
        raise PolicyError(
            f"{where}: W has shape {W.shape} and b {b.shape}: must be ({inputs or 'in'}, out) and "
            "(out,). Transpose the weights of PyTorch or Equinox, W.T."
        )
    if not (np.isfinite(W).all() and np.isfinite(b).all()):
        raise PolicyError(f"{where}: contains NaN or infinity. Give finite numbers.")


class Perceptron:
    """A function from observations `[B, O]` to actions `[B, A]`; deterministic.

    `layers` are `(W [in, out], b [out], activation)`, copied as float32; the activation is one of
    `ACTIVATIONS`. Flax's and Haiku's kernels have this shape; PyTorch's and Equinox's weights are
    its transpose. With `low` and `high` `[A]`, outputs in [−1, 1] are scaled to these bounds.

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
            where = f"layers[{index}]"
            try:
                weights, bias, activation = layer
                W, b = (np.array(array, np.float32, order="C") for array in (weights, bias))
            except (TypeError, ValueError) as error:
                raise PolicyError(
                    f"{where}: must be (W, b, activation), W and b arrays: {error}."
                ) from None
            choice(f"{where}: activation", activation, ACTIVATIONS, error=PolicyError)
            _check_layer(where, W, b, len(self.layers[-1][1]) if self.layers else None)
            self.layers.append((W, b, activation))
        self.low, self.high = low, high

    @property
    def observation_dim(self) -> int:
        return len(self.layers[0][0])

    @property
    def action_dim(self) -> int:
        return len(self.layers[-1][1])

    def outputs(self, observations: Observation) -> Iterator[Weights]:
        """The outputs `[B, out]` of each layer, in order; the last are not scaled to actions."""
        x: Weights = np.asarray(observations, np.float32)
        for W, b, activation in self.layers:
            x = x @ W
            x += b
            x = ACTIVATIONS[activation](x)
            yield x

    def hidden(self, observations: Observation) -> list[Weights]:
        return list(self.outputs(observations))[:-1]

    def __call__(self, observations: Observation) -> Weights:
        """Actions `[B, A]` float32, not clipped."""
        *_, x = self.outputs(observations)
        if self.low is None or self.high is None:
            return x
        return self.low + 0.5 * (x + 1.0) * (self.high - self.low)


class OfflinePolicy(Perceptron):
    """A perceptron from observations `[B, O]` to actions `[B, A]` in [0, 1], as an .npz file.

    `layers` are `(W [out, in], b [out])`, first to last, copied as float32. `about` says what it
    was trained on and how, in plain JSON data; "algorithm" names it in reports.

    Examples:
      >>> from sme_registry.datasets import OfflinePolicy
      >>> policy = OfflinePolicy([(np.zeros((4, 10), np.float32), np.zeros(4, np.float32))])
      >>> policy(np.ones((1, 10), np.float32)).tolist()
      [[0.5, 0.5, 0.5, 0.5]]
    """

    kind: ClassVar[str] = "sme-offline-policy"
    action_range: ClassVar[str] = "unit"
    _output: ClassVar[str] = "tanh"

    def __init__(
        self, layers: Sequence[OfflineLayer], about: Mapping[str, Any] = MappingProxyType({})
    ) -> None:
        if not 1 <= len(layers) <= _MAX_LAYERS:
            raise PolicyError(f"layers: must be 1 to {_MAX_LAYERS}, not {len(layers)}.")
        self.layers = []
        activations = [*["relu"] * (len(layers) - 1), self._output]
        for index, (layer, activation) in enumerate(zip(layers, activations, strict=True)):
            W, b = (np.array(array, np.float32, order="C") for array in layer)
            width = len(self.layers[-1][1]) if self.layers else None
            _check_layer(f"layers[{index}], transposed", W.T, b, width)
            W.setflags(write=False)
            b.setflags(write=False)
            # A transposed view: a copy would multiply in another order.
            self.layers.append((W.T, b, activation))
        self.low = self.high = None
        if self._output == "tanh":
            b = self.layers[-1][1]
            self.low, self.high = np.zeros_like(b), np.ones_like(b)
        self.about = about

    @property
    def __name__(self) -> str:
        return str(self.about.get("algorithm", "policy"))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the file completely or not at all; equal policies give equal bytes."""
        if not os.fspath(path).endswith(".npz"):
            raise OptionError(f"path={os.fspath(path)!r}: must end in .npz.")
        arrays: dict[str, Any] = {}
        for index, (W, b, _) in enumerate(self.layers):
            arrays |= {f"W{index}": W.T, f"b{index}": b}
        about = np.frombuffer(to_json({"kind": self.kind, **self.about}).encode(), dtype=np.uint8)
        content = io.BytesIO()
        np.savez(content, about=about, **arrays)
        return write_atomically(path, content.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `save` wrote."""
        try:
            return cls._read(path)
        except FileNotFoundError:
            raise PolicyError(
                f"{os.fspath(path)} does not exist. Give the path of a policy (.npz)."
            ) from None
        except (OSError, zipfile.BadZipFile, KeyError, ValueError, EOFError, SMEError) as error:
            raise PolicyError(
                f"{os.fspath(path)}: not a policy that `sme train --data` wrote: {error}"
            ) from None

    @classmethod
    def _read(cls, path: str | os.PathLike[str]) -> Self:
        data = read_regular(path, _MAX_BYTES, links=True)
        with zipfile.ZipFile(io.BytesIO(data)) as members:
            unpacked = sum(member.file_size for member in members.infolist())
        if unpacked > _MAX_BYTES:
            raise PolicyError(f"larger than {_MAX_BYTES // 2**20} MiB.")
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            about = parse_json(stored["about"].tobytes())
            count = sum(name.startswith("W") for name in stored.files)
            layers = [(stored[f"W{i}"], stored[f"b{i}"]) for i in range(count)]
        if not isinstance(about, dict) or about.pop("kind", None) != cls.kind:
            raise PolicyError("its `about` does not name its kind.")
        for index, (W, b) in enumerate(layers):
            if W.dtype != np.float32 or b.dtype != np.float32:
                raise PolicyError(f"layer {index}: is {W.dtype} and {b.dtype}, not float32.")
        return cls(layers, about)


class OfflineCritic(OfflinePolicy):
    """A critic of IQL: (o, 2a − 1) to Q `[B, 1]`; `about` has the discount of its targets."""

    kind = "sme-offline-critic"
    _output = "identity"
