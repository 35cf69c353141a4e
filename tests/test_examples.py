"""The examples run, and name the packages that they lack; the players of a season learn."""

import importlib.util
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sme_registry import SMESpec, materialize
from sme_registry.datasets import DatasetRecipe, SealedDataset

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PPO_EXAMPLES = [example for example in EXAMPLES if example.stem.endswith("_ppo")]


def run(*arguments):
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.mark.parametrize(
    ("example", "arguments", "code", "message"),
    [
        *((path.name, ["--help"], 0, "usage:") for path in EXAMPLES if path not in PPO_EXAMPLES),
        ("torchrl_team.py", [], 2, "tensordict is not installed. Run `pip install torchrl`."),
        ("torchrl_team.py", ["--steps", "0"], 2, "--steps must be at least 1"),
    ],
)
def test_without_torchrl_an_example_helps_or_says_what_is_wrong(
    example, arguments, code, message, monkeypatch, capsys
):
    for package in ("tensordict", "torchrl"):
        monkeypatch.setitem(sys.modules, package, None)  # its import fails
    monkeypatch.setattr(sys, "argv", [example, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "examples" / example), run_name="__main__")
    assert ended.value.code == code
    printed = capsys.readouterr()
    assert message in printed.out + printed.err


@pytest.mark.parametrize("example", PPO_EXAMPLES, ids=lambda path: path.stem)
def test_ppo_of_a_framework_lowers_the_exact_regret(example):
    """Where the framework is missing, the example says so in one line."""
    done = run(example, "--steps", "2048")
    print(done.stdout)  # for `make frameworks`
    missing = r"\S+ is not installed\. .*docs/guides/training\.md .*\n"
    if re.fullmatch(missing, done.stderr):
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    exploring = [float(value) for value in re.findall(r"exploring: regret (\S+)", done.stdout)]
    before, after = (float(value) for value in re.findall(r"WD regret ([0-9.]+)", done.stdout))
    assert exploring[-1] < exploring[0]
    assert after < 0.8 * before


def test_the_torchrl_example_trains():
    pytest.importorskip("torchrl")
    done = run(ROOT / "examples" / "torchrl_team.py", "--env", "Team2", "--steps", "2048")
    assert done.returncode == 0, done.stderr
    before, after = (
        [float(value) for value in line.split()[3:]]
        for line in done.stdout.splitlines()
        if "mean actions" in line
    )
    assert len(before) == len(after) == 2
    assert all(end < 0.7 * start for start, end in zip(before, after, strict=True))


def test_the_sb3_contrib_example_trains_all_algorithms(monkeypatch, capsys):
    pytest.importorskip("sb3_contrib")
    example = ROOT / "examples" / "sb3_contrib_cell.py"
    monkeypatch.syspath_prepend(example.parent)  # its own algorithm is named by its module
    monkeypatch.setattr(sys, "argv", [str(example), "--env", "Plane1", "--steps", "64"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(example), run_name="__main__")
    rows = [line[:12].strip() for line in capsys.readouterr().out.splitlines()]
    assert rows == ["algorithm", "PPO", "TRPO", "TRPO (wide)", "linear"]


FOLDER = Path(__file__).resolve().parents[1] / "examples" / "season"
FIELDS = {"action_dim": 2, "complexity": 5, "policy_init": "unit_variance"}
SPEC = SMESpec.from_dict({**FIELDS, "seed": 3})


@pytest.fixture(scope="module")
def family():
    pytest.importorskip("torch")
    name = "season_family"
    found = importlib.util.spec_from_file_location(name, FOLDER / "family.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules[name] = module  # its annotations are looked up there
    found.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data():
    recipe = {"behaviours": [{"kind": "mixture", "nu": 0.5}], "transitions": 1500, "seed": 1}
    return SealedDataset.collect(DatasetRecipe.from_dict({"spec": SPEC.to_dict(), **recipe}))


@pytest.mark.parametrize("policy_init", ["semi_orthogonal", "unit_variance"])
def test_a_guess_with_the_weights_of_a_task_is_its_optimum(family, policy_init):
    import torch

    task = materialize(SPEC.model_copy(update={"policy_init": policy_init}))
    guess = family.Optimum(task.spec, 0)
    states = np.random.default_rng(0).uniform(-0.5, 1.5, (200, SPEC.state_dim))
    observations = np.hstack([states, np.zeros((200, 2))]).astype(np.float32)
    assert np.abs(guess.act(observations) - task.optimal_action(states)).max() > 0.3
    rows = policy_init == "unit_variance"
    [layers] = task.policies
    for own, layer in zip(guess.weights, layers, strict=True):
        found, drawn = (sizes(each, rows) for each in (own.detach().numpy(), layer.W))
        np.testing.assert_allclose(found, drawn, rtol=1e-5)
        own.data = torch.tensor(layer.W, dtype=torch.float32)
    np.testing.assert_allclose(guess.act(observations), task.optimal_action(states), atol=1e-5)


def sizes(W, rows):
    """The norms of a matrix's rows, or its singular values: what the family fixes."""
    return np.linalg.norm(W, axis=1) if rows else np.linalg.svd(W, compute_uv=False)


def test_rewards_are_distances_to_the_optimum(family, data):
    rows = family.Rows.of(data.observations, data.actions, data.rewards)
    optimum = materialize(SPEC).optimal_action(data.observations[:, :-2].astype(float))
    distances = np.abs(data.actions - optimum).mean(axis=1)
    np.testing.assert_allclose(rows.distances, np.minimum(distances, 0.25), atol=1e-5)


def test_the_family_is_fitted_to_a_data_set(family, data, monkeypatch):
    import torch

    torch.manual_seed(0)
    monkeypatch.setattr(family, "OFFLINE_STEPS", 200)
    guess = family.learn(data, SPEC, seed=0)
    states = np.random.default_rng(0).random((500, SPEC.state_dim + 2)).astype(np.float32)
    optimum = materialize(SPEC).optimal_action(states[:, :-2].astype(float))
    regret = np.abs(guess.act(states) - optimum).mean() / np.abs(0.5 - optimum).mean()
    assert regret < 0.5
