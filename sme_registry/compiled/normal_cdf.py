"""Φ, the standard normal CDF, by a table of polynomials: several times the speed of `erfc`.

On cells of width 1/16 over [−8.5, 8.5], Φ(c + d) = Σ_n Φ⁽ⁿ⁾(c) dⁿ / n! for n ≤ 7, |d| ≤ 1/32, with
Φ⁽ⁿ⁺¹⁾(c) = (−1)ⁿ He_n(c) φ(c) (He: the probabilists' Hermite polynomials). The absolute error is
under 3e-15; beyond ±8.5 Φ is within 1e-17 of 0 or 1. Φ, not the matrix product, is most of the
cost of an optimal policy, and `erfc` has branches that keep it from being pipelined.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.special import ndtr

LIMIT = 8.5
CELLS_PER_UNIT = 16.0
DEGREE = 7
STRIDE = DEGREE + 1  # a cell's coefficients fill one cache line of 64 bytes
_WIDTH = 1.0 / CELLS_PER_UNIT
_NEAREST = LIMIT * CELLS_PER_UNIT + 0.5
_1, _2, _3, _4, _5, _6, _7 = (np.uint64(n) for n in range(1, 8))


def _taylor_table() -> npt.NDArray[np.float64]:
    centres = np.arange(int(2 * LIMIT * CELLS_PER_UNIT) + 1) / CELLS_PER_UNIT - LIMIT
    density = np.exp(-0.5 * centres**2) / math.sqrt(2.0 * math.pi)
    hermite = [np.ones_like(centres), centres]
    for n in range(1, DEGREE):
        hermite.append(centres * hermite[n] - n * hermite[n - 1])
    table = np.empty((centres.size, STRIDE))
    table[:, 0] = ndtr(centres)
    for n in range(DEGREE):
        table[:, n + 1] = (-1) ** n * hermite[n] * density / math.factorial(n + 1)
    return table.ravel()


_TABLE = _taylor_table()


@njit(inline="always", error_model="numpy")
def normal_cdf(x):  # type: ignore[no-untyped-def]
    """Φ of one number that is not NaN."""
    v = x if x < LIMIT else LIMIT
    v = v if v > -LIMIT else -LIMIT
    cell = int(v * CELLS_PER_UNIT + _NEAREST)
    d = v - (cell * _WIDTH - LIMIT)
    c = np.uint64(cell * STRIDE)
    t = _TABLE
    d2 = d * d
    low = (t[c] + t[c + _1] * d) + (t[c + _2] + t[c + _3] * d) * d2
    high = (t[c + _4] + t[c + _5] * d) + (t[c + _6] + t[c + _7] * d) * d2
    return low + high * (d2 * d2)
