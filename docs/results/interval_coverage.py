"""The table of docs/explanation/statistics.md: how often a 95 % interval contains the truth.

    python docs/results/interval_coverage.py

The truth is the IQM, or the mean, of infinitely many runs. A share has a standard error of at most
0.8 points.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy import stats

from sme_registry.statistics import iqm, mean, stratified_bootstrap

STUDIES, DRAWS, LARGE = 4_000, 1_000, 4_000_000
Sample = Callable[[np.random.Generator, int], np.ndarray]


def _learnt_or_stuck(random: np.random.Generator, size: int) -> np.ndarray:
    """Seven runs of ten near 0.15, the others near 1.2: TD3 on hard tasks."""
    stuck = random.random(size) < 0.3
    return np.where(stuck, random.normal(1.2, 0.15, size), random.normal(0.15, 0.03, size))


KINDS: dict[str, Sample] = {
    "normal": lambda random, size: random.normal(0.3, 0.05, size),
    "exponential": lambda random, size: 0.1 + random.exponential(0.2, size),
    "70 % learned, 30 % stuck": _learnt_or_stuck,
}


def coverage(sample: Sample, n: int, classes: int, statistic: Callable) -> float:
    """The share of simulated studies, of n runs in each class, whose interval has the truth."""
    random = np.random.default_rng(20261126)
    large = np.sort(sample(random, LARGE))
    truth = stats.trim_mean(large, 0.25) if statistic is iqm else large.mean()
    runs = {f"{i}": sample(random, n * STUDIES).reshape(n, STUDIES) for i in range(classes)}
    low, high = stratified_bootstrap(runs, DRAWS, "coverage", statistic)
    return float(((low <= truth) & (truth <= high)).mean())


def table() -> pd.DataFrame:
    """Coverage in per cent: rows of averages and kinds of runs, columns of classes and runs."""
    rows = {
        (statistic.__name__, kind): {
            (classes, n): round(100 * coverage(sample, n, classes, statistic))
            for classes in (1, 10)
            for n in (2, 3, 5, 10)
        }
        for statistic in (iqm, mean)
        for kind, sample in KINDS.items()
    }
    return pd.DataFrame(rows).T


if __name__ == "__main__":
    print(table().to_string())
