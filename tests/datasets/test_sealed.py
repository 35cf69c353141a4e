"""Sealed data sets: what an agent saw, in Minari's format, and nothing that tells the task."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.datasets import DatasetRecipe, SealedDataset, collect
from sme_registry.errors import MalformedDocumentError, NameTakenError, OptionError

SEED = "0x" + "ab" * 32
SPEC = SMESpec(
    state_dim=2, action_dim=1, complexity=5, hidden_width=8, horizon=20, D=0.1, seed=SEED
)
RECIPE = DatasetRecipe.from_dict(
    {
        "spec": SPEC.to_dict(),
        "behaviours": [{"kind": "mixture", "nu": 0.5}],
        "transitions": 90,
        "seed": 123456789,
    }
)
ID = "sealed/autumn/deep-0-v0"


@pytest.fixture(scope="module")
def dataset() -> SealedDataset:
    return SealedDataset.collect(RECIPE)


def test_it_holds_what_the_agent_saw(dataset: SealedDataset) -> None:
    rows = collect(RECIPE, materialize(SPEC))
    for name in ("observations", "actions", "rewards", "next_observations", "terminations"):
        np.testing.assert_array_equal(getattr(dataset, name), getattr(rows, name))
    np.testing.assert_array_equal(dataset.truncations & ~dataset.terminations, rows.timeouts)
    assert (
        set(dataset.columns()) & {"optimal_actions", "regrets", "similarities", "states"} == set()
    )


def test_it_is_read_back_bit_for_bit(dataset: SealedDataset, tmp_path: Path) -> None:
    path = dataset.write(ID, tmp_path)
    assert SealedDataset.read(path).digest == dataset.digest
    assert SealedDataset.collect(RECIPE).digest == dataset.digest
    other = SealedDataset.collect(RECIPE.model_copy(update={"seed": 1}))
    assert other.digest != dataset.digest


def test_minari_loads_it(dataset: SealedDataset, tmp_path: Path) -> None:
    loaded = minari.MinariDataset(dataset.write(ID, tmp_path) / "data")
    assert loaded.total_steps == 90
    assert loaded.env_spec is None
    episodes = list(loaded.iterate_episodes())
    assert len(episodes) == loaded.total_episodes > 4
    rewards = np.concatenate([episode.rewards for episode in episodes])
    np.testing.assert_array_equal(rewards, dataset.rewards)
    assert episodes[0].observations.shape == (len(episodes[0]) + 1, 4)


def test_nothing_in_the_files_tells_the_task(dataset: SealedDataset, tmp_path: Path) -> None:
    path = dataset.write(ID, tmp_path) / "data"
    metadata = json.loads((path / "metadata.json").read_text())
    assert set(metadata) == {
        *("action_space", "data_format", "dataset_id", "dataset_size", "jpeg_encoding"),
        *("minari_version", "observation_space", "total_episodes", "total_steps"),
    }
    names: set[str] = set()
    attributes: set[str] = set()
    with h5py.File(path / "main_data.hdf5") as file:
        attributes |= set(file.attrs)
        for episode in file.values():
            attributes |= set(episode.attrs)
            episode.visititems(lambda name, _: names.add(name))
    assert names == {
        *("actions", "infos", "observations", "rewards", "terminations", "truncations"),
    }
    assert attributes == {"id", "total_steps"}
    everything = b"".join(file.read_bytes() for file in tmp_path.rglob("*") if file.is_file())
    secrets = (SEED, SPEC.digest, RECIPE.digest, str(RECIPE.seed), SPEC.content_name)
    for secret in secrets:
        for text in (secret, secret.removeprefix("0x").removeprefix("sha256:")):
            assert text.encode() not in everything
    assert bytes.fromhex("ab" * 32) not in everything
    assert "ab" * 32 not in repr(dataset)


def test_nothing_is_replaced_and_a_bad_id_or_file_is_named(
    dataset: SealedDataset, tmp_path: Path
) -> None:
    path = dataset.write(ID, tmp_path)
    with pytest.raises(NameTakenError, match="already exists"):
        dataset.write(ID, tmp_path)
    with pytest.raises(OptionError, match="must be"):
        dataset.write("no version", tmp_path)
    (path / "data" / "main_data.hdf5").write_bytes(b"garbage")
    with pytest.raises(MalformedDocumentError, match="Download the data set again"):
        SealedDataset.read(path)
