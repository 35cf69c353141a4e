"""Scores of a run, and ranks from intervals.

θ of a metric and its 95 % interval are `sme_registry.statistics`' `aggregate` and
`stratified_bootstrap`: the mean over classes of the interquartile mean within a class. It is not
the pooled interquartile mean, which hardly moves when a method gives up a class.
`python -m tests.leaderboard.coverage` measures how often such intervals hold what they should.

Axis letters: `n` runs of a class, `K` metrics, `N` entries of a board.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def run_metrics(
    regret: Sequence[float], similarity: Sequence[float] | None, levels: Sequence[float]
) -> dict[str, float]:
    """The metrics of one run by name, as `result` defines them.

    Args:
      regret: N_m of each region, WD first.
      similarity: mean r̃ of each region in [0, 1]; None where there is no policy.
      levels: ε_m, 0 for WD.

    Returns:
      `wd`, `ood`, `decay` and `slope`, dimensionless, and `points`, in hundredths of r̃. Without
      a policy each is 1 (100 points), whatever N_m: were D that of N_m = 1 everywhere, 0, it would
      pay to leave out runs.
    """
    if similarity is None:
        return {"wd": 1.0, "ood": 1.0, "decay": 1.0, "slope": 1.0, "points": 100.0}
    N, r = np.asarray(regret), np.asarray(similarity)
    offset = np.asarray(levels) - np.mean(levels)
    wd, ood = float(N[0]), float(N[1:].mean())
    return {
        "wd": wd,
        "ood": ood,
        "decay": ood - wd,
        "slope": float(offset @ (N - wd) / (offset @ offset)),  # exactly 0 where N is flat
        "points": 100.0 * float(r[0] - r[1:].mean()),
    }


def rank_ranges(
    low: npt.ArrayLike, high: npt.ArrayLike
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The best and the worst rank that each entry's interval leaves open; lower scores are better.

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
