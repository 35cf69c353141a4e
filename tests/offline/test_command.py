"""The command `sme offline train`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sme_registry.cli.app import app
from sme_registry.datasets import make_dataset
from tests.offline.sets import TINY

pytest.importorskip("minari")
SHORT = ["--steps", "5", "--batch-size", "16", "--evaluations", "1", "--set", "hidden=[8]"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("sets")
    make_dataset(
        TINY, 0.5, transitions=60, protocol={"states_per_region": 20}, name="tiny-v0", folder=place
    )
    return place


def sme(*arguments: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, list(arguments))
    return done.exit_code, done.stdout, done.stderr


@pytest.mark.parametrize("algorithm", ["bc", "iql"])
def test_train_and_evaluate_from_the_command_line(
    folder: Path, tmp_path: Path, algorithm: str
) -> None:
    out, task = tmp_path / "run", tmp_path / "tiny.json"
    code, stdout, stderr = sme(
        *("offline", "train", "tiny-v0", "-a", algorithm, "--datasets", str(folder)),
        *("--out", str(out), *SHORT),
    )
    assert code == 0, stderr
    assert "improvement" in stdout
    names = {path.name for path in out.iterdir()}
    assert names >= {"offline.json", "policy.npz", "evaluation.json"}
    from sme_registry import save

    save(TINY, task, name="Tiny")
    code, stdout, stderr = sme(
        "evaluate", str(out / "policy.npz"), str(task), "--protocol", "quick-v1", "--json"
    )
    assert code == 0, stderr
    assert json.loads(stdout)["policy"] == "policy"


def test_json_is_the_record_and_the_report(folder: Path, tmp_path: Path) -> None:
    code, stdout, stderr = sme(
        *("offline", "train", str(folder / "tiny-v0"), "-a", "bc", "--json"),
        *("--out", str(tmp_path / "run"), *SHORT),
    )
    assert code == 0, stderr
    output = json.loads(stdout)
    assert output["run"]["algorithm"] == "bc"
    assert output["run"]["hyperparameters"]["hidden"] == [8]
    assert len(output["evaluation"]["regions"]) == 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tiny-v1"], "is neither the id of a data set"),
        (["tiny-v0", "-a", "ddpg"], "algorithm='ddpg'"),
        (["tiny-v0", "--steps", "0"], "steps=0"),
        (["tiny-v0", "--batch-size", "61"], "batch_size=61"),
        (["tiny-v0", "--set", "expectil=1"], "unknown field"),
        (["tiny-v0", "--protocol", "nothing"], "nothing"),
    ],
)
def test_invalid_input_gives_one_line_and_exit_code_2(
    folder: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    out = tmp_path / "run"
    code, stdout, stderr = sme(
        "offline", "train", *arguments, "--datasets", str(folder), "--out", str(out)
    )
    assert code == 2
    assert message in stderr
    assert "Traceback" not in stderr
    assert not stdout
    assert not out.exists()
