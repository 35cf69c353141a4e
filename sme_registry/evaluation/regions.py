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

A task with distractors (METHOD, section 9; `m` of them) has two kinds of shells: s in a shell with
d uniform in the cube, and s in the cube with d in a shell of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.task import Task
from sme_registry.task.draw import Array, bit_generator, to_uniform

Observations = npt.NDArray[np.float32]

BATCH_NUMBERS = 2**22  # in a batch of observations and actions, 32 MiB as float64
BATCH_ROWS = 8192


def region_name(region: int) -> str:
    return "WD" if region == 0 else f"OOD {region}"


def batch_rows(spec: SMESpec) -> int:
    """How many states are in memory at once; fewer if a state is large."""
    others = len(spec.agents) - 1
    width = spec.state_dim + spec.distractors + spec.action_dim + spec.hidden_width + others
    return max(1, min(BATCH_ROWS, BATCH_NUMBERS // width))


def expansion(s: Array) -> Array:
    """E(s) of states `[B, S]`: `[B]`, −1 at the cube's centre, 0 on its faces, > 0 outside."""
    return np.asarray(2.0 * np.abs(s - 0.5).max(axis=-1) - 1.0)


class States(NamedTuple):
    """A batch of states, and what else an observation of them shows."""

    s: Observations  # `[B, S]`
    d: Array  # `[B, m]` distractors
    time: Array  # `[B]` uniform in (0, 1), from which t/T follows

    def seen(self, task: Task, d: Array | None = None) -> npt.NDArray[Any]:
        """What the task's agent sees of the state, `[B, S + m]`; of `d` in place of its own."""
        return task.seen(self.s, self.d if d is None else d)

    def observation(self, x: npt.NDArray[Any], horizon: int) -> Observations:
        """x `[B, n]`, then t/T in {0, …, T − 1}/T, then r_cum/k = 0: `[B, n + 2]` float32."""
        batch = np.zeros((len(x), x.shape[1] + 2), dtype=np.float32)
        batch[:, :-2] = x
        batch[:, -2] = np.floor(self.time * horizon) / horizon
        return batch


def states(
    protocol: EvaluationProtocol, region: int, spec: SMESpec, rows: int | None = None
) -> Iterator[States]:
    """The states of a region, batch by batch, with distractors uniform in the cube."""
    stream = f"evaluation/{region}"
    points = Points(protocol, region, spec.state_dim, stream)
    times = Uniform(protocol.seed, f"{stream}/time")
    distractors = Uniform(protocol.seed, f"{stream}/distractors")
    rows = batch_rows(spec) if rows is None else rows
    for first in range(0, protocol.states_per_region, rows):
        count = min(rows, protocol.states_per_region - first)
        yield States(points(count), distractors(count, spec.distractors), times(count))


class Uniform:
    """Uniform numbers in (0, 1) from a named stream, which each call advances."""

    def __init__(self, seed: int | str, name: str) -> None:
        self._bits = bit_generator(seed, name)

    def __call__(self, *shape: int) -> Array:
        return to_uniform(self._bits.random_raw(int(np.prod(shape)))).reshape(shape)


class Points:
    """Points of a region, uniform by volume: of the cube or of a shell in any dimension."""

    def __init__(self, protocol: EvaluationProtocol, region: int, dim: int, stream: str) -> None:
        self._dim = dim
        self._coordinates = Uniform(protocol.seed, f"{stream}/coordinates")
        self._shell = _Shell(protocol, region, dim, stream) if region > 0 else None

    def __call__(self, count: int) -> Observations:
        u = self._coordinates(count, self._dim)
        return u.astype(np.float32) if self._shell is None else self._shell.points(u)


class _Shell:
    """Samples the shell between two cubes, with its own streams for radius and face."""

    def __init__(self, protocol: EvaluationProtocol, region: int, dim: int, stream: str) -> None:
        low, high = protocol.edges[region]
        self._dim = dim
        self._outer = (1.0 + high) / 2.0
        self._inner_share = ((1.0 + low) / (1.0 + high)) ** dim
        self._nearest = np.nextafter(_last_within(low), np.float32(np.inf))
        self._furthest = _last_within(high)
        if not self._nearest <= self._furthest:
            raise OptionError(
                f"epsilons: no float32 observation lies in the shell ({low!r}, {high!r}]. "
                "Give levels further apart."
            )
        self._radius = Uniform(protocol.seed, f"{stream}/radius")
        self._face = Uniform(protocol.seed, f"{stream}/face")

    def points(self, u: Array) -> Observations:
        """Points `[B, dim]` from uniform numbers `[B, dim]` for their coordinates."""
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
