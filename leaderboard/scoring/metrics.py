"""Metrics of a run, and ranks from intervals.

θ of a metric and its 95 % interval are `sme_registry.statistics`' `aggregate` and
`stratified_bootstrap`: the mean over classes of the interquartile mean within a class. It is not
the pooled interquartile mean, which hardly changes when a method fails on one whole class.
`python -m benchmarks.interval_coverage` measures the coverage of these intervals.

Axis letters: `n` runs of a class, `K` metrics, `N` entries of a board.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def run_metrics(
    normalised_regret: Sequence[float], similarity: Sequence[float] | None, levels: Sequence[float]
) -> dict[str, float]:
    """The metrics of one run by name, as defined in `documents.result`.

    Args:
      normalised_regret: N_m of each region, WD first.
      similarity: mean r̃ of each region, in [0, 1]; None without a policy.
      levels: ε_m, 0 for WD.

    Returns:
      `wd_regret`, `ood_regret`, `ood_decay` and `regret_slope`, dimensionless, and
      `similarity_loss`, in points (hundredths of r̃). Without a policy each is 1 (100 points), and
      not what N_m = 1 everywhere gives: a decay of 0 would reward leaving out runs.
    """
    if similarity is None:
        return {
            "wd_regret": 1.0,
            "ood_regret": 1.0,
            "ood_decay": 1.0,
            "regret_slope": 1.0,
            "similarity_loss": 100.0,
        }
    N, r = np.asarray(normalised_regret), np.asarray(similarity)
    offset = np.asarray(levels) - np.mean(levels)
    wd, ood = float(N[0]), float(N[1:].mean())
    return {
        "wd_regret": wd,
        "ood_regret": ood,
        "ood_decay": ood - wd,
        "regret_slope": float(offset @ (N - wd) / (offset @ offset)),  # exactly 0 where N is flat
        "similarity_loss": 100.0 * float(r[0] - r[1:].mean()),
    }


def rank_ranges(
    low: npt.ArrayLike, high: npt.ArrayLike
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The best and the worst rank that each entry's interval allows; lower scores are better.

    first = 1 + entries whose interval lies wholly below; last = N − entries wholly above.

    Args:
      low: `[N]` lower ends.
      high: `[N]` upper ends, none below its lower end.

    Returns:
      `first` and `last`, `[N]` each, 1 ≤ first ≤ last ≤ N. In O(N log N).
    """
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    first = 1 + np.searchsorted(np.sort(high), low, side="left")
    last = np.searchsorted(np.sort(low), high, side="right")
    return first.astype(np.int64), last.astype(np.int64)
