"""Named, independent random streams of one seed, converted from raw bits.

stream(seed, name) = Philox4x64-10 keyed by the first 128 bits of SHA-256("sme-v1/" seed "/" name).
A stream depends on its seed and its name alone, so a new layer or agent changes no other stream.
NumPy guarantees the raw bits of a bit generator, but not the numbers of its `Generator`.
"""

from __future__ import annotations

import hashlib

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

DYNAMICS_VERSION = 1


def bit_generator(seed: int | str, name: str) -> np.random.Philox:
    label = f"sme-v{DYNAMICS_VERSION}/{seed}/{name}"
    key = int.from_bytes(hashlib.sha256(label.encode()).digest()[:16], "little")
    return np.random.Philox(key=key)


def raw_bits(seed: int | str, name: str, count: int) -> npt.NDArray[np.uint64]:
    """The first `count` 64-bit words of a stream."""
    return bit_generator(seed, name).random_raw(count)


def to_uniform(bits: npt.NDArray[np.uint64]) -> npt.NDArray[np.float64]:
    """64-bit words as uniform numbers in the open interval (0, 1), of the same shape.

    u = (⌊bits / 2¹²⌋ + ½) · 2⁻⁵², which is exact, symmetric about ½ and never 0 or 1.
    """
    return ((bits >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52


def uniform(seed: int | str, name: str, count: int) -> npt.NDArray[np.float64]:
    return to_uniform(raw_bits(seed, name, count))


def gaussian(seed: int | str, name: str, count: int) -> npt.NDArray[np.float64]:
    """Standard normal numbers of a stream, `[count]`: Φ⁻¹ of its uniform numbers."""
    return np.asarray(ndtri(uniform(seed, name, count)))


# SplitMix64's constants.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST_MIX = np.uint64(0xBF58476D1CE4E5B9)
SECOND_MIX = np.uint64(0x94D049BB133111EB)


def counted(
    key: npt.NDArray[np.uint64], first: npt.NDArray[np.uint64], count: int
) -> npt.NDArray[np.float64]:
    """Uniform numbers `[n, count]` in (0, 1) of counter-based streams, for environments.

    Of each stream from place `first` `[n]` on, 1 at the beginning: the word at place n is
    SplitMix64's n-th from the seed mix(`key`). Any place can be computed alone, by machine code as
    well, so that an environment's only state is the place.
    Source: Steele, Lea & Flood (2014), Fast splittable pseudorandom number generators.
    """
    with np.errstate(over="ignore"):  # arithmetic is modulo 2⁶⁴
        places = first[:, None] + np.arange(count, dtype=np.uint64)
        start = mixed_bits(key)[:, None]
        return to_uniform(mixed_bits(np.add(start, places * GOLDEN, dtype=np.uint64)))


def mixed_bits(z: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """SplitMix64's bijection of 64-bit words; a changed bit changes half of all bits."""
    z = (z ^ (z >> np.uint64(30))) * FIRST_MIX
    z = (z ^ (z >> np.uint64(27))) * SECOND_MIX
    return z ^ (z >> np.uint64(31))
