"""The command `sme offline train`."""

import json

import pytest

from sme_registry import save
from sme_registry.datasets import make_dataset
from tests.commands import good, refused
from tests.offline.sets import TINY

pytest.importorskip("minari")
SHORT = ["--steps", "5", "--batch-size", "16", "--evaluations", "1", "--set", "hidden=[8]"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("sets")
    make_dataset(
        TINY, 0.5, transitions=60, protocol={"states_per_region": 20}, name="tiny-v0", folder=place
    )
    return place


@pytest.mark.parametrize("algorithm", ["bc", "iql"])
def test_train_and_evaluate_from_the_command_line(folder, tmp_path, algorithm):
    out, task = tmp_path / "run", tmp_path / "tiny.json"
    named = ("offline", "train", "tiny-v0", "-a", algorithm, "--datasets", folder)
    assert "improvement" in good(*named, "--out", out, *SHORT).stdout
    names = {path.name for path in out.iterdir()}
    assert names >= {"offline.json", "policy.npz", "evaluation.json"}
    save(TINY, task, name="Tiny")
    shown = good("evaluate", out / "policy.npz", task, "--protocol", "quick-v1", "--json")
    assert json.loads(shown.stdout)["policy"] == "policy"


def test_json_is_the_record_and_the_report(folder, tmp_path):
    shown = good(
        "offline", "train", folder / "tiny-v0", "-a", "bc", "--json", "--out", tmp_path / "run",
        *SHORT,
    )  # fmt: skip
    output = json.loads(shown.stdout)
    assert output["run"]["algorithm"] == "bc"
    assert output["run"]["hyperparameters"]["hidden"] == [8]
    assert len(output["evaluation"]["regions"]) == 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tiny-v1"], "is neither the id of a data set"),
        (["tiny-v0", "-a", "ddpg"], "algorithm='ddpg'"),
        (["tiny-v0", "--steps", "0"], "steps=0"),
        (["tiny-v0", "--set", "expectil=1"], "unknown field"),
        (["tiny-v0", "--protocol", "nothing"], "nothing"),
    ],
)
def test_invalid_input_is_refused_and_writes_nothing(folder, tmp_path, arguments, message):
    out = tmp_path / "run"
    assert message in refused("offline", "train", *arguments, "--datasets", folder, "--out", out)
    assert not out.exists()
