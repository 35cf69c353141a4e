"""Statistics over runs: robust averages, stratified bootstrap intervals, profiles, comparisons.

    IQM       mean of a class's runs without the lowest ⌊n/4⌋ and the highest ⌊n/4⌋
    θ         mean over classes of a statistic (the IQM) within a class
    draw      in each class, n runs with replacement:  θ* = mean over classes of
              IQM + √(n/(n − 1)) (IQM* − IQM)
    95 %      θ ± max(θ − q₂.₅(θ*), q₉₇.₅(θ*) − θ)
    gap       mean of max(0, target − score)
    profile   P̂(τ) = mean over classes of the share of runs above τ
    P(X > Y)  mean over classes of the share of pairs (x, y) with x > y, ties counting ½

Sources: IQM, optimality gap, performance profiles, probability of improvement and their stratified
bootstrap, Agarwal et al. 2021 (θ is not their pooled IQM, which hardly moves when a method gives up
a class); the factor, by which resampling n runs understates their spread, Hesterberg 2015
("narrowness bias"). The longer of the two arms on both sides joins the percentile interval to its
mirror image, the "basic" one of Davison and Hinkley 1997, section 5.2: of few runs that are skewed
or two-humped, each of the two alone misses too often.

The run is the unit: its evaluation episodes and states are no further evidence. Every interval is a
function of its runs and of a seed, any text. Axis letters: `n` runs of a class, `K` columns.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Statistic = Callable[[npt.ArrayLike], Array]  # of [n, …] over the first axis: […]

__all__ = [
    "DRAWS",
    "LEVEL",
    "Estimate",
    "aggregate",
    "iqm",
    "mean",
    "median",
    "optimality_gap",
    "performance_profile",
    "probability_of_improvement",
    "stratified_bootstrap",
]

LEVEL = 0.95
DRAWS = 2000
_HELD = 2**21  # numbers held at once while drawing, 16 MiB


@dataclass(frozen=True, eq=False)
class Estimate:
    """Values with their 95 % intervals.

    Attributes:
      value: `[K]`.
      low: `[K]` lower ends.
      high: `[K]` upper ends.
    """

    value: Array
    low: Array
    high: Array


def iqm(runs: npt.ArrayLike) -> Array:
    """The interquartile mean over the first axis, as `scipy.stats.trim_mean(runs, 0.25)`.

    Args:
      runs: `[n, …]`, n ≥ 1.

    Returns:
      `[…]`, in the runs' units.
    """
    ordered = np.sort(np.asarray(runs, dtype=np.float64), axis=0)
    cut = len(ordered) // 4
    return np.asarray(ordered[cut : len(ordered) - cut].mean(axis=0))


def mean(runs: npt.ArrayLike) -> Array:
    """The mean over the first axis: `[n, …]` to `[…]`."""
    return np.asarray(np.mean(np.asarray(runs, dtype=np.float64), axis=0))


def median(runs: npt.ArrayLike) -> Array:
    """The median over the first axis: `[n, …]` to `[…]`."""
    return np.asarray(np.median(np.asarray(runs, dtype=np.float64), axis=0))


def optimality_gap(scores: npt.ArrayLike, target: float = 1.0) -> Array:
    """By how much runs miss a target on average; what lies above it makes up for nothing.

    Args:
      scores: `[n, …]`, higher is better.
      target: what is good enough, in the scores' units.

    Returns:
      `[…]`, at least 0, in the scores' units.
    """
    return mean(np.maximum(0.0, target - np.asarray(scores, dtype=np.float64)))


def aggregate(classes: Mapping[str, Array], statistic: Statistic = iqm) -> Array:
    """θ: classes count alike, however many runs each has.

    Args:
      classes: by name, `[n, K]` scores of its runs.
      statistic: within a class.

    Returns:
      `[K]`, in the scores' units.
    """
    return np.asarray(np.mean([statistic(runs) for runs in classes.values()], axis=0))


def stratified_bootstrap(
    classes: Mapping[str, Array], draws: int, seed: str, statistic: Statistic = iqm
) -> tuple[Array, Array]:
    """95 % intervals of `aggregate`, of all columns from the same resampled runs.

    A class of one run adds no spread: nothing is known of it.

    Args:
      classes: by name, `[n, K]` scores of its runs.
      draws: how many samples of runs to take.
      seed: any text; the intervals are a function of it and of the other arguments, since a class
        reads its own stream of random bits, the same in every version of NumPy.
      statistic: within a class.

    Returns:
      The lower and the upper ends, `[K]` each, in the scores' units.
    """
    value = aggregate(classes, statistic)
    deviation = np.zeros((len(value), draws))
    for name, runs in classes.items():
        n = len(runs)
        if n == 1:
            continue
        widened = math.sqrt(n / (n - 1)) / len(classes)
        centre = statistic(runs)[:, None]
        bits = _stream(seed, name)
        rows = max(1, _HELD // runs.size)
        for first in range(0, draws, rows):
            part = deviation[:, first : first + rows]
            chosen = _resampled(bits, n, part.shape[1])
            if statistic is iqm:
                found = _weighted_iqm(runs, _counts(chosen))
            else:
                found = statistic(runs[chosen.T]).T
            part += widened * (found - centre)
    return _around(value, deviation)


def performance_profile(
    classes: Mapping[str, Array], thresholds: npt.ArrayLike, draws: int, seed: str
) -> Estimate:
    """The share of runs that score above each threshold, classes counting alike.

    Args:
      classes: by name, `[n]` scores of its runs, higher is better.
      thresholds: `[K]` τ.
      draws: see `stratified_bootstrap`.
      seed: see `stratified_bootstrap`.

    Returns:
      `[K]` shares in [0, 1] with intervals of each (not of all at once), never rising with τ.
    """
    tau = np.asarray(thresholds, dtype=np.float64)
    above = {name: (np.asarray(x)[:, None] > tau).astype(float) for name, x in classes.items()}
    low, high = stratified_bootstrap(above, draws, seed, mean)
    return Estimate(aggregate(above, mean), low.clip(0.0, 1.0), high.clip(0.0, 1.0))


def probability_of_improvement(
    x: Mapping[str, Array], y: Mapping[str, Array], draws: int, seed: str
) -> Estimate:
    """How probably a run of one method scores above a run of another on a class drawn at random.

    Where all pairs agree, resampling has nothing to vary and would be certain after two runs. There
    the far end is what N = Σ min(n_x, n_y) independent pairs that agree still allow,
    ((1 − LEVEL)/2)^(1/N): the exact binomial bound of Clopper and Pearson 1934.

    Args:
      x: by class, `[n]` scores of its runs, higher is better.
      y: of the other method, the same classes.
      draws: how many samples of runs to take, of the two methods independently.
      seed: any text.

    Returns:
      `[1]`, in [0, 1]; ½ where neither is better.
    """
    value, deviation = np.zeros(1), np.zeros((1, draws))
    pairs, unanimous = 0, True
    for name in x:
        ours, theirs = (np.asarray(runs, dtype=np.float64) for runs in (x[name], y[name]))
        wins = (np.sign(ours[:, None] - theirs) + 1.0) / 2.0
        value += wins.mean() / len(x)
        fewer = min(wins.shape)
        pairs += fewer
        unanimous = unanimous and wins.min() == wins.max() != 0.5
        if fewer == 1:
            continue
        # How often each run is drawn, times who beats whom, is the sample's share of wins.
        counts = [
            _counts(_resampled(_stream(seed, f"{name}\n{side}"), n, draws)) / n
            for side, n in zip("xy", wins.shape, strict=True)
        ]
        share = np.einsum("id,ij,jd->d", counts[0], wins, counts[1], optimize=True)
        deviation += math.sqrt(fewer / (fewer - 1)) / len(x) * (share - wins.mean())
    if unanimous and float(value[0]) in (0.0, 1.0):
        bound = np.array([((1.0 - LEVEL) / 2.0) ** (1.0 / pairs)])
        return Estimate(value, bound, value) if value[0] else Estimate(value, value, 1.0 - bound)
    low, high = _around(value, deviation)
    return Estimate(value, low.clip(0.0, 1.0), high.clip(0.0, 1.0))


def _around(value: Array, deviation: Array) -> tuple[Array, Array]:
    """The interval of values `[K]` from the deviations of their samples `[K, draws]`."""
    low, high = np.quantile(deviation, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=1)
    arm = np.maximum(np.maximum(-low, high), 0.0)
    return value - arm, value + arm


def _stream(seed: str, name: str) -> np.random.PCG64:
    """Random bits of a class; NumPy keeps these, unlike what `Generator` makes of them."""
    key = hashlib.sha256(f"{seed}\n{name}".encode()).digest()
    return np.random.PCG64(int.from_bytes(key, "big"))


def _resampled(bits: np.random.PCG64, n: int, draws: int) -> npt.NDArray[np.int64]:
    """Which of n runs are in each sample of n, `[draws, n]`."""
    uniform = (bits.random_raw(draws * n) >> np.uint64(11)) * 2.0**-53
    return (uniform * n).astype(np.int64).reshape(draws, n)


def _counts(chosen: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """How often each run is in each sample: `[draws, n]` to `[n, draws]`."""
    draws, n = chosen.shape
    flat = (chosen + np.arange(0, draws * n, n)[:, None]).ravel()
    counts = np.bincount(flat, minlength=draws * n).reshape(draws, n)
    return np.ascontiguousarray(counts.T)


def _weighted_iqm(runs: Array, counts: npt.NDArray[np.int64]) -> Array:
    """IQM of samples that hold each run a number of times, without sorting any of them.

    In order of their values, the runs take the places 0 … n of a sample by their counts; those
    between the cuts make the mean.

    Args:
      runs: `[n, K]`.
      counts: `[n, draws]`, n in each column.

    Returns:
      `[K, draws]`.
    """
    n = len(runs)
    cut = n // 4
    found = np.empty((runs.shape[1], counts.shape[1]))
    for column, order in enumerate(np.argsort(runs, axis=0, kind="stable").T):
        places = np.clip(np.cumsum(counts[order], axis=0), cut, n - cut)
        inside = np.diff(places, axis=0, prepend=cut)
        found[column] = runs[order, column] @ inside
    return found / (n - 2 * cut)
