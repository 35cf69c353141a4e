"""`OfflinePolicy`: a trained network in NumPy, and its .npz file. It needs no PyTorch.

    h_0 = o,  h_i = max(0, W_i h_{i−1} + b_i),  a = (1 + tanh(W_n h_{n−1} + b_n)) / 2

The file holds `W0`, `b0`, `W1`, … in order, and `about`, a JSON text. Reading it runs no code.
"""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError, PolicyError, SMEError
from sme_registry.io import parse_json, to_json, write_atomically

Layer = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]

KIND = "sme-offline-policy"
_MAX_LAYERS = 64
_MAX_BYTES = 2**28


@dataclass(frozen=True, eq=False)
class OfflinePolicy:
    """A function from observations `[B, O]` to actions `[B, A]` in [0, 1]; deterministic.

    Attributes:
      layers: `(W [out, in], b [out])` float32, first to last.
      about: what it was trained on and how, plain JSON data; "algorithm" names it in reports.
    """

    layers: Sequence[Layer]
    about: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for layer in self.layers:
            for array in layer:
                array.setflags(write=False)

    @property
    def __name__(self) -> str:
        """The algorithm, as reports call it."""
        return str(self.about.get("algorithm", "policy"))

    @property
    def observation_dim(self) -> int:
        """O, entries of an observation."""
        return int(self.layers[0][0].shape[1])

    @property
    def action_dim(self) -> int:
        """A, entries of an action."""
        return int(self.layers[-1][0].shape[0])

    def __call__(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Actions `[B, A]` float32 in [0, 1] for observations `[B, O]`."""
        x = np.asarray(observations, dtype=np.float32)
        if x.ndim != 2 or x.shape[1] != self.observation_dim:
            raise PolicyError(
                f"observations of shape {x.shape}: must be [B, {self.observation_dim}]. Evaluate "
                "the policy on the task it was trained for."
            )
        *_, x = x, *self.hidden(x)
        W, b = self.layers[-1]
        u: npt.NDArray[np.float32] = np.tanh(x @ W.T + b)
        u += 1.0
        u *= 0.5
        return u

    def hidden(self, observations: npt.NDArray[np.float32]) -> Iterator[npt.NDArray[np.float32]]:
        """The outputs `[B, H]` of each hidden layer."""
        x = observations
        for W, b in self.layers[:-1]:
            x = x @ W.T
            x += b
            np.maximum(x, 0.0, out=x)
            yield x

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the file completely or not at all; equal policies give equal bytes."""
        if not os.fspath(path).endswith(".npz"):
            raise OptionError(f"path={os.fspath(path)!r}: must end in .npz.")
        arrays = {
            f"{name}{index}": array
            for index, layer in enumerate(self.layers)
            for name, array in zip("Wb", layer, strict=True)
        }
        about = np.frombuffer(to_json({"kind": KIND, **self.about}).encode(), dtype=np.uint8)
        content = io.BytesIO()
        np.savez(content, about=about, **arrays)  # type: ignore[arg-type]
        return write_atomically(path, content.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> OfflinePolicy:
        """Read a file that `save` wrote."""
        problem = f"{os.fspath(path)}: not a policy that `sme offline train` wrote"
        try:
            if os.path.getsize(path) > _MAX_BYTES:
                raise PolicyError(f"{problem}: larger than {_MAX_BYTES // 2**20} MiB.")
            with zipfile.ZipFile(path) as members:
                unpacked = sum(member.file_size for member in members.infolist())
            if unpacked > _MAX_BYTES:
                raise PolicyError(f"{problem}: larger than {_MAX_BYTES // 2**20} MiB unpacked.")
            with np.load(path, allow_pickle=False) as stored:
                about = parse_json(stored["about"].tobytes())
                count = sum(name.startswith("W") for name in stored.files)
                layers = [(stored[f"W{i}"], stored[f"b{i}"]) for i in range(count)]
        except FileNotFoundError:
            raise PolicyError(
                f"{os.fspath(path)} does not exist. Give the path of a policy (.npz)."
            ) from None
        except PolicyError:
            raise
        except (OSError, zipfile.BadZipFile, KeyError, ValueError, EOFError, SMEError) as error:
            raise PolicyError(f"{problem}: {type(error).__name__}: {error}.") from None
        if not isinstance(about, dict) or about.pop("kind", None) != KIND:
            raise PolicyError(f"{problem}: its `about` does not name its kind.")
        _check_layers(layers, problem)
        return cls(layers, about)


def _check_layers(layers: Sequence[Layer], problem: str) -> None:
    if not 1 <= len(layers) <= _MAX_LAYERS:
        raise PolicyError(f"{problem}: it has {len(layers)} layers.")
    width = None
    for index, (W, b) in enumerate(layers):
        fits = W.ndim == 2 and W.size > 0 and b.shape == W.shape[:1]
        if not fits or (width is not None and W.shape[1] != width):
            raise PolicyError(f"{problem}: layer {index} has shapes {W.shape} and {b.shape}.")
        if W.dtype != np.float32 or b.dtype != np.float32:
            raise PolicyError(f"{problem}: layer {index} is {W.dtype} and {b.dtype}, not float32.")
        if not (np.isfinite(W).all() and np.isfinite(b).all()):
            raise PolicyError(f"{problem}: layer {index} has entries that are not finite.")
        width = W.shape[0]
