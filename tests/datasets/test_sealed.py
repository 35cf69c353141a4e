"""Sealed data sets: what an agent saw, in Minari's format, and nothing that tells the task."""

import dataclasses
import json
import os

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
def dataset():
    return SealedDataset.collect(RECIPE)


def test_it_holds_what_the_agent_saw(dataset):
    rows = collect(RECIPE, materialize(SPEC))
    for name in ("observations", "actions", "rewards", "next_observations", "terminations"):
        np.testing.assert_array_equal(getattr(dataset, name), getattr(rows, name))
    np.testing.assert_array_equal(dataset.truncations & ~dataset.terminations, rows.timeouts)
    assert (
        set(dataset.columns()) & {"optimal_actions", "regrets", "similarities", "states"} == set()
    )


def test_an_episode_that_ends_at_the_horizon_is_truncated_also_where_it_terminates():
    spec = SPEC.model_copy(update={"horizon": 3, "D": 0.5})
    short = SealedDataset.collect(RECIPE.model_copy(update={"spec": spec}))
    ends = np.flatnonzero(short.terminations | short.truncations)[:-1]
    lengths = np.diff(ends, prepend=-1)
    np.testing.assert_array_equal(short.truncations[ends], lengths == 3)
    assert (short.terminations & short.truncations)[ends].any()


def test_it_is_read_back_bit_for_bit_by_us_and_by_minari(dataset, tmp_path):
    path = dataset.write(ID, tmp_path)
    assert SealedDataset.read(path).digest == dataset.digest
    single = SealedDataset.read(dataset.rounded().write("sealed/autumn/deep-1-v0", tmp_path))
    assert single.rewards.dtype == np.float32
    assert single.digest == dataset.rounded().digest
    assert dataset.agrees_with(single)
    assert SealedDataset.collect(RECIPE).digest == dataset.digest
    other = SealedDataset.collect(RECIPE.model_copy(update={"seed": 1}))
    assert other.digest != dataset.digest
    loaded = minari.MinariDataset(path / "data")
    assert loaded.total_steps == 90
    assert loaded.env_spec is None
    episodes = list(loaded.iterate_episodes())
    assert len(episodes) == loaded.total_episodes > 4
    rewards = np.concatenate([episode.rewards for episode in episodes])
    np.testing.assert_array_equal(rewards, dataset.rewards)
    assert episodes[0].observations.shape == (len(episodes[0]) + 1, 4)


def test_data_sets_agree_up_to_rounding(dataset):
    rounded = dataclasses.replace(dataset, rewards=dataset.rewards + 1e-14)
    assert dataset.agrees_with(rounded)
    assert rounded.digest != dataset.digest
    ends = dataset.truncations.copy()
    ends[0] ^= True
    for other in (
        dataclasses.replace(dataset, rewards=dataset.rewards + 1e-5),
        dataclasses.replace(dataset, truncations=ends),
        SealedDataset(**{name: column[:-1] for name, column in dataset.columns().items()}),
    ):
        assert not dataset.agrees_with(other)


def test_nothing_in_the_files_tells_the_task(dataset, tmp_path):
    path = dataset.write(ID, tmp_path) / "data"
    metadata = json.loads((path / "metadata.json").read_text())
    assert set(metadata) == {
        *("action_space", "data_format", "dataset_id", "dataset_size", "jpeg_encoding"),
        *("minari_version", "observation_space", "total_episodes", "total_steps"),
    }
    names = set()
    attributes = set()
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


def test_nothing_is_replaced_and_a_bad_id_or_file_is_named(dataset, tmp_path):
    path = dataset.write(ID, tmp_path)
    with pytest.raises(NameTakenError, match="already exists"):
        dataset.write(ID, tmp_path)
    with pytest.raises(OptionError, match="must be"):
        dataset.write("no version", tmp_path)
    (path / "data" / "main_data.hdf5").write_bytes(b"garbage")
    with pytest.raises(MalformedDocumentError, match="Download the data set again"):
        SealedDataset.read(path)


def _external(group, secret):
    group.create_dataset("observations", shape=(2, 4), dtype="f4", external=[(str(secret), 0, 32)])


def _linked(group, secret):
    with h5py.File(secret.with_suffix(".hdf5"), "w") as other:
        other["private"] = np.ones((2, 4), "f4")
    group["observations"] = h5py.ExternalLink(str(secret.with_suffix(".hdf5")), "private")


def _references(group, secret):
    group.create_dataset("observations", data=[group.ref, group.ref], dtype=h5py.ref_dtype)


def _made(**options):
    """Observations that are created with these options."""
    return lambda group, _: group.create_dataset("observations", **options)


def stranger(folder):
    """The file of a data set that somebody else has written."""
    (folder / "data").mkdir()
    return h5py.File(folder / "data" / "main_data.hdf5", "w")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (_external, "observations: float32"),
        (_made(shape=(10**11, 4), dtype="f4", chunks=(1000, 4)), "observations: float32"),
        (_made(data=np.zeros((2, 4), "f4"), chunks=(2, 4)), "observations: float32"),
        (_made(shape=(2, 4), dtype="f4"), "observations: float32"),  # no bytes were written
        (_references, "observations: object"),
        (_made(shape=(2,), dtype=h5py.string_dtype()), "observations: object"),
        (_made(data=np.zeros((7, 4), "f4")), "observations are float32"),
        (_made(data=np.zeros((2, 4), "f8")), "observations are float64"),
        (_linked, "observations: is a link"),
        (lambda group, _: group.create_group("observations"), "observations: is no dataset"),
        (lambda group, _: None, "observations is missing"),
        (_made(data=np.zeros((2, 4), "f4")), None),
    ],
)
def test_a_strangers_file_is_read_only_as_it_would_be_written(tmp_path, fault, message):
    secret = tmp_path / "private.txt"
    secret.write_bytes(b"a private file of the entrant ...")
    with stranger(tmp_path) as file:
        group = file.create_group("episode_0")
        fault(group, secret)
        group["actions"] = np.zeros((1, 1), "f4")
        group["rewards"] = np.zeros(1)
        group["terminations"] = group["truncations"] = np.zeros(1, bool)
    if message is None:
        assert len(SealedDataset.read(tmp_path)) == 1
        return
    with pytest.raises(MalformedDocumentError, match=message):
        SealedDataset.read(tmp_path)


def test_an_episode_that_is_a_link_is_not_followed(dataset, tmp_path):
    private = dataset.write(ID, tmp_path / "private") / "data" / "main_data.hdf5"
    with stranger(tmp_path) as file:
        file["episode_0"] = h5py.ExternalLink(str(private), "episode_0")
    with pytest.raises(MalformedDocumentError, match="episode_0: is a link"):
        SealedDataset.read(tmp_path)


def test_an_episode_that_is_no_group_is_named(tmp_path):
    with stranger(tmp_path) as file:
        file["episode_0"] = np.zeros(3)
    with pytest.raises(MalformedDocumentError, match="episode_0: is no group"):
        SealedDataset.read(tmp_path)


def test_a_pipe_is_not_waited_for(tmp_path):
    (tmp_path / "data").mkdir()
    os.mkfifo(tmp_path / "data" / "main_data.hdf5")
    # A writer, so that a reader would fail, and not wait for ever.
    writer = os.open(tmp_path / "data" / "main_data.hdf5", os.O_RDWR)
    try:
        with pytest.raises(MalformedDocumentError, match="no such file"):
            SealedDataset.read(tmp_path)
    finally:
        os.close(writer)


def test_episodes_that_share_their_bytes_do_not_multiply(tmp_path):
    with stranger(tmp_path) as file:
        group = file.create_group("episode_0")
        group["observations"] = np.zeros((20_001, 4), "f4")
        group["actions"] = np.zeros((20_000, 1), "f4")
        group["rewards"] = np.zeros(20_000)
        group["terminations"] = group["truncations"] = np.zeros(20_000, bool)
        for number in range(1, 20):
            file[f"episode_{number}"] = group
    with pytest.raises(MalformedDocumentError, match="does not hold"):
        SealedDataset.read(tmp_path)
