"""From a spec's seed to the numbers of a task: W, b, and the layers of each optimal policy.

Source: METHOD, section 1. `S` state_dim, `A` action_dim, `L` complexity, `H` hidden_width.

stream(seed, name) = Philox4x64-10 keyed by the first 128 bits of SHA-256("sme-v1/" seed "/" name).
A stream depends on its seed and its name alone, so a new layer or agent changes no other stream.
NumPy guarantees the raw bits of a bit generator, but not the numbers of its `Generator`.
"""

from __future__ import annotations

import hashlib
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from sme_registry.spec import SMESpec
from sme_registry.spec.catalogue import DYNAMICS_VERSION

Array = npt.NDArray[np.float64]
Bits = npt.NDArray[np.uint64]


def bit_generator(seed: int | str, name: str) -> np.random.Philox:
    label = f"sme-v{DYNAMICS_VERSION}/{seed}/{name}"
    key = int.from_bytes(hashlib.sha256(label.encode()).digest()[:16], "little")
    return np.random.Philox(key=key)


def raw_bits(seed: int | str, name: str, count: int) -> Bits:
    return bit_generator(seed, name).random_raw(count)


def to_uniform(bits: Bits) -> Array:
    """64-bit words as numbers in (0, 1), exact and symmetric about ½: (⌊bits / 2¹²⌋ + ½) · 2⁻⁵²."""
    return ((bits >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52


def uniform(seed: int | str, name: str, count: int) -> Array:
    return to_uniform(raw_bits(seed, name, count))


def gaussian(seed: int | str, name: str, count: int) -> Array:
    return np.asarray(ndtri(uniform(seed, name, count)))


# SplitMix64's constants.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST_MIX = np.uint64(0xBF58476D1CE4E5B9)
SECOND_MIX = np.uint64(0x94D049BB133111EB)


def counted(key: Bits, first: Bits, count: int) -> Array:
    """Uniform numbers `[n, count]` in (0, 1) of counter-based streams, from place `first` `[n]` on.

    The word at place n, from 1, is SplitMix64's n-th from the seed mix(`key`): an environment's
    only state is the place. Source: Steele, Lea & Flood (2014), Fast splittable pseudorandom number
    generators.
    """
    with np.errstate(over="ignore"):  # arithmetic is modulo 2⁶⁴
        places = first[:, None] + np.arange(count, dtype=np.uint64)
        start = mixed_bits(key)[:, None]
        return to_uniform(mixed_bits(np.add(start, places * GOLDEN, dtype=np.uint64)))


def mixed_bits(z: Bits) -> Bits:
    """SplitMix64's bijection of 64-bit words; a changed bit changes half of all bits."""
    z = (z ^ (z >> np.uint64(30))) * FIRST_MIX
    z = (z ^ (z >> np.uint64(27))) * SECOND_MIX
    return z ^ (z >> np.uint64(31))


def normal_of_steps(key: Bits, name: str, steps: Array, width: int) -> Array:
    """Standard normal numbers `[n, width]`, of float32, of streams with a name.

    They depend on the name, each environment's key, and how many `steps` `[n]` it has drawn for.
    """
    word = int.from_bytes(hashlib.sha256(f"sme-v1/{name}".encode()).digest()[:8], "little")
    first = steps.astype(np.uint64) * np.uint64(width) + np.uint64(1)
    numbers = counted(mixed_bits(key ^ np.uint64(word)), first, width)
    return np.asarray(ndtri(numbers).astype(np.float32).astype(np.float64))


GRID_BITS = 29  # 29 bits of W times 24 of a float32 action fit the 53 of a float64


class Layer(NamedTuple):
    """One uniform layer y = Φ(W x + b): `W [out, in]`, `b [out]`."""

    W: Array
    b: Array


def transition_matrix(spec: SMESpec) -> Array:
    """W `[A, S]`: U(0,1) entries, each row divided by its sum, on the grid 2⁻²⁹."""
    return _mixing_weights(spec.seed, "transition/W", spec.action_dim, spec.state_dim)


def _mixing_weights(seed: int | str, name: str, rows: int, columns: int) -> Array:
    """U(0,1) entries `[rows, columns]`, each row divided by its sum, on the grid 2⁻²⁹, exactly.

    A row's difference from 1 is added, one grid step each, to the entries that lost most.
    """
    bits = raw_bits(seed, name, rows * columns).reshape(rows, columns)
    # Odd 32-bit numbers, the mid-points of 2³¹ bins. With at most 2²⁰ of them in a row, every
    # product and sum below is an integer under 2⁶³.
    weights = (bits >> np.uint64(33)) * np.uint64(2) + np.uint64(1)
    scaled = weights << np.uint64(GRID_BITS)
    totals = weights.sum(axis=1, keepdims=True, dtype=np.uint64)
    units, lost = np.divmod(scaled, totals)
    missing = np.uint64(2**GRID_BITS) - units.sum(axis=1, dtype=np.uint64)
    most_lost_first = np.argsort(lost, axis=1, kind="stable")[:, ::-1]
    for row, count in enumerate(missing):
        units[row, most_lost_first[row, : int(count)]] += np.uint64(1)
    return units.astype(np.float64) * 2.0**-GRID_BITS


def transition_offset(spec: SMESpec) -> Array:
    return uniform(spec.seed, "transition/b", spec.state_dim)


def optimal_policies(spec: SMESpec, stream: str = "policy") -> tuple[tuple[Layer, ...], ...]:
    """Each agent's layers of π*; another `stream` gives independent policies of the same kind."""
    return tuple(
        _optimal_policy(spec, f"{stream}/{index}", observed, agent.action_dim)
        for index, (agent, observed) in enumerate(
            zip(spec.agents, spec.observed_channels, strict=True)
        )
    )


def limiting_network(spec: SMESpec) -> tuple[Layer, ...]:
    """The layers of v, of which the action limits are 1 − 2τ v(s); none without `safety`."""
    if spec.safety is None:
        return ()
    everything = tuple(range(spec.state_dim))
    return _network(spec, "safety", everything, spec.action_dim)


def potential_layers(spec: SMESpec) -> tuple[Layer, ...]:
    """The layer of φ(s) = Φ(√12 wᵀ (s − ½)), w uniform on the sphere; none without `shaping`."""
    if spec.shaping is None:
        return ()
    W = math.sqrt(12.0) * _haar(spec.seed, "shaping", spec.state_dim, 1).T
    return (Layer(W, -0.5 * W.sum(axis=1)),)


def distractor_transition(spec: SMESpec) -> tuple[Array, Array] | None:
    """W `[A, m]` and b `[m]` of the distractors' own transition; None where they have none."""
    if spec.dynamics in (None, "noise"):
        return None
    m = spec.distractors
    W = _mixing_weights(spec.seed, "observation/W", spec.action_dim, m)
    return W, uniform(spec.seed, "observation/b", m)


def mixing_layers(spec: SMESpec) -> tuple[Layer, ...]:
    """The layers of the map from state and distractors `[S + m]` to what the agent sees; or none.

    An orthogonal mixing is x ↦ W x + b, with W = Q/c, b = ½ − W ½ and the least c that keeps the
    cube's image in the cube; a nonlinear one has uniform layers.
    """
    if spec.observation is None or spec.mixing == "none":
        return ()
    n = spec.state_dim + spec.distractors
    if spec.mixing == "orthogonal":
        Q = _haar(spec.seed, "observation/mixing/0", n, n)
        W = Q / np.abs(Q).sum(axis=1).max()
        return (Layer(W, 0.5 - 0.5 * W.sum(axis=1)),)
    depth = spec.observation.mixing_depth or 1
    matrices = [
        math.sqrt(12.0) * _haar(spec.seed, f"observation/mixing/{i}", n, n) for i in range(depth)
    ]
    return tuple(Layer(W, -0.5 * W.sum(axis=1)) for W in matrices)


def _optimal_policy(
    spec: SMESpec, stream: str, observed: tuple[int, ...], action_dim: int
) -> tuple[Layer, ...]:
    (W, b), *others = _network(spec, stream, observed, action_dim)
    if spec.rotation:
        W = W @ _rotation(spec, f"{stream}/rotation", len(observed))
        b = -0.5 * W.sum(axis=1)
    return (Layer(W, b), *others)


def _network(
    spec: SMESpec, stream: str, observed: tuple[int, ...], action_dim: int
) -> tuple[Layer, ...]:
    """A Deep Uniform Network of L layers: in → H → … → H → out; in → out where L = 1."""
    inner = spec.complexity - 1
    widths = [len(observed), *[spec.hidden_width] * inner, action_dim]
    names = [f"{stream}/inner/{index}" for index in range(inner)] + [f"{stream}/output"]
    matrices = [
        _uniform_matrix(spec, name, inputs, outputs)
        for name, inputs, outputs in zip(names, widths[:-1], widths[1:], strict=True)
    ]
    return tuple(Layer(W, -0.5 * W.sum(axis=1)) for W in matrices)


def _uniform_matrix(spec: SMESpec, name: str, inputs: int, outputs: int) -> Array:
    """W = √12 × semi-orthogonal; with b = −½ W 1, Φ(W x + b) of uniform x is near uniform."""
    tall = _haar(spec.seed, name, max(inputs, outputs), min(inputs, outputs))
    semi_orthogonal = tall if outputs >= inputs else tall.T
    if spec.policy_init == "unit_variance" and outputs > inputs:
        semi_orthogonal /= np.linalg.norm(semi_orthogonal, axis=1, keepdims=True)
    return np.ascontiguousarray(math.sqrt(12.0) * semi_orthogonal)


def _rotation(spec: SMESpec, name: str, channels: int) -> Array:
    """R(θ) = B · diag(rot θ, …, rot θ[, 1]) · Bᵀ `[S, S]`, with B Haar orthogonal.

    METHOD, section 6: π*_θ(s) = π*(½ + R (s − ½)) is the policy whose first layer has W R in place
    of W, as b is −½ W 1.
    """
    B = _haar(spec.seed, name, channels, channels)
    u, v = B[:, 0 : channels - 1 : 2], B[:, 1:channels:2]  # the two axes of each plane
    cos, sin = math.cos(spec.rotation), math.sin(spec.rotation)
    fixed = B[:, 2 * (channels // 2) :]
    turned = np.concatenate([u * cos + v * sin, v * cos - u * sin, fixed], axis=1)
    return np.asarray(turned @ np.concatenate([u, v, fixed], axis=1).T)


def _haar(seed: int | str, name: str, rows: int, columns: int) -> Array:
    """Haar-distributed orthonormal columns `[rows, columns]`: QR, R's diagonal made positive."""
    normal = gaussian(seed, name, rows * columns).reshape(rows, columns)
    Q, R = np.linalg.qr(normal)
    return Q * np.where(np.diag(R) < 0, -1.0, 1.0)
