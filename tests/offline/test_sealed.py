"""Learners on sealed data sets: the same policies as on the same rows with their task."""

import numpy as np
import pytest

from sme_registry.datasets import DatasetRecipe, SealedDataset, collect
from sme_registry.errors import OptionError, UnknownNameError
from sme_registry.offline import OfflinePolicy, train_offline, train_sealed
from sme_registry.task import materialize
from tests.commands import good, refused
from tests.offline.sets import TINY

RECIPE = DatasetRecipe.from_dict(
    {
        "spec": TINY.to_dict(),
        "behaviours": [{"kind": "mixture", "nu": 0.5}],
        "transitions": 200,
    }
)
SHORT = {"steps": 20, "batch_size": 32, "hyperparameters": {"hidden": [16]}}


@pytest.fixture(scope="module")
def dataset():
    return SealedDataset.collect(RECIPE)


@pytest.mark.parametrize("algorithm", ["bc", "iql"])
def test_the_policy_is_that_of_the_same_rows_with_their_task(dataset, algorithm):
    rows = collect(RECIPE, materialize(TINY))
    protocol = {"states_per_region": 50}
    known = train_offline(
        rows, algorithm=algorithm, spec=TINY, protocol=protocol, evaluations=1, episodes=1, **SHORT
    ).policy
    hidden = train_sealed(dataset, algorithm=algorithm, **SHORT)
    for mine, theirs in zip(hidden.layers, known.layers, strict=True):
        for one, other in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(one, other)
    about = {"algorithm": algorithm, "seed": 0, "steps": 20, "dataset_digest": dataset.digest}
    assert hidden.about == about  # and no digest of a spec


def test_the_progress_is_reported_of_all_steps_and_faults_are_named(dataset):
    calls = []
    longer = {**SHORT, "steps": 60}
    train_sealed(dataset, algorithm="bc", progress=lambda *done: calls.append(done), **longer)
    assert calls == [(50, 60), (60, 60)]
    with pytest.raises(UnknownNameError):
        train_sealed(dataset, algorithm="ppo")
    with pytest.raises(OptionError, match="batch_size"):
        train_sealed(dataset, batch_size=201)


def test_the_command_writes_a_policy(dataset, tmp_path):
    folder, target = dataset.write("sealed/autumn/deep-0-v0", tmp_path), tmp_path / "deep-0.npz"
    command = ["offline", "sealed", folder, "-o", target, "-n", "20", "--batch-size", "32"]
    good(*command, "--set", "hidden=[16]")
    policy, expected = OfflinePolicy.load(target), train_sealed(dataset, **SHORT)
    np.testing.assert_array_equal(
        policy(dataset.observations[:8]), expected(dataset.observations[:8])
    )
    assert str(target) in refused(*command).replace("\n", "")
