"""Subjects, the command, and the files that it writes."""

import importlib.util
import json
import shutil

import numpy as np
import pytest

import sme_registry
from sme_registry.diagnosis import Diagnosis, behaviour, diagnose, load_policy, load_run
from sme_registry.errors import DigestMismatchError, OptionError, PolicyError, UnknownNameError
from sme_registry.studies.subject import load_cell
from sme_registry.wrappers import RecordRegret
from tests.commands import good, refused
from tests.diagnosis.policies import SPEC, diagnosis_of, faults, shrunk
from tests.geometry import assert_readable

SHORT = ("--states", "256", "--episodes", "8")


def shown(*arguments):
    """What a short diagnosis prints as JSON."""
    return json.loads(good("diagnose", *arguments, *SHORT, "--json").stdout)


def test_what_cannot_be_diagnosed_is_rejected(tmp_path):
    with pytest.raises(OptionError, match="no such folder"):
        load_run(tmp_path / "absent")
    with pytest.raises(OptionError, match=r"run\.json"):
        load_run(tmp_path)
    with pytest.raises(OptionError, match="sme study run"):
        load_cell(tmp_path, "abcdef")
    for subject, other in (("runs/a", None), (load_policy("linear", "Default"), "runs/a")):
        with pytest.raises(OptionError, match=r"'runs/a': is no run\. Give one of `load_run` or"):
            diagnose(subject, against=other)
    with pytest.raises(OptionError, match="states=63"):
        diagnosis_of(shrunk, states=63)
    with pytest.raises(OptionError, match="episodes=True"):
        diagnosis_of(shrunk, episodes=True)
    with pytest.raises(PolicyError, match="NaN"):
        diagnosis_of(lambda observation: np.full((len(observation), 4), np.nan))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short training of PPO, as `sme train` leaves it."""
    pytest.importorskip("stable_baselines3")
    from sme_registry.training import train

    folder = tmp_path_factory.mktemp("runs") / "short"
    train(
        SPEC, algorithm="PPO", hyperparameters={"n_steps": 240, "n_epochs": 1}, steps=240,
        folder=folder, protocol={"states_per_region": 100}, progress=False,
    )  # fmt: skip
    return folder


def test_a_run_is_diagnosed_with_its_log_and_its_exploration(run):
    found = diagnose(load_run(run), states=256, episodes=8)
    assert found.plan["algorithm"] == "PPO"
    assert found.checkpoint_step is None
    assert found.measurements.training.rows == 12  # 240 steps of 20
    spread = found.measurements.exploration_sd
    assert all(0.2 < sd < 0.5 for sd in spread)  # SD 1 in [−1, 1], clipped


def test_an_unfinished_run_is_diagnosed_from_its_checkpoint(run, tmp_path):
    stopped = tmp_path / "stopped"
    shutil.copytree(run, stopped)
    (stopped / "model.zip").replace(stopped / "checkpoint.zip")
    assert load_run(stopped).checkpoint_step == 240
    (stopped / "checkpoint.zip").unlink()
    assert "checkpoint.zip" in refused("diagnose", stopped)


def test_the_command_writes_a_page_its_data_and_its_figures(run, tmp_path, monkeypatch, figures):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(behaviour, "GRADIENT_STEPS", 10)
    folder = tmp_path / "d"
    result = good("diagnose", run, "--out", folder, "--probe-capacity", "--all", *SHORT)
    assert "Findings (1 seed, 1 update" in result.stdout
    page = (folder / "diagnosis.md").read_text()
    names = sorted(path.name for path in folder.glob("*.png"))
    assert len(names) == 5
    assert all(f"]({name})" in page for name in names)
    assert all((folder / name).with_suffix(".pdf").exists() for name in names)
    for figure in set(figures):
        assert_readable(figure)
    read = Diagnosis.read(folder / "diagnosis.json")
    assert read.measurements.capacity.layers == (10, 64, 64, 4)
    assert all(verdict.sentence() in page for verdict in read.verdicts)
    assert "--force" in refused("diagnose", run, "--out", folder)
    monkeypatch.setattr("sme_registry.diagnosis.figures.draw", lambda *_: ())
    assert shown(run, "--out", folder, "--force")["name"] == "short"


def test_an_edited_diagnosis_is_rejected(tmp_path):
    plain = diagnosis_of(shrunk, states=256).to_dict()
    plain["spec"]["seed"] = 7
    (tmp_path / "diagnosis.json").write_text(json.dumps(plain))
    with pytest.raises(DigestMismatchError, match="spec_digest"):
        Diagnosis.read(tmp_path / "diagnosis.json")


def test_the_command_accepts_any_policy_with_its_task(tmp_path):
    found = Diagnosis.from_dict(shown("linear", "--task", "Default", "--set", "complexity=10"))
    assert found.spec.complexity == 10
    assert "linear_only" in faults(found)
    against = shown("linear", "-t", "Default", "--against", "constant")
    assert against["comparison"]["spec_fields"] == {}
    assert "--task Default" in refused("diagnose", "linear")
    assert "Add --out" in refused("diagnose", "linear", "--task", "Default", "--force")
    assert "--task" in refused("diagnose", tmp_path, "--set", "k=1")
    assert "--cell" in refused("diagnose", tmp_path, "--cell", "a", "--task", "Default")


def test_a_policy_of_ones_own_loop_is_diagnosed_with_its_log(tmp_path):
    path = tmp_path / "episodes.csv"
    env = RecordRegret(sme_registry.make("Default", horizon=10), path)
    for episode in range(4):
        env.reset(seed=episode)
        ended = False
        while not ended:
            *_, ended, _ = env.step(env.action_space.sample())
    env.close()
    found = Diagnosis.from_dict(shown("linear", "--task", "Default", "--log", path))
    training = found.measurements.training
    assert (training.rows, training.steps) == (4, 40)
    assert training.last_regret == pytest.approx(env.episodes[-1].regret)
    assert "--log" in refused("diagnose", tmp_path, "--log", path)
    head, first, *others = path.read_text().splitlines()
    for damaged in ("2,", "2,20,1,10,nan,0.5,0,0.1"):
        path.write_text("\n".join([head, first, damaged, *others]))
        refusal = refused("diagnose", "linear", "-t", "Default", "--log", path)
        assert "line 3 must have 8 finite numbers" in refusal
    path.write_text("step,regret\n")
    assert "columns must be" in refused("diagnose", "linear", "-t", "Default", "--log", path)


def test_a_cell_of_a_study_is_found_by_the_first_digits_of_its_key(tmp_path):
    from sme_registry.spec.study import Cell
    from sme_registry.studies.cell import run_cell

    cells = [
        Cell(
            spec=SPEC, uses=uses, hyperparameters={}, action_range="symmetric", seed=0, steps=40,
            evaluations=2, evaluation_episodes=1, protocol={"states_per_region": 100},
        )
        for uses in ("reference:linear", "reference:constant", "TD3")
    ]  # fmt: skip
    keys = [cell.digest.removeprefix("sha256:") for cell in cells]
    (tmp_path / "cells").mkdir()
    for cell, key in zip(cells, keys, strict=True):
        result = run_cell(cell, model_path=tmp_path / "models" / f"{key}.zip")
        (tmp_path / "cells" / f"{key}.json").write_text(json.dumps(result.to_dict()))
    linear = load_cell(tmp_path, keys[0][:12])
    assert linear.log.source == "evaluations"
    assert linear.plan["algorithm"] == "reference:linear"
    comparison = shown(tmp_path, "--cell", keys[2], "--against", keys[1][:9])["comparison"]
    assert comparison["plan_fields"] == {"algorithm": ["TD3", "reference:constant"]}
    assert "0 of 3" in refused("diagnose", tmp_path, "--cell", "0123456789")
    with pytest.raises(UnknownNameError, match="6 or more digits"):
        load_cell(tmp_path, "")
    assert f"--cell {min(keys)[:12]}" in refused("diagnose", tmp_path)
    (tmp_path / "models" / f"{keys[2]}.zip").unlink()
    assert "--keep-models" in refused("diagnose", tmp_path, "--cell", keys[2])
    (tmp_path / "cells" / f"{keys[1]}.json").write_text("{}")
    assert "missing" in refused("diagnose", tmp_path, "--cell", keys[1])


def test_without_matplotlib_there_is_a_page_without_figures(tmp_path, monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find_spec(name)
    )
    result = good("diagnose", "constant", "--task", "Default", *SHORT, "--out", tmp_path)
    assert "pip install" in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["diagnosis.json", "diagnosis.md"]
