"""How much of some numbers a linear map recovers from others.

R² = 1 − Σ (y − ŷ)² / Σ (y − ȳ)²         of the held-out half; ŷ is fitted to the other half
"""

from __future__ import annotations

import numpy as np

from sme_registry.task.draw import Array


def held_out_r2(h: Array, y: Array) -> Array:
    """R² `[c]` of each column of y `[n, c]` from an affine map of h `[n, H]`; see the module."""
    half = len(h) // 2
    design = np.concatenate([h, np.ones((len(h), 1))], axis=1)
    solution = np.linalg.lstsq(design[:half], y[:half])[0]
    missed = ((design[half:] @ solution - y[half:]) ** 2).sum(axis=0)
    return np.asarray(1.0 - missed / ((y[half:] - y[half:].mean(axis=0)) ** 2).sum(axis=0))
