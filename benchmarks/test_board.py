"""A board's rankings and intervals: how they grow with the entries, and against SciPy."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from scipy import stats

from leaderboard.scoring.ranking import ranking
from sme_registry.statistics import stratified_bootstrap
from tests.leaderboard.scoring.test_ranking import entry, scores

ENTRIES, PART, DRAWS = 1000, 100, 10_000


@pytest.mark.parametrize("metric", ["wd_regret", "ood_decay"])
def test_the_time_of_a_ranking_grows_with_its_length(compare: Any, metric: Any) -> None:
    rng = random.Random(0)
    entries = [entry(index, scores(rng.random() / 3, rng.random())) for index in range(ENTRIES)]

    def whole(times: int) -> None:
        for _ in range(times):
            assert len(ranking(entries, metric)) == ENTRIES

    def parts(times: int) -> None:
        for _ in range(times):
            for first in range(0, ENTRIES, PART):
                ranking(entries[first : first + PART], metric)

    # A ranking by decay compares every pair of entries in all regions.
    target = 0.5 if metric == "wd_regret" else 0.25
    title = f"ranking of {ENTRIES:,} by {metric}"
    compare(title, "ranking", whole, 1, {f"{ENTRIES // PART} of {PART}": (parts, 1, target)})


def test_the_bootstrap_of_a_board(compare: Any) -> None:
    rng = np.random.default_rng(0)
    classes = {f"class{index}": rng.lognormal(size=(10, 11)) for index in range(6)}

    def ours(times: int) -> None:
        for _ in range(times):
            stratified_bootstrap(classes, DRAWS, "a")

    def trimmed(sample: Any, axis: int) -> Any:
        return stats.trim_mean(sample, 0.25, axis=axis)

    def scipy(times: int) -> None:
        for _ in range(times):
            for runs in classes.values():
                stats.bootstrap((runs,), trimmed, n_resamples=DRAWS, method="percentile", axis=0)

    title = f"bootstrap, 6 classes × 10 runs × 11 scores, {DRAWS:,} draws"
    compare(title, "board", ours, 1, {"scipy.stats.bootstrap": (scipy, 1, 1.0)})
