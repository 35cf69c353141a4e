"""Coverage of the board's 95 % intervals, and how often they separate equal methods.

    python -m benchmarks.interval_coverage [repetitions]

Each class has ten runs: all on one instance, five on each of two, or one on each of ten. Instances
differ in difficulty. Coverage is measured against two true values for each distribution of runs: θ
in the limit of many runs, and the mean of θ over samples of this size. The two differ for skewed
distributions.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sme_registry.statistics import Array, iqm
from sme_registry.statistics import mean as average
from sme_registry.statistics import stratified_bootstrap as bootstrap

RUNS, CLASSES = 10, 6
INSTANCES = (1, 2, 10)
SPREAD = 0.1  # of the difficulties of instances: the hardest is worse by twice this
Draw = Callable[[np.random.Generator, tuple[int, ...]], Array]


def two_humps(share: float) -> Draw:
    """Runs that either learn (near 0.1) or do not (near 0.9); `share` of them learn."""
    return lambda rng, size: (
        np.where(rng.random(size) < share, 0.1, 0.9) + rng.normal(0.0, 0.05, size)
    )


def failing(share: float) -> Draw:
    """Runs near 0.2, of which `share` finish; the others failed and score 1."""
    return lambda rng, size: np.where(rng.random(size) < share, rng.normal(0.2, 0.05, size), 1.0)


DISTRIBUTIONS: dict[str, Draw] = {
    "normal": lambda rng, size: rng.normal(0.4, 0.1, size),
    "uniform": lambda rng, size: rng.random(size),
    "beta(2, 5)": lambda rng, size: rng.beta(2, 5, size),
    "beta(½, ½)": lambda rng, size: rng.beta(0.5, 0.5, size),
    "exponential": lambda rng, size: rng.exponential(0.1, size),
    "lognormal(1)": lambda rng, size: 0.1 * rng.lognormal(0.0, 1.0, size),
    "t(3)": lambda rng, size: rng.standard_t(3, size),
    "two humps 50:50": two_humps(0.5),
    "two humps 60:40": two_humps(0.6),
    "two humps 70:30": two_humps(0.7),
    "two humps 80:20": two_humps(0.8),
    "two humps 90:10": two_humps(0.9),
    "20 % failed": failing(0.8),
}


@dataclass(frozen=True)
class Coverage:
    """The result of a simulation.

    Attributes:
      coverage: share of intervals that contain θ in the limit of many runs.
      coverage_of_mean: share that contain the mean of θ over samples of this size.
      separated: share of pairs of equal methods whose intervals are disjoint.
      width: mean width over the standard deviation of θ.
      repetitions: number of simulated methods.
    """

    coverage: float
    coverage_of_mean: float
    separated: float
    width: float
    repetitions: int

    def __str__(self) -> str:
        return (
            f"coverage {self.coverage:.3f}, of the mean {self.coverage_of_mean:.3f}, "
            f"equal methods separated {self.separated:.2%}, width {self.width:.1f} SD "
            f"({self.repetitions:,} methods)"
        )


def simulate(
    draw: Draw, repetitions: int, draws: int = 2000, batch: int = 200, instances: int = 1
) -> Coverage:
    """Simulate equal methods and compute the interval of each.

    The columns that `bootstrap` treats as metrics are independent methods here. The strata are
    those of `leaderboard.scoring.ranking`.
    """
    rng = np.random.default_rng(0)
    runs = RUNS // instances
    harder = SPREAD * np.linspace(-1.0, 1.0, instances) if instances > 1 else np.zeros(1)
    truth = iqm(draw(rng, (1_000_000,)))
    mean = iqm(draw(rng, (runs, 100_000))).mean()
    low, high = (np.empty(repetitions) for _ in range(2))
    for first in range(0, repetitions, batch):
        count = min(batch, repetitions - first)
        strata: dict[str, Array] = {}
        for index in range(CLASSES):
            of_class = draw(rng, (instances, runs, count)) + harder[:, None, None]
            groups = of_class if runs > 1 else of_class.reshape(1, instances, count)
            strata |= {
                f"{index} {number}": np.sort(each, axis=0) for number, each in enumerate(groups)
            }
        part = slice(first, first + count)
        statistic = iqm if runs > 1 else average
        low[part], high[part] = bootstrap(strata, draws, f"{first}", statistic)
    half = repetitions // 2
    one, other = slice(0, half), slice(half, 2 * half)
    return Coverage(
        coverage=float(((low <= truth) & (truth <= high)).mean()),
        coverage_of_mean=float(((low <= mean) & (mean <= high)).mean()),
        separated=float(((high[one] < low[other]) | (high[other] < low[one])).mean()),
        width=float((high - low).mean() / ((low + high) / 2).std()),
        repetitions=repetitions,
    )


if __name__ == "__main__":
    repetitions = int(sys.argv[1]) if len(sys.argv) > 1 else 4000
    for name, draw in DISTRIBUTIONS.items():
        for instances in INSTANCES:
            coverage = simulate(draw, repetitions, instances=instances)
            print(f"{name:16} {instances:2} × {RUNS // instances:2} runs: {coverage}", flush=True)
