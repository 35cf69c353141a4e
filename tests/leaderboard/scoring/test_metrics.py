"""The metrics of a run, the intervals over runs, and the ranks that intervals allow."""

import math

import numpy as np
import pytest

from benchmarks.interval_coverage import DISTRIBUTIONS, simulate
from leaderboard.scoring.ranking import rank_ranges, run_metrics
from leaderboard.seasons.cli import table_regret
from leaderboard.seasons.scoring import instances, score_runs
from leaderboard.seasons.season import Place
from sme_registry import evaluate
from sme_registry.seasons.wire import unpack_table
from sme_registry.spec import Setting
from tests.leaderboard.seasons.sealing import MASTER, tiny_season

LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


# One run


def test_metrics_of_a_run_match_a_calculation_by_hand():
    regret, similarity = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), (0.95, 0.9, 0.85, 0.8, 0.75, 0.7)
    actual = run_metrics(regret, similarity, LEVELS)
    assert actual["wd_regret"] == 0.1
    assert actual["ood_regret"] == pytest.approx((0.2 + 0.3 + 0.4 + 0.5 + 0.6) / 5)
    assert actual["ood_decay"] == pytest.approx((0.05 + 0.1 + 0.15 + 0.2 + 0.25) / 0.95 / 5)
    assert run_metrics(regret, similarity, LEVELS, 2)["ood_decay"] == pytest.approx(0.4 - 0.1)
    assert actual["regret_slope"] == pytest.approx(0.1 / 0.2)
    assert actual["similarity_loss"] == pytest.approx(100 * (0.95 - 0.8))


def test_slope_is_that_of_the_least_squares_line():
    regret = np.random.default_rng(1).random(6)
    slope = run_metrics(tuple(regret), tuple(1 - regret), LEVELS)["regret_slope"]
    assert slope == pytest.approx(np.polynomial.Polynomial.fit(LEVELS, regret, 1).convert().coef[1])


# Intervals


@pytest.mark.parametrize(
    ("name", "instances"),
    [("lognormal(1)", 1), ("two humps 80:20", 1), ("20 % failed", 2), ("normal", 10)],
)
def test_intervals_cover_the_truth_and_do_not_separate_equal_methods(name, instances):
    actual = simulate(DISTRIBUTIONS[name], repetitions=400, draws=500, instances=instances)
    # Three standard errors of what 400 methods, or 200 pairs of them, can show.
    slack = 3 * math.sqrt(0.93 * 0.07 / 400)
    assert actual.coverage_of_mean >= 0.93 - slack
    if instances == 1:  # few runs on an instance are trimmed less, so their θ has another limit
        assert actual.coverage >= 0.93 - slack
    assert actual.separated <= 0.02 + 3 * math.sqrt(0.02 * 0.98 / 200)


# Ranks


def test_ranks_match_counting_every_pair():
    rng = np.random.default_rng(5)
    for _ in range(200):
        ends = np.sort(rng.integers(0, 12, size=(rng.integers(1, 15), 2)), axis=1)
        low, high = ends.T
        first = [1 + sum(other < own for other in high) for own in low]
        last = [len(low) - sum(other > own for other in low) for own in high]
        actual = rank_ranges(low, high)
        assert (actual[0].tolist(), actual[1].tolist()) == (first, last)
        assert (actual[0] <= actual[1]).all()
    assert [len(ranks) for ranks in rank_ranges([], [])] == [0, 0]


SEASON = tiny_season("sealed-online")
FIRST, SECOND = instances(SEASON, MASTER, "1", "a" * 64)


def policy(observations):
    """A policy whose actions depend on the state and leave the cube."""
    return 1.5 * observations[:, :1] - 0.2


def test_answers_score_what_their_policy_scores():
    shown = unpack_table(FIRST.challenge, 4)
    assert shown.shape == (300, 4)
    assert shown.dtype == np.float32
    [(run, versions)] = score_runs(FIRST, [(policy(shown), "sha256:" + "1" * 64)])
    report = evaluate(policy, FIRST.spec, FIRST.protocol)
    assert run.normalised_regret == tuple(region.normalised_regret for region in report.regions)
    assert run.similarity == tuple(region.similarity for region in report.regions)
    assert run.spec is None
    assert run.evaluation_seed is None
    assert "numpy" in versions


def test_tasks_and_states_are_an_instances_own_and_a_tickets():
    others = instances(SEASON, MASTER, "2", "a" * 64)
    everyone = [FIRST, SECOND, *others, *instances(SEASON, MASTER, "1", "b" * 64)]
    assert len({each.spec.digest for each in everyone}) == 6
    assert len({each.protocol.seed for each in everyone}) == 6
    assert FIRST.place == Place(SEASON.id, "deep", 0, "1", "a" * 64)
    [again, _] = instances(SEASON, MASTER, "1", "a" * 64)
    assert again.challenge == FIRST.challenge


# A table of the nearest states


def setting(state_dim):
    return Setting(state_dim=state_dim, action_dim=1, complexity=5, hidden_width=16)


def test_more_rows_make_a_better_table_and_one_row_is_enough():
    one, hundred, thousands = (table_regret(setting(2), rows) for rows in (1, 100, 3000))
    assert thousands < hundred < one < 2
