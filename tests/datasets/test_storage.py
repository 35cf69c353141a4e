"""Data sets on disk: Minari reads them, writes are atomic, and changes are detected."""

import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest

import sme_registry
from sme_registry.datasets import make_dataset, open_dataset, replay, storage
from sme_registry.datasets.collect import collect
from sme_registry.datasets.storage import list_datasets
from sme_registry.errors import (
    DigestMismatchError,
    MalformedDocumentError,
    NameTakenError,
    OptionError,
    SMEError,
    SpecError,
    UnknownNameError,
)
from sme_registry.task import materialize

NAME = "sme/tests-v0"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder with one set; tests that change anything copy it."""
    folder = tmp_path_factory.mktemp("root")
    make_dataset("Default", mix=[(0.5, 0.5), ("random", 0.5)], transitions=250, seed=7,
                 name=NAME, folder=folder)  # fmt: skip
    return folder


@pytest.fixture
def copied(root, tmp_path):
    shutil.copytree(root, tmp_path / "root")
    return tmp_path / "root"


@pytest.fixture
def minaris(root, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))


def run(script, *arguments, **options):
    """A script in a fresh process."""
    env = {**os.environ, "PYTHONPATH": str(Path(sme_registry.__file__).parents[1])}
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), *map(str, arguments)],
        env=env, capture_output=True, text=True, timeout=300, check=False, **options,
    )  # fmt: skip


def visible(folder):
    """What Minari and we list there, and whether anything is left that neither does."""
    os.environ["MINARI_DATASETS_PATH"], before = str(folder), os.environ.get("MINARI_DATASETS_PATH")
    try:
        theirs = set(minari.list_local_datasets())
    finally:
        del os.environ["MINARI_DATASETS_PATH"]
        if before is not None:
            os.environ["MINARI_DATASETS_PATH"] = before
    ours, broken = list_datasets(folder)
    assert theirs == {dataset.id for dataset in ours}
    assert not broken
    return theirs


def edited(folder, change):
    path = folder / NAME / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    change(metadata)
    path.write_text(json.dumps(metadata))


class TestReading:
    @pytest.mark.parametrize("kind", ["plain", "limited and distracted"])
    def test_transitions_are_read_bit_for_bit(self, kind, root, tmp_path):
        spec = {
            "safety": {"tightness": 0.2},
            "observation": {"distractors": 3, "mixing": "nonlinear", "mixing_depth": 1},
            "shaping": {"scale": 3},
            "noise": {"reward": 0.3, "transition": 0.1},
        }
        dataset = (
            open_dataset(NAME, root)
            if kind == "plain"
            else make_dataset(spec, 0.5, transitions=150, folder=tmp_path)
        )
        task = materialize(dataset.recipe.spec)
        read, generated = dataset.transitions(), collect(dataset.recipe, task)
        for name, array in generated.columns().items():
            np.testing.assert_array_equal(getattr(read, name), array, strict=True)
        assert read.digest == dataset.record.arrays_digest
        replay(read, dataset.recipe, task)
        if kind == "plain":
            return
        loaded = dataset.minari()
        assert loaded.observation_space.shape == (13,)
        episode = loaded[0]
        np.testing.assert_array_equal(episode.infos["cost"][:-1], read.costs[:100])
        np.testing.assert_array_equal(episode.infos["limit"][:-1], read.limits[:100])
        np.testing.assert_array_equal(episode.infos["distractors"][1:], read.next_distractors[:100])
        np.testing.assert_array_equal(episode.truncations, read.timeouts[:100])
        env = loaded.recover_environment()
        assert env.unwrapped.sme_spec == dataset.recipe.spec
        env.reset(options={name: episode.infos[name][0] for name in ("state", "distractors")})
        _, _, _, _, info = env.step(episode.actions[0])
        assert info["cost"] == read.costs[0]

    def test_a_termination_at_the_horizon_is_a_truncation_too_behind_distractors(self, tmp_path):
        spec = {"horizon": 1, "D": 0.9, "observation": {"distractors": 2}}
        dataset = make_dataset(spec, 1.0, transitions=20, folder=tmp_path)
        assert dataset.transitions().terminations.any()
        assert all(episode.truncations.all() for episode in dataset.minari())

    def test_a_set_is_opened_by_its_id_and_by_any_of_its_paths(self, root, minaris):
        opened = [
            open_dataset(NAME),
            open_dataset(NAME, root),
            open_dataset(root / NAME),
            open_dataset(str(root / NAME / "data")),
        ]
        assert {dataset.id for dataset in opened} == {NAME}

    def test_minari_loads_it_by_its_id_and_aligns_it(self, root, minaris):
        transitions = open_dataset(NAME, root).transitions()
        loaded = minari.load_dataset(NAME)
        assert (loaded.total_steps, loaded.total_episodes) == (250, 4)
        first = 0
        for episode in loaded:
            rows = slice(first, first + len(episode))
            assert len(episode.observations) == len(episode) + 1
            assert {len(info) for info in episode.infos.values()} == {len(episode) + 1}
            np.testing.assert_array_equal(episode.observations[:-1], transitions.observations[rows])
            np.testing.assert_array_equal(
                episode.observations[1:], transitions.next_observations[rows]
            )
            np.testing.assert_array_equal(episode.actions, transitions.actions[rows])
            np.testing.assert_array_equal(episode.infos["regret"][:-1], transitions.regrets[rows])
            np.testing.assert_array_equal(episode.infos["state"][1:], transitions.next_states[rows])
            np.testing.assert_array_equal(episode.truncations, transitions.timeouts[rows])
            first += len(episode)
        assert first == 250

    def test_the_environment_is_recovered_in_a_fresh_process_that_knows_no_id(self, root):
        script = """
            import json, sys
            import gymnasium, minari
            assert "sme_registry" not in sys.modules
            assert not any(name.startswith("SME/") for name in gymnasium.registry)
            dataset = minari.MinariDataset(sys.argv[1])
            env = dataset.recover_environment()
            episode = dataset[0]
            env.reset(options={"state": episode.infos["state"][0]})
            total = 0.0
            for t, action in enumerate(episode.actions):
                observation, reward, *_, info = env.step(action)
                assert (observation == episode.observations[t + 1]).all()
                assert reward == episode.rewards[t] and info["regret"] == episode.infos["regret"][t]
            print(env.unwrapped.sme_spec.digest)
        """
        done = run(script, root / NAME / "data", cwd="/")
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip() == sme_registry.load("Default").digest

    def test_a_team_has_joint_actions_and_one_reward_and_no_gymnasium_environment(self, tmp_path):
        dataset = make_dataset("Team2", 0.5, transitions=150, folder=tmp_path)
        spec, transitions = dataset.recipe.spec, dataset.transitions()
        assert transitions.actions.shape == (150, spec.action_dim)
        assert transitions.observations.shape == (150, spec.state_dim + 1 + 2)
        assert transitions.regrets.shape == (150, 2)
        np.testing.assert_allclose(
            transitions.rewards, transitions.agent_rewards.mean(axis=1), atol=1e-12
        )
        replay(transitions, dataset.recipe, materialize(spec))
        loaded = dataset.minari()
        assert loaded.action_space.shape == (spec.action_dim,)
        assert loaded[0].infos["agent_reward"].shape == (101, 2)
        with pytest.raises(ValueError, match="cannot be recovered"):
            loaded.recover_environment()
        assert sme_registry.make_parallel(open_dataset(dataset.path).recipe.spec).sme_spec == spec


class TestTheSameCommand:
    def test_gives_the_same_bytes_in_two_processes(self, root, tmp_path):
        script = """
            import sys
            from sme_registry.datasets import make_dataset
            make_dataset("Default", mix=[(0.5, 0.5), ("random", 0.5)], transitions=250, seed=7,
                         name="sme/tests-v0", folder=sys.argv[1])
        """
        done = run(script, tmp_path)
        assert done.returncode == 0, done.stderr
        for file in ("main_data.hdf5", "metadata.json"):
            first, second = (folder / NAME / "data" / file for folder in (root, tmp_path))
            assert first.read_bytes() == second.read_bytes()


class TestNames:
    @pytest.mark.parametrize(
        "name",
        ["", "x", "a b-v0", "a.b-v0", "s/x-v0", "/x-v0", "../x-v0", "a//b-v0", "ä-v0",
         "sme/data/x-v0", "x-v0\n"],
    )  # fmt: skip
    def test_invalid_names_are_rejected_before_any_work(self, name, tmp_path):
        with pytest.raises(OptionError, match="name="):
            make_dataset("Default", transitions=10, name=name, folder=tmp_path)
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("name", ["x-v0", "my/x-v3", "a/-b/x_Y-v12", "ns/deep/er/x-v0"])
    def test_minari_lists_every_accepted_name(self, name, tmp_path):
        try:
            storage.check_id(name)
        except OptionError:
            with pytest.raises(ValueError, match="Malformed"):
                minari.dataset.minari_dataset.parse_dataset_id(name)
            return
        make_dataset("Default", transitions=10, name=name, folder=tmp_path)
        assert visible(tmp_path) == {name}

    def test_a_set_inside_another_would_never_be_listed_and_is_refused(self, root):
        with pytest.raises(OptionError, match="Minari lists none inside another"):
            make_dataset("Default", transitions=10, name=f"{NAME}/x-v0", folder=root)

    @pytest.mark.parametrize(
        ("arguments", "name"),
        [
            ({"nu": 0.5, "seed": 7}, "sme/Default-v1-nu50-seed7-v0"),
            ({"nu": 0.125, "coverage": -0.2}, "sme/Default-v1-nu12_5-side80-seed0-v0"),
            ({"mix": [("random", 1.0)]}, "sme/Default-v1-random-seed0-v0"),
        ],
    )
    def test_the_default_name_describes_the_data_set(self, arguments, name, tmp_path):
        assert make_dataset("Default", transitions=10, folder=tmp_path, **arguments).id == name


class TestAnExistingSet:
    def test_is_refused_and_left_as_it_is_without_force(self, copied):
        before = (copied / NAME / "data" / "main_data.hdf5").read_bytes()
        with pytest.raises(NameTakenError, match=r"already exists, with another .*--name"):
            make_dataset("Default", 0.1, transitions=10, name=NAME, folder=copied)
        same = {"mix": [(0.5, 0.5), ("random", 0.5)], "transitions": 250, "seed": 7}
        with pytest.raises(NameTakenError, match="already exists, with the same recipe"):
            make_dataset("Default", **same, name=NAME, folder=copied)
        edited(copied, lambda data: data["sme"].update(recipe_digest="sha256:" + "0" * 64))
        with pytest.raises(NameTakenError, match=r"already exists\. Give another --name"):
            make_dataset("Default", transitions=10, name=NAME, folder=copied)  # cannot be opened
        assert (copied / NAME / "data" / "main_data.hdf5").read_bytes() == before
        make_dataset("Default", 0.1, transitions=10, name=NAME, folder=copied, force=True)
        assert open_dataset(NAME, copied).recipe.transitions == 10
        folders = [child.name for child in (copied / "sme").iterdir() if child.is_dir()]
        assert folders == ["tests-v0"]

    @pytest.mark.parametrize("foreign", ["empty", "minari's", "a file"])
    def test_of_another_package_is_never_replaced(self, foreign, tmp_path):
        place = tmp_path / NAME
        if foreign == "a file":
            place.parent.mkdir(parents=True)
            place.write_text("mine")
        else:
            (place / "data").mkdir(parents=True)
        if foreign == "minari's":
            (place / "data" / "metadata.json").write_text('{"dataset_id": "sme/tests-v0"}')
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(NameTakenError, match="not a data set of this package"):
            make_dataset("Default", transitions=10, name=NAME, folder=tmp_path, force=True)
        assert sorted(tmp_path.rglob("*")) == before


KILLED = """
    import os, signal, sys
    from sme_registry.datasets import make_dataset
    calls = []
    def die(*_):
        calls.append(1)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGKILL)
    os.fsync = die
    make_dataset("Default", 0.5, transitions=300, name="sme/tests-v0", folder=sys.argv[1])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals and limits")
class TestAWriterThatFails:
    def test_killed_in_mid_write_leaves_nothing_that_is_listed(self, tmp_path):
        killed = run(KILLED, tmp_path)
        assert killed.returncode == -signal.SIGKILL, killed.stderr
        assert any(path.name == "main_data.hdf5" for path in tmp_path.rglob("*"))  # in mid-write
        assert visible(tmp_path) == set()
        make_dataset("Default", 0.5, transitions=300, name=NAME, folder=tmp_path)
        assert visible(tmp_path) == {NAME}

    def test_a_full_disk_gives_one_line_and_leaves_nothing(self, tmp_path):
        script = (
            "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (60 * 1024, 60 * 1024)); "
            "from sme_registry.cli import main; import sys; "
            "sys.argv[1:] = ['data', 'make', 'Default', '-n', '300', '--out', sys.argv[1]]; "
            "main()"
        )
        done = run(script, tmp_path)
        assert done.returncode == 2, done.stderr
        assert "cannot be written: File too large" in done.stderr
        assert "Traceback" not in done.stderr
        assert visible(tmp_path) == set()
        assert not [path for path in tmp_path.rglob("*") if path.suffix == ".hdf5"]


class TestAChangedSet:
    def test_with_a_changed_number_is_rejected(self, copied):
        with h5py.File(copied / NAME / "data" / "main_data.hdf5", "r+") as file:
            file["episode_1/infos/regret"][3] += 1e-9
        with pytest.raises(DigestMismatchError, match=r"its arrays have sha256:.* as generated"):
            open_dataset(NAME, copied).transitions()

    @pytest.mark.parametrize("attribute", ["id", "total_steps"])
    def test_with_a_changed_attribute_is_rejected(self, attribute, copied):
        with h5py.File(copied / NAME / "data" / "main_data.hdf5", "r+") as file:
            file["episode_1"].attrs[attribute] += 1
        with pytest.raises(MalformedDocumentError, match=f"episode_1: {attribute}="):
            open_dataset(NAME, copied).transitions()

    def test_with_a_changed_row_that_repeats_another_is_rejected(self, copied):
        with h5py.File(copied / NAME / "data" / "main_data.hdf5", "r+") as file:
            file["episode_1/infos/regret"][-1] += 1e-9
        with pytest.raises(MalformedDocumentError, match="last row of regret"):
            open_dataset(NAME, copied).transitions()

    def test_with_a_flipped_bit_that_changes_no_array_is_rejected(self, copied):
        path = copied / NAME / "data" / "main_data.hdf5"
        path.write_bytes(path.read_bytes() + b"\0")
        with pytest.raises(DigestMismatchError, match="other bytes than were written"):
            open_dataset(NAME, copied).transitions()

    @pytest.mark.parametrize("content", ["", "[]", '{"a": '])
    def test_with_a_broken_namespace_is_listed_as_broken(self, content, copied):
        (copied / "sme" / "namespace_metadata.json").write_text(content)
        datasets, broken = list_datasets(copied)
        assert not datasets
        assert "namespace_metadata.json" in broken[copied / NAME]

    def test_extended_by_minari_is_rejected_and_minari_can_read_it(self, copied):
        loaded = open_dataset(NAME, copied).minari()
        episode = loaded[0]
        loaded.update_dataset_from_buffer(
            [
                minari.data_collector.EpisodeBuffer(
                    observations=episode.observations, actions=episode.actions,
                    rewards=episode.rewards, terminations=episode.terminations,
                    truncations=episode.truncations, infos=episode.infos,
                )
            ]
        )  # fmt: skip
        assert minari.MinariDataset(copied / NAME / "data").total_steps == 350
        with pytest.raises(DigestMismatchError, match="total_steps=350: must be 250"):
            open_dataset(NAME, copied)

    def test_with_a_wrong_digest_or_a_changed_spec_is_rejected(self, copied):
        path = copied / NAME / "data" / "metadata.json"
        whole = path.read_text()
        for field in ("spec_digest", "recipe_digest", "protocol_digest"):
            path.write_text(whole)
            edited(copied, lambda data, f=field: data["sme"].update({f: "sha256:" + "0" * 64}))
            with pytest.raises(DigestMismatchError, match=field):
                open_dataset(NAME, copied)
        path.write_text(whole)
        edited(copied, lambda data: data["sme"]["recipe"]["spec"].update(complexity=10))
        with pytest.raises(DigestMismatchError, match="recipe_digest"):
            open_dataset(NAME, copied)
        path.write_text(whole)
        edited(copied, lambda data: data.pop("sme"))
        with pytest.raises(MalformedDocumentError, match="Minari can open it"):
            open_dataset(NAME, copied)
        assert list_datasets(copied) == ([], {})

    @pytest.mark.parametrize(("version", "age"), [(0, "an older"), (2, "a newer")])
    def test_of_another_schema_is_rejected_and_not_modified(self, version, age, copied):
        edited(copied, lambda data: data["sme"].update(schema_version=version, other_fields=1))
        before = sorted((path, path.stat().st_mtime_ns) for path in copied.rglob("*"))
        with pytest.raises(SpecError, match=f"schema_version={version}: must be 1.*{age} version"):
            open_dataset(NAME, copied)
        datasets, broken = list_datasets(copied)
        assert datasets == []
        assert list(broken) == [copied / NAME]
        assert sorted((path, path.stat().st_mtime_ns) for path in copied.rglob("*")) == before

    def test_with_an_invalid_record_is_rejected(self, copied):
        path = copied / NAME / "data" / "metadata.json"
        whole = path.read_text()
        for change in (
            lambda record: record.clear(),
            lambda record: record.pop("scores"),
            lambda record: record.update(unknown=1),
            lambda record: record.update(trajectories="4"),
            lambda record: record["recipe"]["behaviours"][0].update(nu=2.0),
        ):
            path.write_text(whole)
            edited(copied, lambda data, change=change: change(data["sme"]))
            with pytest.raises(SMEError, match="sme"):
                open_dataset(NAME, copied)

    def test_with_data_that_is_not_hdf5_or_not_whole_cannot_be_read(self, copied):
        path = copied / NAME / "data" / "main_data.hdf5"
        whole = path.read_bytes()
        with h5py.File(path, "r+") as file:
            del file["episode_2/infos/regret"]
        contents = (b"", b"\x89HDF\r\n\x1a\n", b"no HDF5 at all" * 100, whole[: len(whole) // 2])
        for content in (path.read_bytes(), *contents):
            path.write_bytes(content)
            with pytest.raises(MalformedDocumentError, match="cannot be read"):
                open_dataset(NAME, copied).transitions()


def test_a_symbolic_link_in_the_place_of_a_set_is_followed(copied, tmp_path):
    (copied / NAME).rename(tmp_path / "elsewhere")
    (copied / NAME).symlink_to(tmp_path / "elsewhere")
    datasets, broken = list_datasets(copied)
    assert [dataset.id for dataset in datasets] == [NAME]
    assert not broken


def test_an_unknown_id_suggests_a_similar_one(root):
    with pytest.raises(UnknownNameError, match=r"Did you mean 'sme/tests-v0'"):
        open_dataset("sme/test-v0", root)


def test_a_missing_folder_has_no_data_sets(tmp_path):
    assert list_datasets(tmp_path / "none") == ([], {})
