"""Short real runs: their files, their numbers, and invalid arguments."""

import csv
import io
import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from rich.console import Console

from sme_registry import EvaluationReport, SMESpec, evaluate
from sme_registry.cli.train import equal_runs
from sme_registry.errors import (
    MissingDependencyError,
    OptionError,
    PolicyError,
    SMEError,
)
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.io import file_lock
from sme_registry.spec import Suite
from sme_registry.training import run as training_run
from sme_registry.training import train
from sme_registry.training.record import COLUMNS, Episode, EpisodeLog, RunRecord, read_episodes
from tests.training.runs import NARROW, PROTOCOL, TINY, copy_files, short

pytest.importorskip("stable_baselines3")


def test_a_run_writes_all_files_into_its_folder(run):
    names = {path.name for path in run.folder.iterdir()}
    assert names >= {"run.json", "episodes.csv", "checkpoint.zip", "model.zip", "evaluation.json"}
    assert [name for name in names if name.startswith(".")] == [".lock"]
    assert {path.name for path in run.figures} <= names
    assert "similarity_map.png" in names
    assert json.loads((run.folder / "run.json").read_text())["hyperparameters"] == {}
    with zipfile.ZipFile(run.model_path) as archive:
        assert "policy.pth" in archive.namelist()


def test_the_record_and_the_report_describe_the_run(run):
    record = RunRecord.read(run.folder)
    assert record == run.record
    assert record is not None
    assert (record.status, record.steps_done, record.episodes) == ("finished", 150, 7)
    assert record.spec == TINY
    assert record.spec_digest == TINY.digest
    assert {"torch", "stable_baselines3", "numpy", "python"} <= record.versions.keys()
    assert record.steps_per_second == pytest.approx(150 / record.wall_seconds, rel=0.01)
    report = EvaluationReport.read(run.folder / "evaluation.json")
    assert report == run.report
    assert evaluate(run.model_path, TINY, PROTOCOL, name="TD3").regions == report.regions
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(run.folder / "tensorboard")).Reload()
    (first, *_) = events.Scalars("rollout/regret")  # SB3 writes after every fourth episode
    assert first.value == pytest.approx(np.mean([e.regret for e in run.episodes[:4]]), abs=1e-6)


def test_logged_episodes_are_complete_and_their_regret_is_exact(run):
    rows = list(csv.DictReader(io.StringIO((run.folder / "episodes.csv").read_text())))
    assert [int(row["episode"]) for row in rows] == [1, 2, 3, 4, 5, 6, 7]
    assert [int(row["step"]) for row in rows] == [20, 40, 60, 80, 100, 120, 140]
    for row in rows:
        # With k = 1 and r_min = 0 the return is the horizon less the sum of regrets.
        expected = 20 * (1 - float(row["regret"]))
        assert float(row["episode_return"]) == pytest.approx(expected, abs=1e-4)
        assert float(row["similarity"]) <= 1
        assert row["terminated"] == "0"
    assert read_episodes(run.folder / "episodes.csv") == [
        Episode(*(pytest.approx(value) for value in episode)) for episode in run.episodes
    ]


def test_the_same_seed_trains_the_same_model_and_another_one_does_not(run, tmp_path):
    same, other = short(tmp_path / "same"), short(tmp_path / "other", seed=1)
    assert [e.regret for e in same.episodes] == [e.regret for e in run.episodes]
    assert same.report.regions == run.report.regions
    assert [e.regret for e in other.episodes] != [e.regret for e in run.episodes]


def test_training_lowers_regret(tmp_path):
    # TD3 on a task of one channel; the first 100 steps act at random.
    spec = SMESpec(state_dim=1, action_dim=1, horizon=25, seed=1)
    settings = {"policy_kwargs": {"net_arch": [64, 64]}, "learning_rate": 0.003}
    result = train(spec, steps=350, folder=tmp_path, protocol=PROTOCOL, hyperparameters=settings)
    regrets = [episode.regret for episode in result.episodes]
    assert np.mean(regrets[-4:]) < 0.7 * np.mean(regrets[:4])
    reference = result.report.references["constant"][0]
    assert result.report.regions[0].similarity > reference.similarity


def test_an_episode_that_ends_by_D_is_logged_as_terminated(tmp_path):
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        spec = TINY.derive(D=0.5, k=5)
        result = train(spec, steps=60, folder=tmp_path / "run", protocol=PROTOCOL, progress=False)
        assert torch.get_num_threads() == 2  # restored
    finally:
        torch.set_num_threads(before)
    died = [episode for episode in result.episodes if episode.terminated]
    assert died
    assert all(episode.length < 20 for episode in died)
    assert result.figures == ()  # without Matplotlib
    assert not list((tmp_path / "run").glob("*.png"))


def test_on_policy_algorithms_announce_that_they_finish_their_rollout_over_all_lanes(tmp_path):
    shown = io.StringIO()
    result = short(
        tmp_path / "run", algorithm="a2c", steps=31, num_envs=3, progress=True,
        console=Console(file=shown),
    )  # fmt: skip
    assert result.record.algorithm == "A2C"
    assert result.record.steps_done == 45  # rollouts of 5 steps in 3 lanes
    assert "whole rollouts: 45 steps, not 31" in shown.getvalue()
    assert result.episodes == ()


@pytest.mark.parametrize("algorithm", ["PPO", "TD3"])
def test_weights_that_are_not_finite_end_the_run(algorithm, tmp_path):
    own = {"n_steps": 32, "batch_size": 32} if algorithm == "PPO" else {"learning_starts": 10}
    settings = {"learning_rate": 1e30, "policy_kwargs": {"net_arch": [8]}, **own}
    with pytest.raises(PolicyError, match=r"the weights are not finite any longer at step \d+\. "):
        short(tmp_path, algorithm=algorithm, hyperparameters=settings, checkpoint_every=10)
    record = RunRecord.read(tmp_path)
    assert record is not None
    assert (record.status, record.failure[:11]) == ("failed", "the weights")
    with pytest.raises(OptionError, match="contains a failed run of"):
        short(tmp_path, algorithm=algorithm, resume=True)


@pytest.mark.parametrize("changes", [{}, {"task": "Team4", "independent": True, "num_envs": 1}])
def test_hyperparameters_that_only_fail_in_the_training_are_named(changes, tmp_path):
    settings = {"n_steps": 16, "batch_size": 16, "n_epochs": 0}
    with pytest.raises(OptionError, match=r"algorithm='PPO': rejects .*'n_epochs'.*: .+\. Change"):
        short(tmp_path, algorithm="PPO", hyperparameters=settings, **changes)


@pytest.mark.parametrize(("name", "value"), [("action_noise", 0.1), ("policy_delay", 0)])
def test_so_are_those_of_off_policy_algorithms(name, value, tmp_path):
    with pytest.raises(OptionError, match=rf"algorithm='TD3': rejects .*'{name}'.*: .+\. Change"):
        short(tmp_path, hyperparameters={"learning_starts": 1, name: value})


@pytest.mark.parametrize("algorithm", ["SAC", "DDPG"])  # PPO below
def test_every_algorithm_trains(algorithm, tmp_path):
    result = short(tmp_path, algorithm=algorithm, steps=120, num_envs=2, hyperparameters=NARROW)
    assert result.report.policy == algorithm
    assert result.record.steps_done >= 120
    assert result.report.regions[0].similarity > 0.4


def test_several_environments_leave_an_algorithm_what_it_is(tmp_path):
    """PPO's rollout is divided; TD3 still updates once for each step."""
    result = short(tmp_path / "ppo", algorithm="PPO", steps=2048, num_envs=8)
    assert result.report.policy == "PPO"
    assert result.report.regions[0].similarity > 0.4
    assert result.record.hyperparameters == {"n_steps": 256}
    assert result.record.steps_done == 2048
    td3 = short(tmp_path / "td3", steps=110, num_envs=2)
    assert td3.record.hyperparameters == {"gradient_steps": -1}
    from stable_baselines3 import TD3

    assert TD3.load(td3.model_path, device="cpu")._n_updates == 10  # after 100 random steps


SETTINGS = {
    "learning_rate": 0.002,
    "policy_kwargs": {"net_arch": [16], "activation_fn": "torch.nn:ELU"},
}


def test_hyperparameters_reach_the_model_and_the_record(tmp_path):
    import sb3_contrib

    result = short(
        tmp_path / "run",
        algorithm="sb3_contrib:TQC",
        hyperparameters={**SETTINGS, "top_quantiles_to_drop_per_net": 1},
        steps=30,
    )
    record = RunRecord.read(result.folder)
    assert record is not None
    assert (record.algorithm, result.report.policy) == ("sb3_contrib:TQC", "TQC")
    assert record.hyperparameters == {**SETTINGS, "top_quantiles_to_drop_per_net": 1}
    assert "sb3_contrib" in record.versions
    model = sb3_contrib.TQC.load(result.model_path, device="cpu")
    assert (model.learning_rate, model.top_quantiles_to_drop_per_net) == (0.002, 1)
    assert model.policy.net_arch == [16]


def test_a_learner_of_another_make_is_trained_without_checkpoints(tmp_path):
    result = short(tmp_path / "run", algorithm="tests.training.runs:Still")
    assert [episode.step for episode in result.episodes] == [20, 40, 60, 80, 100, 120, 140]
    assert not {"model.zip", "checkpoint.zip"} & {path.name for path in result.folder.iterdir()}


def test_a_finished_run_is_replaced_only_with_force(run, tmp_path):
    folder = tmp_path / "run"
    copy_files(run.folder, folder)
    for resume in (False, True):
        with pytest.raises(OptionError, match=r"finished run of TD3\. Only interrupted runs can"):
            short(folder, resume=resume)
    replaced = short(folder, seed=9, steps=30, force=True)
    assert replaced.record.seed == 9
    assert len(replaced.episodes) == 1


def test_a_folder_in_which_another_process_trains_is_refused(run, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    copy_files(run.folder, folder)
    run.record.updated(status="running").write(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    with file_lock(folder / ".lock"):
        for change in ({"resume": True}, {"force": True}, {}):
            with pytest.raises(OptionError, match="another process is training in this folder"):
                short(folder, **change)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    assert short(folder, resume=True).record.sessions == 2
    # Two that begin at once do not mix.
    monkeypatch.setattr("sme_registry.training.run.is_locked", lambda path: False)
    with file_lock(tmp_path / "new" / ".lock"):
        with pytest.raises(OptionError, match="another process is training in this folder"):
            short(tmp_path / "new")
        assert [path.name for path in (tmp_path / "new").iterdir()] == [".lock"]


def test_a_folder_with_other_files_is_never_touched(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    for force in (False, True):
        with pytest.raises(OptionError, match=r"thesis\.tex"):
            short(tmp_path, force=force)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(OptionError, match="is a file"):
        short(tmp_path / "thesis.tex")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "Defalt"}, "Did you mean 'Default"),
        ({"task": {"state_dim": 2**20, "action_dim": 2**20}}, "state_dim"),
        ({"algorithm": "independent:PPO"}, "learns the task of a team, and this is a task of a"),
        ({"algorithm": "reference:linear"}, "Use it in a study"),
        ({"algorithm": "offline:bc"}, "Use it in a study"),
        ({"resume": True}, "contains no run to resume. Leave out --resume"),
        ({"hyperparameters": {"buffer_size": 10**15}}, "rejects the task or .*buffer_size"),
        ({"hyperparameters": {"gama": 0.9}}, "Did you mean 'gamma'"),
        ({"hyperparameters": {"learning_rate": "fast"}}, "rejects the task or"),
        ({"steps": 0}, "steps=0"),
        ({"num_envs": 5000}, "num_envs=5000"),
        ({"action_range": "both"}, "action_range='both'"),
    ],
)
def test_invalid_arguments_raise_typed_errors_and_create_no_folder(change, message, tmp_path):
    with pytest.raises(SMEError, match=message):
        short(tmp_path / "run", **change)
    assert not (tmp_path / "run").exists()


def test_missing_stable_baselines_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(MissingDependencyError, match=r"\[train\]"):
        short(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_importing_the_package_of_training_imports_no_torch():
    code = "import sys, sme_registry.training; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(("seeds", "runs"), [([1], 10), ([1, 2, 3], 12), (list(range(15)), 15)])
def test_by_default_all_instances_of_a_class_have_equally_many_runs(seeds, runs):
    suite = Suite.from_dict({"classes": [{"name": "one", "setting": {"k": 2}, "seeds": seeds}]})
    assert equal_runs(suite) == runs


def episode(number):
    return Episode(number, 20 * number, 1.5, 20, 0.25, 0.9, 0, 0.5)


def test_a_row_cut_short_and_rows_after_the_checkpoint_are_dropped(tmp_path):
    path = tmp_path / "episodes.csv"
    log = EpisodeLog(path)
    assert path.read_text() == ",".join(COLUMNS) + "\n"
    for number in (1, 2, 3):
        log.add(episode(number))
        assert len(read_episodes(path)) == number  # on disk before the next one begins
    log.close()
    with path.open("a") as stream:
        stream.write("4,80,1.5,2")
    assert read_episodes(path) == [episode(1), episode(2), episode(3)]
    EpisodeLog(path, up_to_step=45).close()
    assert read_episodes(path) == [episode(1), episode(2)]
    path.write_text("a,b\n1,2\n")
    with pytest.raises(OptionError, match="columns"):
        read_episodes(path)


@pytest.mark.parametrize(("steps", "name"), [(19_999, "quick-v1"), (20_000, "paper-v1")])
def test_a_short_training_is_evaluated_in_fewer_states(steps, name, tmp_path, monkeypatch):
    def stop(learner, record, *others):
        raise RuntimeError(record.protocol_digest)

    monkeypatch.setattr(training_run, "learn", stop)
    with pytest.raises(RuntimeError, match=resolve_protocol(name).digest):
        train(TINY, steps=steps, folder=tmp_path / "run", progress=False)
