"""Runs that repeat one policy are refused, whatever their bytes; honest runs are not."""

import functools

import numpy as np
import pytest

from leaderboard.errors import Rejection
from leaderboard.scoring.score import CONSTANT, FLOOR, Behaviours
from sme_registry import EvaluationProtocol
from sme_registry.evaluation import reference_policy
from tests.leaderboard.conftest import suite_of

PROTOCOL = EvaluationProtocol(states_per_region=100)


def plane(**setting):
    return suite_of(a=(1, {"action_dim": 2, "complexity": 3, **setting})).instances[0]


SPEC = plane()
OPTIMUM = reference_policy("optimal", SPEC)


def network(seed, hidden=32):
    """A network fitted to 400 optimal actions: random features, and least squares on them."""
    rng = np.random.default_rng(seed)
    s = np.concatenate([rng.random((400, 2)), np.zeros((400, 2))], axis=1)
    W, b = 3 * rng.normal(size=(4, hidden)), rng.normal(size=hidden)
    features = np.maximum(s @ W + b, 0.0)
    V = np.linalg.lstsq(features, OPTIMUM(s) - 0.5, rcond=1e-3)[0]
    return [W, b, V]


def act(o, W, b, V):
    return np.maximum(o.astype(float) @ W + b, 0.0) @ V + 0.5


def policy(weights):
    return functools.partial(act, W=weights[0], b=weights[1], V=weights[2])


def permuted(weights):
    W, b, V = weights
    order = np.random.default_rng(0).permutation(len(b))
    return [W[:, order], b[order], V[order]]


def rescaled(weights):
    W, b, V = weights
    factor = np.random.default_rng(0).uniform(0.2, 5.0, len(b))
    return [W * factor, b * factor, V / factor[:, None]]


def noisy(weights, noise, seed=0):
    rng = np.random.default_rng(seed)
    return [each * (1 + noise * rng.normal(size=each.shape)) for each in weights]


def observed(*policies, spec=SPEC, submission="one"):
    behaviours = Behaviours(PROTOCOL, submission)
    return [behaviours.observe(f"runs.{i}", spec, each) for i, each in enumerate(policies)]


def refused(*policies, spec=SPEC):
    try:
        observed(*policies, spec=spec)
    except Rejection as error:
        return error.code == "run_repeated"
    return False


ORIGINAL = network(0)
COPIES = {
    "the same": ORIGINAL,
    "permuted": permuted(ORIGINAL),
    "rescaled": rescaled(ORIGINAL),
    "0.1 % noise": noisy(ORIGINAL, 0.001),
}


@pytest.mark.parametrize("name", COPIES)
def test_one_policy_in_other_bytes_is_one_run(name):
    with pytest.raises(Rejection, match=r"of runs\.1 in the same states") as caught:
        observed(policy(network(1)), policy(ORIGINAL), policy(COPIES[name]))
    assert caught.value.code == "run_repeated"


def test_equal_actions_of_two_submissions_have_one_digest_and_other_actions_another():
    (one,), (other,) = observed(policy(ORIGINAL)), observed(policy(ORIGINAL), submission="two")
    assert one == other
    assert len({one, *observed(policy(noisy(ORIGINAL, 1e-5)))}) == 2
    assert observed(policy(ORIGINAL), spec=plane(complexity=2)) != [one]


def test_independent_trainings_are_runs():
    policies = [policy(network(seed)) for seed in range(6)]
    assert len(set(observed(*policies))) == 6
    weak = [policy([W, b, 0.02 * V]) for W, b, V in map(network, range(4))]  # hardly trained
    assert not refused(*weak)


def test_a_copy_that_differs_only_outside_the_cube_is_refused():
    def other_outside(o):
        outside = (np.abs(o[:, :2] - 0.5).max(axis=1) > 0.5)[:, None]
        return np.where(outside, policy(network(1))(o), policy(ORIGINAL)(o))

    assert refused(policy(ORIGINAL), other_outside)


def test_near_optimal_copies_are_refused_and_near_optimal_networks_are_not():
    assert refused(OPTIMUM, lambda o: OPTIMUM(o) + FLOOR / 2)
    wave = [lambda o, k=k: OPTIMUM(o) + 2e-3 * np.sin(9 * o[:, :2] + k) for k in range(3)]
    assert not refused(*wave)


def test_runs_that_collapsed_to_one_constant_are_no_repetition():
    corner = [lambda o, k=k: np.full((len(o), 2), [1.0 + k, -3.0 - k]) for k in range(5)]
    almost = [lambda o, k=k: 0.3 + CONSTANT * np.sin(o[:, :2] + k) for k in range(3)]
    assert observed(*corner, *almost) == [None] * 8


def test_a_saturated_policy_that_depends_on_the_state_is_compared():
    def bang(o):
        return (o[:, :2] > 0.4) * 1.0

    assert refused(bang, lambda o: 3 * bang(o) - 1)


def test_the_policies_of_teams_are_compared():
    agents = [{"name": f"agent_{i}", "action_dim": 1} for i in range(2)]
    spec = plane(team={"agents": agents})

    def shared(number):
        rng = np.random.default_rng(number)
        W = rng.normal(size=(6, 1))
        return lambda o: 0.5 + 0.2 * np.sin(o @ W)

    assert not refused(shared(0), shared(1), spec=spec)
    assert refused(shared(0), shared(0), spec=spec)
