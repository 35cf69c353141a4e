"""`Transitions` and its conversion for d3rlpy: all rows are aligned."""

import dataclasses

import numpy as np
import pytest

from sme_registry.datasets import DatasetRecipe, to_d3rlpy
from sme_registry.datasets.collect import collect
from sme_registry.datasets.recipe import parse_behaviour
from sme_registry.spec import SMESpec
from sme_registry.task import materialize


def made(**fields):
    spec = SMESpec(horizon=20, **fields)
    recipe = DatasetRecipe(spec=spec, behaviours=(parse_behaviour(0.8),), transitions=250)
    return collect(recipe, materialize(spec))


@pytest.fixture(scope="module")
def fragile():
    """Trajectories that terminate, that time out, and one that is cut."""
    found = made(D=0.05)
    assert found.terminations.any()
    assert found.timeouts.any()
    return found


def test_the_digest_covers_every_array_its_name_type_and_shape(fragile):
    digests = {fragile.digest}
    for name, array in fragile.columns().items():
        changed = array.copy()
        changed.reshape(-1).view(np.uint8)[0] ^= 1
        digests.add(dataclasses.replace(fragile, **{name: changed}).digest)
    assert len(digests) == 1 + len(fragile.columns())
    swapped = dataclasses.replace(
        fragile, rewards=fragile.similarities, similarities=fragile.rewards
    )
    wider = dataclasses.replace(fragile, rewards=fragile.rewards.astype(np.float32))
    assert len({fragile.digest, swapped.digest, wider.digest}) == 3


def test_ends_delimit_the_trajectories(fragile):
    lengths = np.diff([0, *fragile.ends])
    np.testing.assert_array_equal(np.bincount(fragile.episodes), lengths)
    assert fragile.ends[-1] == len(fragile) == 250


def test_d3rlpy_gets_aligned_rows(fragile):
    given = to_d3rlpy(fragile)
    assert {len(array) for array in given.values()} == {250}
    np.testing.assert_array_equal(given["observations"], fragile.observations)
    np.testing.assert_array_equal(given["actions"], fragile.actions)
    np.testing.assert_array_equal(given["terminals"] > 0, fragile.terminations)
    np.testing.assert_array_equal(given["timeouts"] > 0, fragile.timeouts)
    assert not (given["terminals"] * given["timeouts"]).any()


def test_with_final_observations_each_timeout_has_its_successor(fragile):
    given = to_d3rlpy(fragile, final_observations=True)
    added = given["timeouts"] > 0
    assert added.sum() == fragile.timeouts.sum()
    assert {len(array) for array in given.values()} == {250 + int(added.sum())}
    np.testing.assert_array_equal(given["observations"][~added], fragile.observations)
    np.testing.assert_array_equal(given["actions"][~added], fragile.actions)
    np.testing.assert_array_equal(given["terminals"][~added] > 0, fragile.terminations)
    successors = np.roll(given["observations"], -1, axis=0)[~added]
    going_on = ~fragile.terminations
    np.testing.assert_array_equal(successors[going_on], fragile.next_observations[going_on])
    assert not given["rewards"][added].any()


def test_d3rlpy_gets_copies(fragile):
    for final_observations in (False, True):
        given = to_d3rlpy(fragile, final_observations=final_observations)
        before = fragile.digest
        for array in given.values():
            array[:] = -1.0
        assert fragile.digest == before
