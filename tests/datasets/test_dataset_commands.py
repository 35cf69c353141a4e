"""The command `sme data`."""

import copy
import json
import shutil

import numpy as np
import pytest

from sme_registry.datasets import make_dataset, open_dataset
from sme_registry.errors import OptionError
from tests import commands

NAME = "sme/Default-v1-nu50-seed7-v0"


def good(*arguments):
    return commands.good("data", *arguments)


def refused(*arguments):
    return " ".join(commands.refused("data", *arguments).split())


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def test_make_list_show_and_validate():
    result = good("make", "Default", "--nu", "0.5", "-n", "300", "--seed", "7")
    assert "300 of 300 transitions" in result.stderr
    assert "constant ½" in result.stdout
    listed = good("list").stdout
    assert NAME in listed
    assert "300" in listed
    stdout = good("show", NAME).stdout
    assert "300 in 3 trajectories" in stdout
    assert open_dataset(NAME).record.arrays_digest in stdout
    assert "valid" in good("check", NAME).stdout


def test_json_prints_only_the_record():
    made = json.loads(good("make", "Default", "-n", "50", "--seed", "7", "--json").stdout)
    assert made["id"] == NAME
    assert made["nu"] == 0.5
    assert made["seeds"] == {"task": 0, "data": 7}
    assert made["scores"]["optimum"]["rollouts"]["mean_return"] == 100.0
    assert json.loads(good("show", NAME, "--json").stdout) == made
    assert json.loads(good("list", "--json").stdout) == [made]
    assert json.loads(good("check", NAME, "--json").stdout)[0]["valid"] is True


def test_make_accepts_a_mix_a_field_a_name_and_a_folder():
    good("make", "Default", "--mix", "nu=0.5:0.7", "--mix", "random:0.3", "-n", "40",
         "--set", "complexity=2", "--coverage", "-0.05", "--name", "me/mixed-v1", "--out", "sets",
         "--protocol", "quick-v1")  # fmt: skip
    recipe = open_dataset("me/mixed-v1", "sets").recipe
    assert recipe.shares == (28, 12)
    assert recipe.spec.complexity == 2
    assert recipe.coverage == -0.05
    assert "sets/me/mixed-v1" in good("check", "sets/me/mixed-v1").stdout
    assert "no data sets" in good("list").stderr


def test_a_policys_onnx_acts_as_its_zip(tmp_path):
    for package in ("onnx", "onnxruntime"):
        pytest.importorskip(package)
    from stable_baselines3 import TD3

    import sme_registry
    from sme_registry.io import sha256_of

    env = sme_registry.make("Default", action_range="symmetric")
    narrow = {"net_arch": [8]}
    model = TD3("MlpPolicy", env, seed=0, buffer_size=1, device="cpu", policy_kwargs=narrow)
    model.save(tmp_path / "mine.zip")
    sme_registry.export_onnx(model, "Default", tmp_path / "mine.onnx")
    sets = {}
    for suffix in ("zip", "onnx"):
        good("make", "Default", "--mix", f"policy=mine.{suffix}:1", "-n", "60",
             "--name", f"sme/{suffix}-v0")  # fmt: skip
        sets[suffix] = open_dataset(f"sme/{suffix}-v0")
    for suffix, made in sets.items():
        assert "valid" in good("check", f"sme/{suffix}-v0").stdout
        (behaviour,) = made.recipe.behaviours
        assert behaviour.policy == "mine"
        assert behaviour.sha256 == sha256_of((tmp_path / f"mine.{suffix}").read_bytes())
    # A later step doubles a difference in the last bit; the first few are the same to rounding.
    one, other = (made.transitions().actions[:5] for made in sets.values())
    np.testing.assert_allclose(one, other, atol=1e-5)
    assert np.ptp(one) > 0.01


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--nu", "1.5"], "nu=1.5: must be in [0, 1]"),
        (["--mix", "nu=0.5:0.7", "--mix", "random:0.2"], "0.7 + 0.2 = 0.9: must add up to 1"),
        (["--mix", "half:1"], "--mix 'half:1': must be nu=NU:WEIGHT"),
        (["--mix", "policy=no.zip:1"], "no.zip: cannot be read: No such file"),
        (["--nu", "0.5", "--mix", "random:1"], "give only one of them"),
        (["--name", "a.b-v0"], "name='a.b-v0': must be [namespace/]name-v<number>"),
        (["--coverage", "-0.99"], "coverage=-0.99: 50 transitions"),
        (["--protocol", "paper-v9"], "'paper-v9': no protocol"),
        (["--action-range", "wide"], "action_range='wide': must be 'unit' or 'symmetric'"),
        (["--action-range", "unit"], "action_range='unit': is of policies in `mix`. Leave it out."),
    ],
)
def test_invalid_input_gives_one_line_and_writes_nothing(arguments, message, tmp_path):
    counted = [] if "-n" in arguments else ["-n", "50"]
    assert message in refused("make", "Default", *counted, *arguments)
    assert not (tmp_path / "minari").exists()


def test_a_copy_under_another_name_is_neither_listed_nor_valid(tmp_path):
    good("make", "Default", "-n", "50")
    own = "sme/Default-v1-nu50-seed0-v0"
    shutil.copytree(tmp_path / "minari" / own, tmp_path / "minari/sme/Copy-v0")
    listed = good("list")
    assert listed.stdout.count(own) == 1
    stderr = " ".join(listed.stderr.split())
    assert "invalid:" in stderr
    back = tmp_path / "minari" / own
    assert f"sme/Copy-v0: contains the data set {own}. Move or copy it back to {back}, or" in stderr
    assert [found["id"] for found in json.loads(good("list", "--json").stdout)] == [own]
    for name in ("sme/Copy-v0", "minari/sme/Copy-v0"):
        assert f"Copy-v0: contains the data set {own}" in commands.sme("data", "check", name).stdout
    shutil.copytree(tmp_path / "minari" / own, tmp_path / "backup" / own)
    good("check", own, f"minari/{own}", f"backup/{own}")


def test_a_mix_without_shares_is_refused():
    for mix in ([0.5, 0.5], 1, {"random": 1.0}):
        with pytest.raises(OptionError, match="must be pairs of a policy and its share"):
            make_dataset("Default", mix=mix)
    with pytest.raises(OptionError, match="name='3': must be"):
        make_dataset("Default", name=3)
    with pytest.raises(OptionError, match="mix='random': must be pairs of a policy and its share"):
        make_dataset("Default", mix="random")


def test_broken_data_sets_are_named_and_the_others_are_listed_and_checked(tmp_path):
    import h5py

    for name in ("sme/good-v0", "sme/bad-v0"):
        good("make", "Default", "-n", "50", "--name", name)
    with h5py.File(tmp_path / "minari/sme/bad-v0/data/main_data.hdf5", "r+") as file:
        file["episode_0/rewards"][0] = 1.0
    result = commands.sme("data", "check", "sme/bad-v0", "sme/good-v0", "sme/none-v0", "--json")
    assert result.exit_code == 2
    assert [checked["valid"] for checked in json.loads(result.stdout)] == [False, True, False]
    document = tmp_path / "minari/sme/good-v0/data/metadata.json"
    before = json.loads(document.read_text())
    for name, field in (("behaviour", "similarity"), ("constant", "step_reward")):
        after = copy.deepcopy(before)
        after["sme"]["scores"][name][field] = 0.125
        document.write_text(json.dumps(after))
        printed = commands.sme("data", "check", "sme/good-v0").stdout
        assert f"scores.{name}.{field}=0.125: must be" in " ".join(printed.split())
    document.write_text(json.dumps(before))
    (tmp_path / "minari/sme/bad-v0/data/metadata.json").write_text("{")
    result = good("list")
    assert "sme/good-v0" in result.stdout
    assert "bad-v0" not in result.stdout
    assert "invalid:" in result.stderr
    assert "bad-v0" in result.stderr


@pytest.mark.parametrize("command", ["list", "show", "check"])
def test_readers_name_the_folder_of_data_sets(command):
    assert "--datasets" in good(command, "--help").stdout
    name = () if command == "list" else (NAME,)
    assert "--out" in refused(command, *name, "--out", "data")
    good("make", "Default", "-n", "50", "--seed", "7", "--out", "data")
    assert NAME in good(command, *name, "--datasets", "data").stdout
