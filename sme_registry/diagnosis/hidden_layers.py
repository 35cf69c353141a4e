"""What the hidden layers of a network still represent: dormant units, effective rank, weights.

Of a multilayer perceptron with hidden outputs h `[n, H]` in n states, σ their singular values:

    score of unit i    mean |h_i| / (Σ_k mean |h_k| / H)          dormant at most 0.025
    effective rank     min {k : Σ_{i ≤ k} σ_i / Σ_i σ_i ≥ 0.99}   of the last hidden layer
    weight norm        √(Σ W²) over all layers, without biases

Dormant units: Sokar et al. (2023). Effective rank: Kumar et al. (2021), srank with δ = 0.01. A unit
of tanh is rarely dormant but can be stuck at a bound: it counts as saturated if its mean |h| is at
least 0.95, where its mean derivative, 1 − h², is below 0.1.
"""

from __future__ import annotations

import numpy as np

from sme_registry.diagnosis.stream_document import NetworkState
from sme_registry.envs.types import Observation
from sme_registry.evaluation.networks import Perceptron
from sme_registry.task.draw import Array

__all__ = ["DORMANT", "RANK_SHARE", "SATURATED", "network_state"]

DORMANT = 0.025  # τ of the score
SATURATED = 0.95  # mean |h| of a unit of tanh
RANK_SHARE = 0.99  # 1 − δ of the singular values' sum


def network_state(network: Perceptron, observations: Observation) -> NetworkState | None:
    """Measure a network in some states; None if it has no hidden layer."""
    *hidden, _ = zip(network.outputs(observations), network.layers, strict=True)
    if not hidden:
        return None
    outputs = [h.astype(np.float64) for h, _ in hidden]
    stuck = [layer[2] == "tanh" for _, layer in hidden]
    units = sum(h.shape[1] for h in outputs)
    saturated = sum(_saturated(h) for h, tanh in zip(outputs, stuck, strict=True) if tanh)
    squares = sum(float((W.astype(np.float64) ** 2).sum()) for W, _, _ in network.layers)
    return NetworkState(
        hidden=tuple(h.shape[1] for h in outputs),
        dormant_units=sum(map(_dormant, outputs)) / units,
        saturated_units=saturated / units,
        effective_rank=_effective_rank(outputs[-1]),
        weight_norm=squares**0.5,
    )


def _dormant(h: Array) -> int:
    """How many units of a layer are dormant; all of them in a layer whose outputs are all 0."""
    means = np.abs(h).mean(axis=0)
    return int((means <= DORMANT * means.mean()).sum())


def _saturated(h: Array) -> int:
    return int((np.abs(h).mean(axis=0) >= SATURATED).sum())


def _effective_rank(h: Array) -> int:
    """In [0, H]; 0 where all outputs are 0."""
    σ = np.linalg.svd(h, compute_uv=False)
    if not σ.any():
        return 0
    return int((np.cumsum(σ) / σ.sum() < RANK_SHARE).sum()) + 1
