"""Statistics over runs: robust averages, stratified bootstrap intervals, profiles, comparisons.

    IQM       mean of a class's runs without the lowest ⌊n/4⌋ and the highest ⌊n/4⌋
    θ         mean over classes of a statistic (the IQM) within a class
    draw      in each class, n runs with replacement:  θ* = mean over classes of
              IQM + √(n/(n − 1)) (IQM* − IQM)
    95 %      θ ± max(θ − q₂.₅(θ*), q₉₇.₅(θ*) − θ)
    strata    in general, with weights w:  θ = Σ w × statistic / Σ w, and θ* likewise
    gap       mean of max(0, target − score)
    profile   P̂(τ) = mean over classes of the share of runs above τ
    P(X > Y)  mean over classes of the share of pairs (x, y) with x > y, ties counting ½

Sources: IQM, optimality gap, performance profiles, probability of improvement and their stratified
bootstrap, Agarwal et al. 2021 (θ is not their pooled IQM, which hardly changes when a method fails
on one class); the factor √(n/(n − 1)), Hesterberg 2015 ("narrowness bias"). Using the longer arm on
both sides combines the percentile interval with its mirror image, the "basic" interval of Davison
and Hinkley 1997, section 5.2: with few runs that are skewed or bimodal, either alone covers too
rarely. The run is the unit, not its episodes or states; the spread of a single run is unknown.
Axis letters: `n` runs of a class, `K` columns.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sme_registry.io import integer_in

Array = npt.NDArray[np.float64]
Statistic = Callable[[npt.ArrayLike], Array]  # of [n, …] over the first axis: […]

__all__ = [
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
_MAX_NUMBERS = 2**21  # in memory at once while drawing, 16 MiB


@dataclass(frozen=True, eq=False)
class Estimate:
    """Values `[K]` with the ends of their 95 % intervals, NaN where each class has a single run.

    Examples:
      >>> from sme_registry.statistics import Estimate
      >>> Estimate(value=np.array([0.5]), low=np.array([0.4]), high=np.array([0.6])).low
      array([0.4])
    """

    value: Array
    low: Array
    high: Array


def iqm(runs: npt.ArrayLike) -> Array:
    """The interquartile mean over the first axis, `[n, …]` to `[…]`: SciPy's `trim_mean` of 0.25.

    Examples:
      >>> from sme_registry.statistics import iqm
      >>> float(iqm([0.0, 1.0, 2.0, 100.0]))
      1.5
    """
    ordered = np.sort(np.asarray(runs, dtype=np.float64), axis=0)
    cut = len(ordered) // 4
    return mean(ordered[cut : len(ordered) - cut])


def mean(runs: npt.ArrayLike) -> Array:
    """The mean over the first axis: `[n, …]` to `[…]`.

    Examples:
      >>> from sme_registry.statistics import mean
      >>> mean([[1.0, 2.0], [3.0, 4.0]])
      array([2., 3.])
    """
    return np.asarray(np.mean(np.asarray(runs, dtype=np.float64), axis=0))


def median(runs: npt.ArrayLike) -> Array:
    """The median over the first axis: `[n, …]` to `[…]`.

    Examples:
      >>> from sme_registry.statistics import median
      >>> float(median([0.0, 1.0, 100.0]))
      1.0
    """
    return np.asarray(np.median(np.asarray(runs, dtype=np.float64), axis=0))


def optimality_gap(scores: npt.ArrayLike, target: float = 1.0) -> Array:
    """The mean shortfall from a target, `[n, …]` to `[…]`; values above it do not compensate.

    Examples:
      >>> from sme_registry.statistics import optimality_gap
      >>> float(optimality_gap([0.5, 1.5]))
      0.25
    """
    return mean(np.maximum(0.0, target - np.asarray(scores, dtype=np.float64)))


def running_median(values: Array, window: int) -> Array:
    """Medians `[N]` of the last `window` entries of `[N]` values, of fewer at the beginning."""
    N = len(values)
    medians = [np.median(values[:end]) for end in range(1, min(window, N + 1))]
    if window <= N:
        windows = np.lib.stride_tricks.sliding_window_view(values, window)
        rows = max(1, _MAX_NUMBERS // window)
        for first in range(0, len(windows), rows):
            medians.extend(np.median(windows[first : first + rows], axis=1))
    return np.array(medians)


def smoothed(step: Array, values: Array, window: int | None = None) -> tuple[Array, Array, int]:
    """The line of a training curve, from `[N]` values and the steps of each, in any order.

    It returns `[P]` increasing steps, `[P]` medians of the last `window` values up to each, and the
    window, by default a tenth of the values, in [1, 50], or all that ended at one step.
    """
    order = np.argsort(step, kind="stable")
    x, y = step[order], values[order]
    last = np.flatnonzero(np.diff(x, append=np.inf))  # of all that ended at one step
    if window is None:
        window = max(1, min(50, len(x) // 10), int(np.diff(last, prepend=-1).max()))
    window = min(integer_in("window", window, 1), len(x))
    last = last[last >= window - 1]
    return x[last], running_median(y, window)[last], window


def aggregate(
    classes: Mapping[str, Array],
    statistic: Statistic | Mapping[str, Statistic] = iqm,
    weights: Mapping[str, float] | None = None,
) -> Array:
    """θ `[K]`: the mean over classes, which have equal weight regardless of their number of runs.

    A class has `[n, K]` scores of its runs. Within classes the statistic is one for all, or one for
    each by its name; `weights` of classes are positive.

    Examples:
      >>> from sme_registry.statistics import aggregate
      >>> classes = {"easy": np.array([[1.0], [3.0]]), "hard": np.array([[0.0]])}
      >>> aggregate(classes)
      array([1.])
    """
    strata = _strata(classes, statistic, weights)
    weighted = [weight * of_class(runs) for _, runs, of_class, weight in strata]
    return np.asarray(np.sum(weighted, axis=0) / sum(weight for *_, weight in strata))


def stratified_bootstrap(
    classes: Mapping[str, Array],
    draws: int,
    seed: str,
    statistic: Statistic | Mapping[str, Statistic] = iqm,
    weights: Mapping[str, float] | None = None,
) -> tuple[Array, Array]:
    """95 % intervals of `aggregate`, with the same resampled runs for all columns.

    The ends are `[K]` each, NaN where each class has a single run; beside classes of several runs,
    such a class adds no spread. `seed` is any text: intervals depend only on it and the other
    arguments, in every version of NumPy.

    Examples:
      >>> from sme_registry.statistics import stratified_bootstrap
      >>> classes = {"easy": np.array([[1.0], [3.0]]), "hard": np.array([[0.0], [1.0]])}
      >>> low, high = stratified_bootstrap(classes, 1000, "any text")
      >>> bool(low[0] < 1.25 < high[0])
      True
    """
    value = aggregate(classes, statistic, weights)
    if max(map(len, classes.values())) == 1:
        return np.full_like(value, np.nan), np.full_like(value, np.nan)
    strata = _strata(classes, statistic, weights)
    total = sum(weight for *_, weight in strata)
    deviation = np.zeros((len(value), draws))
    for name, runs, of_class, weight in strata:
        n = len(runs)
        if n == 1:
            continue
        widened = math.sqrt(n / (n - 1)) * weight / total
        centre = of_class(runs)[:, None]
        bits = _stream(seed, name)
        rows = max(1, _MAX_NUMBERS // runs.size)
        for first in range(0, draws, rows):
            part = deviation[:, first : first + rows]
            chosen = _resampled(bits, n, part.shape[1])
            if of_class is iqm:
                resampled = _weighted_iqm(runs, _counts(chosen))
            else:
                resampled = of_class(runs[chosen.T]).T
            part += widened * (resampled - centre)
    return _around(value, deviation)


def performance_profile(
    classes: Mapping[str, Array], thresholds: npt.ArrayLike, draws: int, seed: str
) -> Estimate:
    """The share `[K]` of runs above each threshold τ, with equal weight for each class.

    A class has `[n]` scores. The shares never rise with τ; the intervals are pointwise.

    Examples:
      >>> from sme_registry.statistics import performance_profile
      >>> scores = {"easy": np.array([0.2, 0.6, 0.9]), "hard": np.array([0.1, 0.3])}
      >>> performance_profile(scores, [0.0, 0.5], 1000, "any text").value.round(2)
      array([1.  , 0.33])
    """
    tau = np.asarray(thresholds, dtype=np.float64)
    above = {name: (np.asarray(x)[:, None] > tau).astype(float) for name, x in classes.items()}
    low, high = stratified_bootstrap(above, draws, seed, mean)
    return Estimate(aggregate(above, mean), low.clip(0.0, 1.0), high.clip(0.0, 1.0))


def probability_of_improvement(
    x: Mapping[str, Array], y: Mapping[str, Array], draws: int, seed: str
) -> Estimate:
    """The probability `[1]` that a run of x scores above one of y on a random class; ½ if equal.

    `x` and `y` have the same classes, of `[n]` scores each. If all pairs agree, resampled values do
    not vary, so the far end is the exact binomial bound of Clopper and Pearson 1934 for
    N = Σ min(n_x, n_y) independent pairs that agree, ((1 − LEVEL)/2)^(1/N).

    Examples:
      >>> from sme_registry.statistics import probability_of_improvement
      >>> ours, theirs = {"easy": np.array([0.8, 0.9])}, {"easy": np.array([0.5, 0.85])}
      >>> probability_of_improvement(ours, theirs, 1000, "any text").value
      array([0.75])
    """
    value, deviation = np.zeros(1), np.zeros((1, draws))
    pairs, unanimous, known = 0, True, False
    for name in x:
        ours, others = (np.asarray(runs, dtype=np.float64) for runs in (x[name], y[name]))
        wins = (np.sign(ours[:, None] - others) + 1.0) / 2.0
        value += wins.mean() / len(x)
        fewer = min(wins.shape)
        pairs += fewer
        unanimous = unanimous and wins.min() == wins.max() != 0.5
        if fewer == 1:
            continue
        known = True
        # A sample's share of wins: the runs' counts in it, times who beats whom.
        counts = [
            _counts(_resampled(_stream(seed, f"{name}\n{side}"), n, draws)) / n
            for side, n in zip("xy", wins.shape, strict=True)
        ]
        share = np.einsum("id,ij,jd->d", counts[0], wins, counts[1], optimize=True)
        deviation += math.sqrt(fewer / (fewer - 1)) / len(x) * (share - wins.mean())
    if not known:
        return Estimate(value, np.array([np.nan]), np.array([np.nan]))
    if unanimous and float(value[0]) in (0.0, 1.0):
        bound = np.array([((1.0 - LEVEL) / 2.0) ** (1.0 / pairs)])
        return Estimate(value, bound, value) if value[0] else Estimate(value, value, 1.0 - bound)
    low, high = _around(value, deviation)
    return Estimate(value, low.clip(0.0, 1.0), high.clip(0.0, 1.0))


def _strata(
    classes: Mapping[str, Array],
    statistic: Statistic | Mapping[str, Statistic],
    weights: Mapping[str, float] | None,
) -> list[tuple[str, Array, Statistic, float]]:
    """Each class: its name, runs `[n, K]`, statistic and weight."""
    of_class = statistic if isinstance(statistic, Mapping) else dict.fromkeys(classes, statistic)
    weights = dict.fromkeys(classes, 1.0) if weights is None else weights
    return [(name, runs, of_class[name], weights[name]) for name, runs in classes.items()]


def _around(value: Array, deviation: Array) -> tuple[Array, Array]:
    """The interval of values `[K]` from the deviations of their samples `[K, draws]`."""
    low, high = np.quantile(deviation, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=1)
    arm = np.maximum(np.maximum(-low, high), 0.0)
    return value - arm, value + arm


def _stream(seed: str, name: str) -> np.random.PCG64:
    """Random bits of a class, which every version of NumPy keeps, unlike `Generator`'s output."""
    key = hashlib.sha256(f"{seed}\n{name}".encode()).digest()
    return np.random.PCG64(int.from_bytes(key, "big"))


def _resampled(bits: np.random.PCG64, n: int, draws: int) -> npt.NDArray[np.int64]:
    """Indices of the runs in each sample of n, `[draws, n]`."""
    uniform = (bits.random_raw(draws * n) >> np.uint64(11)) * 2.0**-53
    return (uniform * n).astype(np.int64).reshape(draws, n)


def _counts(chosen: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """How often each run is in each sample: `[draws, n]` to `[n, draws]`."""
    draws, n = chosen.shape
    flat = (chosen + np.arange(0, draws * n, n)[:, None]).ravel()
    counts = np.bincount(flat, minlength=draws * n).reshape(draws, n)
    return np.ascontiguousarray(counts.T)


def _weighted_iqm(runs: Array, counts: npt.NDArray[np.int64]) -> Array:
    """IQM `[K, draws]` of samples of runs `[n, K]` by counts `[n, draws]`, without sorting.

    The runs in order of their values occupy the ranks of a sample according to their counts; the
    mean is over the ranks between the cuts.
    """
    n = len(runs)
    cut = n // 4
    means = np.empty((runs.shape[1], counts.shape[1]))
    for column, order in enumerate(np.argsort(runs, axis=0, kind="stable").T):
        ranks = np.clip(np.cumsum(counts[order], axis=0), cut, n - cut)
        inside = np.diff(ranks, axis=0, prepend=cut)
        means[column] = runs[order, column] @ inside
    return means / (n - 2 * cut)
