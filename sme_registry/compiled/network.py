"""`network`: a function of layers beside π*, such as limits and mixings, ready to call.

By machine code where Numba is installed, else by NumPy. As in the step, the sums of a lane run in
an order that does not depend on the batch, so that a batch equals its singles bit for bit.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from sme_registry.compiled.engine import Backend, chosen_backend
from sme_registry.compiled.notice import compiling
from sme_registry.task.draw import Array, Layer
from sme_registry.task.task import through

Network: TypeAlias = Callable[[Array], Array]
"""From inputs channel by channel, `[in, B]`, to outputs, fresh `[out, B]`."""


def network(
    layers: Sequence[Layer], *, uniform: bool = True, backend: Backend | None = None
) -> Network:
    """Layers y = Φ(W x + b), ready to call.

    Args:
      layers: one or more.
      uniform: False for y = W x + b, without Φ.
      backend: "numba" or "numpy"; None takes `chosen_backend()`.

    Raises:
      OptionError, MissingDependencyError: see `chosen_backend`.
    """
    if (backend or chosen_backend()) == "numpy":
        return functools.partial(_with_numpy, tuple(layers), uniform)
    with compiling():
        from sme_registry.compiled import kernels
    packed = kernels.pack_layers(layers)
    run = kernels.network.get_overload(kernels.NETWORK)

    def compiled(x: Array) -> Array:
        out = np.empty((len(layers[-1].b), x.shape[1]))
        if out.size:  # the compiled loop goes by blocks of lanes, of which there must be one
            run(packed, np.ascontiguousarray(x), uniform, out)  # another layout would be misread
        return out

    return compiled


def _with_numpy(layers: Sequence[Layer], uniform: bool, x: Array) -> Array:
    rows = np.ascontiguousarray(x.T)[:, None, :]  # each lane a product of its own
    if uniform:
        rows = through(layers, rows)
    else:
        for W, b in layers:
            rows = rows @ W.T + b
    return np.ascontiguousarray(rows[:, 0, :].T)
