"""Regions: exact, uniform by volume, on the float32 grid, from streams of their own."""

import numpy as np
import pytest
from scipy import stats

from sme_registry.errors import OptionError
from sme_registry.evaluation import references
from sme_registry.evaluation.regions import Points, expansion
from sme_registry.spec import EvaluationProtocol, SMESpec
from sme_registry.task import materialize
from tests.evaluation.kinds import observations

SIGNIFICANCE = 1e-3  # of each test below; the seeds are fixed, so it fails always or never


def drawn(region, state_dim, rows=None, **fields):
    protocol = EvaluationProtocol(**{"states_per_region": 20_000, **fields})
    spec = SMESpec(state_dim=state_dim)
    return observations(protocol, region, spec, rows)


def states(region, state_dim, **fields):
    return drawn(region, state_dim, **fields)[:, :state_dim].astype(np.float64)


def in_their_shell(E, epsilons, region):
    low, high = EvaluationProtocol(epsilons=epsilons).edges[region]
    return ((low < E) & (high >= E)).all()


@pytest.mark.parametrize("state_dim", [1, 2, 8, 64, 2000])
@pytest.mark.parametrize("region", [1, 5])
def test_every_state_of_a_shell_is_in_its_half_open_shell(region, state_dim):
    E = expansion(states(region, state_dim, states_per_region=2_000))
    assert in_their_shell(E, EvaluationProtocol().epsilons, region)


@pytest.mark.parametrize(
    "epsilons", [(1e-6,), (0.2, 0.2000005), (3.0, 3.000002), (1e-7, 2e-7, 1.0)]
)
def test_a_thin_shell_loses_no_state_to_rounding(epsilons):
    region = len(epsilons)
    assert in_their_shell(expansion(states(region, 8, epsilons=epsilons)), epsilons, region)


def test_states_within_distribution_fill_the_unit_cube_uniformly():
    s = states(0, 3)
    assert s.min() >= 0.0
    assert s.max() <= 1.0
    for channel in s.T:
        assert stats.kstest(channel, "uniform").pvalue > SIGNIFICANCE


def test_a_state_beside_the_opposite_face_is_not_rounded_over_it():
    # The float32 grid is finer below 0 than above 1, so both faces must be brought to the same E.
    epsilons = (0.2, 0.2000005)
    points = Points(EvaluationProtocol(epsilons=epsilons), 2, 8, "a stream")
    for u in (2.0**-53, 1.0 - 2.0**-53):
        E = expansion(points.in_shell(np.full((20_000, 8), u)).astype(np.float64))
        assert in_their_shell(E, epsilons, 2)


def test_a_shell_without_a_float32_number_is_refused():
    with pytest.raises(OptionError, match="no float32 observation lies in the shell"):
        drawn(2, 8, epsilons=(0.2, 0.2 + 1e-9))


@pytest.mark.parametrize("state_dim", [1, 3, 8, 64])
@pytest.mark.parametrize("region", [1, 5])
def test_expansion_levels_follow_the_shell_volume(region, state_dim):
    low, high = (1.0 + level for level in EvaluationProtocol().edges[region])

    def share_within(E):
        return ((1.0 + E) ** state_dim - low**state_dim) / (high**state_dim - low**state_dim)

    E = expansion(states(region, state_dim))
    assert stats.kstest(E, share_within).pvalue > SIGNIFICANCE


@pytest.mark.parametrize("state_dim", [2, 4])
def test_shell_states_are_distributed_as_by_rejection(state_dim):
    low, high = EvaluationProtocol().edges[2]
    rng = np.random.default_rng(1)
    half = (1.0 + high) / 2.0
    cube = 0.5 + rng.uniform(-half, half, size=(200_000, state_dim))
    rejected = cube[expansion(cube) > low][:20_000]
    assert len(rejected) == 20_000

    s = states(2, state_dim)
    directions = np.vstack([np.eye(state_dim), np.ones(state_dim), np.arange(state_dim) - 0.7])
    for direction in directions:
        test = stats.ks_2samp(s @ direction, rejected @ direction)
        assert test.pvalue > SIGNIFICANCE
    smaller, of_rejected = (np.sort(np.abs(x - 0.5), axis=1)[:, 0] for x in (s, rejected))
    assert stats.ks_2samp(smaller, of_rejected).pvalue > SIGNIFICANCE


def test_time_input_is_uniform_over_the_steps_and_independent_of_the_state():
    batch = drawn(1, 8)
    steps = batch[:, 8].astype(np.float64) * 100
    assert np.abs(steps - steps.round()).max() < 1e-4
    counts = np.bincount(steps.round().astype(int), minlength=100)
    assert len(counts) == 100
    assert stats.chisquare(counts).pvalue > SIGNIFICANCE
    assert (batch[:, 9] == 0.0).all()  # the accumulated reward
    batch = drawn(0, 2)
    assert abs(np.corrcoef(batch[:, :3].T)[2, :2]).max() < 4 / np.sqrt(len(batch))


@pytest.mark.parametrize("region", [0, 4])
def test_states_do_not_depend_on_the_batch_size_and_fewer_are_the_first_of_more(region):
    whole = drawn(region, 5, rows=20_000)
    assert np.array_equal(whole, drawn(region, 5, rows=777))
    assert np.array_equal(whole, drawn(region, 5))
    assert np.array_equal(whole[:100], drawn(region, 5, states_per_region=100))


def test_regions_and_seeds_have_states_of_their_own():
    first = states(1, 4)
    assert np.array_equal(first, states(1, 4))
    assert not np.isin(first[:, 0], states(1, 4, seed=1)[:, 0]).all()
    inner, outer = (np.sign(states(region, 4) - 0.5) for region in (1, 2))
    assert abs((inner * outer).mean()) < 0.02  # would be 1 if both used the same numbers


TASK = materialize(SMESpec(state_dim=3, action_dim=2, complexity=5))


@pytest.fixture(scope="module")
def solved():
    s = np.random.default_rng(0).random((5_000, 3))
    return s, TASK.optimal_action(s)


def test_best_constant_cannot_be_improved_in_any_channel(solved):
    s, optimal = solved[0], solved[1] ** 3  # skewed, so that median and mean differ
    constant = references.fit(TASK, s, optimal).constant
    least = np.abs(constant - optimal).mean(axis=0)
    for moved in (constant - 0.01, constant + 0.01, np.full(2, 0.5), optimal.mean(axis=0)):
        assert (least <= np.abs(moved - optimal).mean(axis=0)).all()


def actions_of(fitted, s, optimal, random):
    """The actions of every reference in these states."""
    known = references.Knowledge(TASK, s, lambda: fitted, lambda *shape: random, optimal)
    return references.actions(known, references.NAMES)


def test_linear_policy_is_the_least_squares_fit_within_the_action_range(solved):
    s, optimal = solved
    fitted = references.fit(TASK, s, optimal)
    residual = (s - 0.5) @ fitted.slope + fitted.intercept - optimal
    assert np.abs(residual.mean(axis=0)).max() < 1e-12
    assert np.abs(s.T @ residual / len(s)).max() < 1e-12
    far = 0.5 + 20.0 * (s - 0.5)
    clipped = actions_of(fitted, far, optimal, optimal)["linear"]
    assert (clipped.min(), clipped.max()) == (0.0, 1.0)
    affine = (s - 0.5) @ np.random.default_rng(1).uniform(-0.1, 0.1, (3, 2)) + [0.4, 0.6]
    fitted = references.fit(TASK, s, affine)
    recovered = actions_of(fitted, s, affine, affine)["linear"]
    assert np.abs(recovered - affine).max() < 1e-12
