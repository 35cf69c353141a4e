"""Rows of a data set as positions in episodes, from which values are exact."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from sme_registry import SMESpec, materialize, values
from sme_registry.datasets import DatasetRecipe, collect, positions
from sme_registry.errors import SpecError

SPEC = SMESpec(state_dim=3, action_dim=2, horizon=30, k=4, seed=4)


def made(spec):
    mixture = {"kind": "mixture", "nu": 0.6}
    recipe = DatasetRecipe(spec=spec, behaviours=[mixture], transitions=90, seed=1)
    return collect(recipe, materialize(spec))


def policy(observations):
    """Row by row, so that no batch changes a bit."""
    return 0.4 * observations[:, :2] + 0.3 * observations[:, 3:4]


def test_a_value_from_a_row_is_its_reward_and_the_value_of_the_next_row():
    transitions, rows = made(SPEC), np.array([2, 31, 45, 88])
    where = positions(transitions, SPEC, rows)
    np.testing.assert_array_equal(where["t"], rows % 30)
    owed = [transitions.step_rewards[row - row % 30 % 4 : row].sum() for row in rows]
    np.testing.assert_allclose(where["accumulated"], owed, atol=1e-6)
    actions = transitions.actions[rows].astype(np.float64)
    first = values(SPEC, policy, **where, gamma=1.0, actions=actions)
    after = {
        "states": transitions.next_states[rows],
        "t": where["t"] + 1,
        "accumulated": transitions.next_observations[rows, 4].astype(np.float64) * 4,
    }
    rest = values(SPEC, policy, **after, gamma=1.0)
    np.testing.assert_allclose(first, transitions.rewards[rows] + rest, atol=1e-5)


def test_positions_are_found_behind_what_the_agent_sees():
    spec = SPEC.derive(observation={"distractors": 3, "mixing": "orthogonal"})
    found, expected = (positions(made(each), each) for each in (spec, SPEC))
    for name in ("states", "t", "accumulated"):
        np.testing.assert_array_equal(found[name], expected[name])
    assert found["accumulated"].max() > 1.0


def test_a_teams_rows_are_no_positions():
    agents = [{"name": f"agent_{i}", "action_dim": 1} for i in range(2)]
    spec = SPEC.derive(team={"agents": agents})
    with pytest.raises(SpecError, match="of a single agent"):
        positions(made(spec), spec)


def test_many_states_at_different_times_keep_their_order():
    spec = SMESpec(state_dim=2, action_dim=1, horizon=4)
    states, t = np.random.default_rng(1).random((5000, 2)), np.arange(5000) % 4
    found = values(spec, lambda o: np.full((len(o), 1), 0.5), states, t=t, gamma=1.0)
    last = t == 3
    expected = materialize(spec).step_reward(states[last], np.full((last.sum(), 1), 0.5))
    np.testing.assert_allclose(found[last], expected, atol=1e-12)


def test_fitted_q_and_exact_returns_rank_policies_equally():
    example = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples" / "ope.py"))
    returns = example["compare"](SMESpec(), nu=1.0, seed=0, rows=4000)
    estimates, truths = ({name: row[i] for name, row in returns.items()} for i in (0, 1))
    assert sorted(estimates, key=estimates.__getitem__) == sorted(truths, key=truths.__getitem__)
    # Near the data it is right to a tenth; of the optimum, off them, it knows far too little.
    near, far = "half optimal, half ½", "optimal"
    assert estimates[near] == pytest.approx(truths[near], rel=0.1)
    assert truths[far] == pytest.approx(10.0, abs=1e-3)  # Σ 0.9^i over 100 steps
    assert estimates[far] < 0.85 * truths[far]
