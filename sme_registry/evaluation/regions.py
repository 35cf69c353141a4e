"""The regions of a protocol and the observations drawn from them, exactly and without rejection.

Source: METHOD, section 3. `B` batch, `S` state_dim, lo and hi = (1 + ε)/2 of a shell's two faces.

    E(s) = 2 ‖s − ½‖_∞ − 1                              expansion level of a state
    WD:     s ~ U([0, 1]^S)                              E ≤ 0
    shell:  R = hi ((lo/hi)^S + u (1 − (lo/hi)^S))^(1/S),  u ~ U(0, 1)
            x ~ U(−R, R)^S, one coordinate of it, drawn at random, set to ±R;  s = ½ + x

A policy receives float32 observations, so the states lie on the float32 grid: the optimal action is
computed for exactly the state that the policy received. Rounding must not move a state across a
face, so the face at R is clamped between the first grid value outside the inner cube and the last
one inside the outer cube.

Each region has named streams of the protocol's seed and reads a fixed number of words per state
from each. Its states therefore depend neither on other regions nor on the batch size.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.task.draw import Array
from sme_registry.task.streams import bit_generator, to_uniform

Observations = npt.NDArray[np.float32]

BATCH_NUMBERS = 2**22  # in a batch of observations and actions, 32 MiB as float64
BATCH_ROWS = 8192


def region_name(region: int) -> str:
    """The name of a region: `WD`, `OOD 1`, `OOD 2`, …"""
    return "WD" if region == 0 else f"OOD {region}"


def batch_rows(spec: SMESpec) -> int:
    """How many states are in memory at once; fewer if a state is large."""
    others = len(spec.team.agents) - 1 if spec.team is not None else 0
    width = spec.state_dim + spec.action_dim + spec.hidden_width + others
    return max(1, min(BATCH_ROWS, BATCH_NUMBERS // width))


def expansion(s: Array) -> Array:
    """E(s) of states `[B, S]`: `[B]`, −1 at the cube's centre, 0 on its faces, > 0 outside."""
    return np.asarray(2.0 * np.abs(s - 0.5).max(axis=-1) - 1.0)


def observations(
    protocol: EvaluationProtocol, region: int, spec: SMESpec, rows: int | None = None
) -> Iterator[Observations]:
    """The observations of a region, batch by batch.

    Args:
      protocol: the protocol.
      region: 0 for WD, m for OOD m.
      spec: the task, for state_dim and horizon.
      rows: states per batch; None takes `batch_rows`. The states do not depend on it.

    Yields:
      `[B, S + 2]` float32: the state, then t/T in {0, …, T − 1}/T, then r_cum/k = 0.

    Raises:
      OptionError: no float32 number lies between the faces of this shell.
    """
    S, T = spec.state_dim, spec.horizon
    stream = f"evaluation/{region}"
    coordinates = Uniform(protocol.seed, f"{stream}/coordinates")
    times = Uniform(protocol.seed, f"{stream}/time")
    shell = _Shell(protocol, region, S) if region > 0 else None

    rows = batch_rows(spec) if rows is None else rows
    for first in range(0, protocol.states_per_region, rows):
        count = min(rows, protocol.states_per_region - first)
        batch = np.zeros((count, S + 2), dtype=np.float32)
        u = coordinates(count, S)
        batch[:, :S] = u if shell is None else shell.states(u)
        batch[:, S] = np.floor(times(count) * T) / T
        yield batch


class Uniform:
    """Uniform numbers in (0, 1) from a named stream, which each call advances."""

    def __init__(self, seed: int | str, name: str) -> None:
        self._bits = bit_generator(seed, name)

    def __call__(self, *shape: int) -> Array:
        """The stream's next numbers, of this shape."""
        return to_uniform(self._bits.random_raw(int(np.prod(shape)))).reshape(shape)


class _Shell:
    """Samples the shell between two cubes, with its own streams for radius and face."""

    def __init__(self, protocol: EvaluationProtocol, region: int, state_dim: int) -> None:
        low, high = protocol.edges[region]
        self._dim = state_dim
        self._outer = (1.0 + high) / 2.0
        self._inner_share = ((1.0 + low) / (1.0 + high)) ** state_dim
        self._nearest = np.nextafter(_last_within(low), np.float32(np.inf))
        self._furthest = _last_within(high)
        if not self._nearest <= self._furthest:
            raise OptionError(
                f"epsilons: no float32 observation lies in the shell ({low!r}, {high!r}]. "
                "Give levels further apart."
            )
        self._radius = Uniform(protocol.seed, f"evaluation/{region}/radius")
        self._face = Uniform(protocol.seed, f"evaluation/{region}/face")

    def states(self, u: Array) -> Observations:
        """States `[B, S]` from uniform numbers `[B, S]` for their coordinates."""
        count = len(u)
        volume = self._inner_share + self._radius(count) * (1.0 - self._inner_share)
        R = self._outer * volume ** (1.0 / self._dim)
        s = (0.5 + R[:, None] * (2.0 * u - 1.0)).astype(np.float32)

        upper = np.clip((0.5 + R).astype(np.float32), self._nearest, self._furthest)
        lower = np.float32(1.0) - upper  # exact, so that both faces are at the same E
        side = (self._face(count) * (2 * self._dim)).astype(np.int64)
        s[np.arange(count), side // 2] = np.where(side % 2, upper, lower)
        return np.clip(s, lower[:, None], upper[:, None], out=s)


def _last_within(level: float) -> np.float32:
    """The largest float32 coordinate x with E = 2 (x − ½) − 1 ≤ level."""

    def within(x: np.float32) -> bool:
        return 2.0 * (float(x) - 0.5) - 1.0 <= level

    with np.errstate(over="ignore"):
        x = np.float32(1.0 + level / 2.0)
        while not within(x):
            x = np.nextafter(x, np.float32(-np.inf))
        while within(after := np.nextafter(x, np.float32(np.inf))) and np.isfinite(after):
            x = after
    return x
