"""Sketches: 68 numbers of a policy that tell copies of it from other policies.

Of half h of the probe states (0 in the training cube, 1 outside), with the error a − a* and K = 32
features ψ_k(x) = √2 cos(w_k·x + b_k), each with a random mixture g_k of the action channels:

    m_hk   = mean (a − a*)·g_k ψ_k(x)                         moments of the error
    ν_h    = mean over k of the variance of m_hk              error of sampling the states
    u_h    = min(rms of a − a*, rms of a − E a)               its error (at least 1e-5), or its
                                                              variation if smaller
    alike if mean_k (m_hk − m'_hk)² ≤ ALIKE min(u_h, u'_h)² + 2 (ν_h + ν'_h)
             and u_h, u'_h differ by at most a tenth, for both h

w, b and g are public, but the states of two submissions differ and are unknown until their policies
are fixed, so no policy can be altered in the states of the sketch alone.
`leaderboard.scoring.behaviour` computes sketches and has the measurements behind `ALIKE`.
"""

from __future__ import annotations

import base64

import numpy as np
import numpy.typing as npt

FEATURES = 32
LENGTH = 2 * (FEATURES + 2)
TEXT = r"^([A-Za-z0-9+/]{363}=)?$"
"""A sketch in base64, or nothing."""

ALIKE = 0.001
SAME_SCALE = 0.9

_Array = npt.NDArray[np.float64]
_MOMENTS = 2 * FEATURES


def to_text(moments: _Array, noise: _Array, scale: _Array) -> str:
    """The base64 text of a sketch, of little-endian float32 numbers.

    Args:
      moments: `[2, K]` m, dimensionless like actions.
      noise: `[2]` ν.
      scale: `[2]` u, above 0.
    """
    numbers = np.concatenate([moments.ravel(), noise, scale]).astype("<f4")
    return base64.b64encode(numbers.tobytes()).decode()


def to_bytes(text: str) -> bytes:
    """The float32 numbers of a sketch's text, 272 bytes."""
    return base64.b64decode(text)


def numbers(data: bytes | bytearray) -> npt.NDArray[np.float32]:
    """`[N, 68]` the numbers of N sketches."""
    return np.frombuffer(data, "<f4").reshape(-1, LENGTH)


def alike(one: npt.NDArray[np.float32], others: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Which policies act like one policy on the same instance.

    Args:
      one: `[68]` its sketch; numbers that are not finite are like no others.
      others: `[N, 68]` sketches.

    Returns:
      Their indices, increasing.
    """
    with np.errstate(all="ignore"):
        ratio = others[:, -2:] / one[-2:]
        near = np.flatnonzero(((ratio >= SAME_SCALE) & (ratio <= 1 / SAME_SCALE)).all(axis=1))
        x, y = one.astype(np.float64), others[near].astype(np.float64)
        square = ((y[:, :_MOMENTS] - x[:_MOMENTS]) ** 2).reshape(-1, 2, FEATURES).mean(axis=2)
        noise = 2.0 * (y[:, _MOMENTS:-2] + x[_MOMENTS:-2])
        scale = np.minimum(y[:, -2:], x[-2:])
        within = (square <= ALIKE * scale**2 + noise).all(axis=1)
    return np.asarray(near[within])


def differ(one: str, other: str, tolerance: float) -> bool:
    """Whether two sketches in base64 differ by more than a tolerance of their actions."""
    if len(one) != len(other):
        return True
    x, y = (numbers(to_bytes(each)).astype(np.float64) for each in (one, other))
    return not bool((np.abs(x - y) <= tolerance).all())
