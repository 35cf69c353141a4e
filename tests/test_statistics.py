"""Statistics over runs: against hand-computed values, and the formulas of Agarwal et al. 2021."""

import itertools

import numpy as np
import pytest
import scipy.stats

from sme_registry import statistics

CLASSES = {
    "easy": np.array([[0.1, 1.0], [0.2, 3.0], [0.15, 2.0], [0.9, 2.5], [0.12, 1.5]]),
    "hard": np.array([[0.5, 2.0], [0.7, 8.0], [0.6, 4.0]]),
    "one": np.array([[0.4, 1.0]]),
}

# What the leaderboard has computed for them, with 400 draws and the seed "seed".
GOLDEN = (
    [0.18188150111927803, 1.256840920051007],
    [0.5892296099918332, 3.8542701910601047],
)


def scores(seed, *shape):
    return np.asarray(np.random.default_rng(seed).random(shape))


# The oracle: what rliable computes of `[runs, tasks]`, written out.


def oracle_profile(runs, tau):
    return float(np.mean([np.mean(column > tau) for column in runs.T]))


def oracle_gap(runs, target):
    return float(target - np.mean(np.minimum(runs, target)))


def oracle_improvement(x, y):
    """The mean over tasks of the Mann-Whitney U over the number of pairs."""
    found = [
        scipy.stats.mannwhitneyu(a, b, alternative="greater").statistic / (len(a) * len(b))
        for a, b in zip(x.T, y.T, strict=True)
    ]
    return float(np.mean(found))


def by_task(runs):
    return {str(task): column for task, column in enumerate(runs.T)}


@pytest.mark.parametrize(
    ("runs", "expected"),
    [([5.0], 5.0), ([1, 2, 6], 3.0), ([9, 1, 2, 4], 3.0), ([100, 1, 2, 3, 4, 5, 6, -50], 3.5)],
)
def test_the_iqm_leaves_out_a_quarter_of_the_runs_at_each_end(runs, expected):
    assert statistics.iqm(runs) == expected
    assert statistics.iqm(runs) == pytest.approx(scipy.stats.trim_mean(runs, 0.25))


def test_the_optimality_gap_gives_no_credit_above_the_target_and_medians_are_between_two():
    assert statistics.optimality_gap([0.5, 0.8, 3.0]) == pytest.approx(0.7 / 3)
    runs = 2.0 * scores(0, 7, 4)
    assert statistics.optimality_gap(runs, 1.2).mean() == pytest.approx(oracle_gap(runs, 1.2))
    assert statistics.median([4.0, 1.0, 2.0, 8.0]) == 3.0


def test_classes_count_alike_however_many_runs_they_have():
    assert statistics.aggregate(CLASSES) == pytest.approx(
        [((0.12 + 0.15 + 0.2) / 3 + 0.6 + 0.4) / 3, (2.0 + 14 / 3 + 1.0) / 3]
    )


def test_an_interval_is_the_same_on_every_machine_and_of_its_seed():
    low, high = statistics.stratified_bootstrap(CLASSES, 400, "seed")
    assert low.tolist() == pytest.approx(GOLDEN[0], abs=1e-12)
    assert high.tolist() == pytest.approx(GOLDEN[1], abs=1e-12)
    other, _ = statistics.stratified_bootstrap(CLASSES, 400, "another")
    assert np.any(other != low)


def test_an_interval_does_not_depend_on_the_order_of_classes_or_on_drawing_in_parts(monkeypatch):
    whole = statistics.stratified_bootstrap(CLASSES, 300, "s")
    turned = {name: CLASSES[name] for name in reversed(CLASSES)}
    found = statistics.stratified_bootstrap(turned, 300, "s")
    assert np.array(found) == pytest.approx(np.array(whole), abs=1e-12)
    monkeypatch.setattr(statistics, "_MAX_NUMBERS", 70)
    assert np.array_equal(whole, statistics.stratified_bootstrap(CLASSES, 300, "s"))


@pytest.mark.parametrize(
    "statistic", [statistics.mean, statistics.median, statistics.optimality_gap, statistics.iqm]
)
def test_every_statistic_is_resampled_as_the_whole_class_would_be(statistic):
    """Of two runs there are four samples: the interval is known from listing them."""
    runs = np.array([[0.2], [0.8]])
    low, high = statistics.stratified_bootstrap({"": runs}, 4000, "s", statistic)
    centre = float(statistic(runs)[0])
    found = [float(statistic(runs[list(pick)])[0]) for pick in itertools.product((0, 1), repeat=2)]
    arm = np.sqrt(2.0) * max(max(found) - centre, centre - min(found))
    assert [low[0], high[0]] == pytest.approx([centre - arm, centre + arm])


@pytest.mark.parametrize("others", [{}, {"b": np.array([[0.1]])}])
def test_single_runs_have_no_interval(others):
    classes = {"a": np.array([[0.3]]), **others}
    assert np.isnan(statistics.stratified_bootstrap(classes, 100, "s")).all()
    columns = {name: runs[:, 0] for name, runs in classes.items()}
    profile = statistics.performance_profile(columns, [0.2], 100, "s")
    better = statistics.probability_of_improvement(columns, columns, 100, "s")
    for estimate in (profile, better):
        assert np.isfinite(estimate.value).all()
        assert np.isnan([estimate.low, estimate.high]).all()


def test_intervals_of_five_runs_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(0)
    low, high = statistics.stratified_bootstrap({"": rng.normal(size=(5, 2000))}, 500, "s")
    assert 0.93 < np.mean((low <= 0.0) & (high >= 0.0)) < 0.99


def test_a_performance_profile_is_the_share_of_runs_above():
    runs, taus = scores(1, 6, 3), np.linspace(0.0, 1.0, 11)
    found = statistics.performance_profile(by_task(runs), taus, 200, "s")
    assert found.value == pytest.approx([oracle_profile(runs, tau) for tau in taus])
    assert np.all(np.diff(found.value) <= 0.0)
    assert np.all((found.low >= 0.0) & (found.low <= found.value) & (found.value <= found.high))
    assert np.all(found.high <= 1.0)
    exact = statistics.performance_profile({"": np.array([0.2, 0.5])}, [0.2, 0.5], 50, "s")
    assert exact.value.tolist() == [0.5, 0.0]  # strictly above


def test_the_probability_of_improvement_is_the_mann_whitney_statistic():
    x, y = scores(2, 6, 4).round(1), scores(3, 5, 4).round(1)  # rounded: some are ties
    found = statistics.probability_of_improvement(by_task(x), by_task(y), 500, "s")
    assert float(found.value[0]) == pytest.approx(oracle_improvement(x, y))
    turned = statistics.probability_of_improvement(by_task(y), by_task(x), 500, "s")
    assert float(turned.value[0]) == pytest.approx(1.0 - float(found.value[0]))
    assert 0.0 <= found.low[0] < found.value[0] < found.high[0] <= 1.0


def test_the_interval_of_an_improvement_is_as_wide_as_resampling_both_methods_makes_it():
    x, y = by_task(scores(4, 8, 2)), by_task(scores(5, 8, 2))
    found = statistics.probability_of_improvement(x, y, 4000, "s")
    rng = np.random.default_rng(0)
    drawn = [
        np.mean([
            np.mean(rng.choice(x[task], 8)[:, None] > rng.choice(y[task], 8)) for task in x
        ])
        for _ in range(4000)
    ]  # fmt: skip
    low, high = np.quantile(drawn, [0.025, 0.975]) - found.value[0]
    arm = np.sqrt(8 / 7) * max(-low, high)
    assert float(found.high[0] - found.value[0]) == pytest.approx(arm, rel=0.06)


def test_runs_that_all_agree_are_no_certainty_and_equal_ones_improve_half_of_the_time():
    x, y = {"": np.array([0.8, 0.9, 1.0])}, {"": np.array([0.1, 0.2, 0.3])}
    found = statistics.probability_of_improvement(x, y, 100, "s")
    assert found.value == found.high == 1.0
    assert found.low == pytest.approx(0.025 ** (1 / 3))
    turned = statistics.probability_of_improvement(y, x, 100, "s")
    assert turned.value == turned.low == 0.0
    assert turned.high == pytest.approx(1.0 - 0.025 ** (1 / 3))
    runs = {"": np.full(4, 0.5)}
    found = statistics.probability_of_improvement(runs, runs, 100, "s")
    assert found.value == found.low == found.high == 0.5
