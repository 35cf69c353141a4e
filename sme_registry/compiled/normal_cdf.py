"""Φ, the standard normal CDF, by a table of polynomials: several times the speed of `erfc`.

On cells of width 1/16 over [−8.5, 8.5], Φ(c + d) = Σ_n Φ⁽ⁿ⁾(c) dⁿ / n! for n ≤ 7, |d| ≤ 1/32, with
Φ⁽ⁿ⁺¹⁾(c) = (−1)ⁿ He_n(c) φ(c) (He: the probabilists' Hermite polynomials). The absolute error is
under 3e-15; beyond ±8.5 Φ is within 1e-17 of 0 or 1. `erfc` has branches that keep it from being
pipelined.

For many numbers call `cell_of` in one loop and `in_cell` in a second one, a third of the time of
`normal_cdf` in a single loop: compilers vectorise the first loop over numbers, and `in_cell` reads
the coefficients of one number as two vectors, where they would gather those of several.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from scipy.special import ndtr

LIMIT = 8.5
CELLS_PER_UNIT = 16.0
DEGREE = 7
STRIDE = DEGREE + 1  # a cell's coefficients fill one cache line of 64 bytes
_WIDTH = 1.0 / CELLS_PER_UNIT
_NEAREST = LIMIT * CELLS_PER_UNIT + 0.5
_ORDER = [0, 4, 2, 6, 1, 5, 3, 7]  # of a cell's coefficients t₀ … t₇ in the table, for `_series`


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
    return table[:, _ORDER].ravel()


_TABLE = _taylor_table()


@intrinsic
def _series(typing, table, start, d):  # type: ignore[no-untyped-def]
    """Σ t_n dⁿ of the cell whose coefficients begin at `table[start]`, two vectors of four.

    (t₀, t₄, t₂, t₆) + (t₁, t₅, t₃, t₇) d = (a, c, b, e);  (a, c) + (b, e) d² = (low, high);
    low + high d⁴. The same sums and products in the same order as by scalars, so the same bits.
    """

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        table, start, d = arguments
        array = context.make_array(signature.args[0])(context, builder, table)
        four, index = ir.VectorType(ir.DoubleType(), 4), ir.IntType(32)

        def coefficients(offset):  # type: ignore[no-untyped-def]
            place = builder.gep(array.data, [builder.add(start, start.type(offset))])
            loaded = builder.load(builder.bitcast(place, four.as_pointer()))
            loaded.align = 8
            return loaded

        def part(vector, entries):  # type: ignore[no-untyped-def]
            mask = ir.Constant(ir.VectorType(index, len(entries)), entries)
            return builder.shuffle_vector(vector, vector.type(ir.Undefined), mask)

        def repeated(number, count):  # type: ignore[no-untyped-def]
            return part(builder.insert_element(four(ir.Undefined), number, index(0)), [0] * count)

        d2 = builder.fmul(d, d)
        pairs = builder.fadd(coefficients(0), builder.fmul(coefficients(4), repeated(d, 4)))
        halves = builder.fadd(
            part(pairs, [0, 1]), builder.fmul(part(pairs, [2, 3]), repeated(d2, 2))
        )
        low, high = (builder.extract_element(halves, index(i)) for i in range(2))
        return builder.fadd(low, builder.fmul(high, builder.fmul(d2, d2)))

    return types.float64(table, start, d), build


@njit(inline="always", error_model="numpy")
def cell_of(x):  # type: ignore[no-untyped-def]
    """The cell of a number that is not NaN, int32, and its distance from the cell's centre."""
    v = x if x < LIMIT else LIMIT
    v = v if v > -LIMIT else -LIMIT
    cell = np.int32(v * CELLS_PER_UNIT + _NEAREST)
    return cell, v - (np.float64(cell) * _WIDTH - LIMIT)


@njit(inline="always", error_model="numpy")
def in_cell(cell, d):  # type: ignore[no-untyped-def]
    """Φ at the distance d from the centre of a cell."""
    start = np.uint64(cell) * np.uint64(STRIDE)
    return _series(_TABLE, start, d)  # type: ignore[call-arg]  # Numba passes `typing`


@njit(inline="always", error_model="numpy")
def normal_cdf(x):  # type: ignore[no-untyped-def]
    """Φ of one number that is not NaN."""
    cell, d = cell_of(x)
    return in_cell(cell, d)
