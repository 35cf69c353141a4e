"""Whether a transition keeps an ensemble uniform, and whether floating point makes it collapse."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sme_registry.task.draw import Array

CONSTANT_STEPS = 2_000
_CHANNELS_FOLLOWED = 256
_FALSE_ALARM = 1e-6  # chance that one of the channels of a uniform ensemble is beyond the bound


def distance_from_uniform(s: Array) -> float:
    """The largest √N · KS distance of the marginals of `[N, C]` numbers from U(0, 1)."""
    N = len(s)
    ranked = np.sort(s, axis=0)
    steps = np.arange(N)[:, None] / N
    return float(math.sqrt(N) * np.maximum(ranked - steps, steps + 1.0 / N - ranked).max())


def uniform_bound(channels: int) -> float:
    """Kolmogorov's bound on √N · KS distance, shared out over the channels (Bonferroni)."""
    return math.sqrt(0.5 * math.log(2.0 * channels / _FALSE_ALARM))


def lanes_followed(channels: int, action_dim: int) -> int:
    """How many lanes `distinct_share` follows."""
    return max(8, min(64, 2**20 // (channels * action_dim)))


def distinct_share(
    transition: Callable[[Array, Array], Array], starts: Array, action: Array
) -> float:
    """The smallest share of distinct values of a channel under constant actions, in (0, 1].

    `[lanes, C]` starts take `CONSTANT_STEPS` steps of a `[1, A]` action, of 0, of ½ and of 1. A
    channel must neither merge its lanes nor fall into a short cycle: a dyadic b with a dyadic
    action merges all lanes within 52 steps; float32 states cycle within about 2,000.
    """
    lanes, channels = starts.shape
    constants = np.concatenate([*(np.full_like(action, c) for c in (0.0, 0.5, 1.0)), action])
    a = np.repeat(constants, lanes, axis=0)
    s = np.tile(starts, (len(constants), 1))
    history = np.empty((CONSTANT_STEPS, len(constants), min(channels, _CHANNELS_FOLLOWED)))
    for t in range(CONSTANT_STEPS):
        s = transition(s, a)
        history[t] = s[::lanes, : history.shape[2]]
    last = s.reshape(len(constants), lanes, channels).swapaxes(0, 1)
    return min(_distinct(history), _distinct(last))


def _distinct(values: Array) -> float:
    """The smallest share of distinct values along the first axis."""
    ranked = np.sort(values, axis=0)
    return float((1 + (np.diff(ranked, axis=0) > 0).sum(axis=0)).min()) / len(values)
