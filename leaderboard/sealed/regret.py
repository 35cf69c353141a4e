"""`measured_steps`: the regret of the steps that a ticket took, from its journal.

    normalised online regret = Σ regret / Σ regret of the constant ½ in the same states

over the budget, and over each part of it. Steps that were not taken count like the constant's: what
took a share f of its steps, with the ratio q, has f q + 1 − f. Steps at the end of the budget into
which no request of all lanes fits cannot be taken, and do not count.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from leaderboard.documents.result import Stepping
from leaderboard.sealed.journal import Journal
from leaderboard.sealed.stepping import Lanes, Start

MOST_PARTS = 100
Array = npt.NDArray[np.float64]


def measured_steps(start: Start, journal: Journal | None, budget: int) -> Stepping:
    """Replay a journal, and measure its regret.

    Args:
      start: of the instance.
      journal: of its steps; None if the instance was never started.
      budget: steps that could be taken, over all lanes.
    """
    if journal is None:
        nothing = (1.0,) * min(MOST_PARTS, budget)
        return Stepping(steps=0, normalised_online_regret=1.0, learning_curve=nothing)
    lanes = Lanes(start, journal.lanes)
    requests = budget // journal.lanes
    parts = min(MOST_PARTS, requests)
    part_of = np.arange(requests) * parts // requests
    sums = np.zeros((parts, 3))  # regret, that of the constant ½, requests
    for part, actions in zip(part_of, journal.actions(), strict=False):
        _, regret = lanes.step_with_regret(actions)
        sums[part] += (*regret, 1.0)
    return Stepping(
        steps=journal.steps,
        normalised_online_regret=_ratio(sums.sum(axis=0), requests),
        learning_curve=tuple(map(_ratio, sums, np.bincount(part_of))),
    )


def _ratio(sums: Array, possible: int) -> float:
    """Regret relative to the constant's, from `sums` of both and of the requests taken."""
    regret, half, taken = map(float, sums)
    share = taken / float(possible)
    # The constant has no regret only where π* is ½ throughout, and so has none either.
    return share * (regret / half if half > 0.0 else 0.0) + 1.0 - share
