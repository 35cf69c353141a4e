"""Training: real short runs, what they log, and going on after a kill."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sme_registry import EvaluationReport, SMESpec, evaluate
from sme_registry.errors import (
    MissingDependencyError,
    OptionError,
    PolicyError,
    ResourceLimitError,
    SMEError,
    SpecError,
    UnknownNameError,
)
from sme_registry.terminal.interrupts import defer_interrupts
from sme_registry.training import ALGORITHMS, RunRecord, TrainingResult, train
from sme_registry.training.algorithms import known_algorithm
from sme_registry.training.episodes import COLUMNS, Episode, EpisodeLog, read_episodes

pytest.importorskip("stable_baselines3")

TINY = SMESpec(state_dim=2, action_dim=2, horizon=20, seed=5)
PROTOCOL = {"states_per_region": 50}


def short(folder: Path, **changes: Any) -> TrainingResult:
    settings: dict[str, Any] = {
        "algorithm": "TD3",
        "steps": 150,
        "protocol": PROTOCOL,
        "progress": False,
    }
    return train(TINY, folder=folder, **{**settings, **changes})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> TrainingResult:
    return short(tmp_path_factory.mktemp("run"), checkpoint_every=100)


def test_a_run_leaves_everything_in_its_folder(run: TrainingResult) -> None:
    names = {path.name for path in run.folder.iterdir()}
    assert names >= {"run.json", "episodes.csv", "checkpoint.zip", "model.zip", "evaluation.json"}
    assert not [name for name in names if name.startswith(".")]
    assert {path.name for path in run.figures} <= names
    assert "similarity_map.png" in names


def test_the_record_says_what_was_run(run: TrainingResult) -> None:
    record = RunRecord.read(run.folder)
    assert record == run.record
    assert record is not None
    assert (record.status, record.steps_done, record.episodes) == ("finished", 150, 7)
    assert record.spec == TINY
    assert record.spec_digest == TINY.digest
    assert {"torch", "stable_baselines3", "numpy", "python"} <= record.versions.keys()
    assert record.steps_per_second == pytest.approx(150 / record.wall_seconds, rel=0.01)


def test_the_logged_episodes_are_whole_and_their_regret_is_exact(run: TrainingResult) -> None:
    rows = list(csv.DictReader(io.StringIO((run.folder / "episodes.csv").read_text())))
    assert [int(row["episode"]) for row in rows] == [1, 2, 3, 4, 5, 6, 7]
    assert [int(row["step"]) for row in rows] == [20, 40, 60, 80, 100, 120, 140]
    for row in rows:
        # With k = 1 and r_min = 0 the return is the horizon less the sum of regrets.
        expected = 20 * (1 - float(row["regret"]))
        assert float(row["return"]) == pytest.approx(expected, abs=1e-4)
        assert float(row["similarity"]) <= 1
        assert row["terminated"] == "0"
    assert read_episodes(run.folder / "episodes.csv") == [
        Episode(*(pytest.approx(value) for value in episode)) for episode in run.episodes
    ]


def test_the_final_model_is_the_one_evaluated(run: TrainingResult) -> None:
    report = EvaluationReport.read(run.folder / "evaluation.json")
    assert report == run.report
    again = evaluate(run.model_path, TINY, PROTOCOL, name="TD3")
    assert again.regions == report.regions


def test_the_same_seed_trains_the_same_model_and_another_one_does_not(
    run: TrainingResult, tmp_path: Path
) -> None:
    same, other = short(tmp_path / "same"), short(tmp_path / "other", seed=1)
    assert [e.regret for e in same.episodes] == [e.regret for e in run.episodes]
    assert same.report.regions == run.report.regions
    assert [e.regret for e in other.episodes] != [e.regret for e in run.episodes]


def test_training_lowers_regret(tmp_path: Path) -> None:
    # One second of TD3 on a task of one channel; the first 100 steps act at random.
    spec = SMESpec(state_dim=1, action_dim=1, horizon=25, seed=1)
    result = train(spec, steps=350, folder=tmp_path / "run", protocol=PROTOCOL, progress=False)
    regrets = [episode.regret for episode in result.episodes]
    assert np.mean(regrets[-4:]) < 0.7 * np.mean(regrets[:4])
    reference = result.report.references["constant_half"][0]
    assert result.report.regions[0].similarity > reference.similarity


def test_an_episode_that_dies_is_logged_as_terminated(tmp_path: Path) -> None:
    spec = TINY.derive(D=0.5, k=5)
    result = train(spec, steps=60, folder=tmp_path / "run", protocol=PROTOCOL, progress=False)
    died = [episode for episode in result.episodes if episode.terminated]
    assert died
    assert all(episode.length < 20 for episode in died)


def test_on_policy_algorithms_finish_their_rollout_over_all_lanes(tmp_path: Path) -> None:
    result = short(tmp_path / "run", algorithm="a2c", steps=31, num_envs=3)
    assert result.record.algorithm == "A2C"
    assert result.record.steps_done == 45  # rollouts of 5 steps in 3 lanes
    assert [episode.step for episode in result.episodes] == []


@pytest.mark.parametrize("algorithm", ["PPO", "SAC", "DDPG"])
def test_every_algorithm_trains_and_is_evaluated(algorithm: str, tmp_path: Path) -> None:
    result = short(tmp_path / "run", algorithm=algorithm, steps=120, num_envs=2)
    assert result.report.policy == algorithm
    assert result.record.steps_done >= 120
    assert result.report.regions[0].similarity > 0.4


def test_the_thread_count_of_torch_is_left_as_it_was(run: TrainingResult, tmp_path: Path) -> None:
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        short(tmp_path / "run", steps=10)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


_SCRIPT = """
import sys
from sme_registry import SMESpec
from sme_registry.training import train
spec = SMESpec(state_dim=2, action_dim=2, horizon=20, seed=5)
train(spec, steps=100_000, seed=3, folder=sys.argv[1], checkpoint_every=50,
      protocol={"states_per_region": 50}, progress=False)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run whose process was killed some way beyond its third checkpoint."""
    folder = tmp_path_factory.mktemp("killed") / "run"
    process = subprocess.Popen([sys.executable, "-c", _SCRIPT, str(folder)])
    try:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and process.poll() is None:
            record = RunRecord.read(folder) if (folder / "run.json").exists() else None
            if record is not None and record.steps_done >= 150:
                break
            time.sleep(0.05)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert process.returncode == -signal.SIGKILL
    return folder


def test_a_killed_run_goes_on_from_its_checkpoint(killed: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    _copy(killed, folder)
    before = RunRecord.read(folder)
    assert before is not None
    assert before.status == "running"
    logged = read_episodes(folder / "episodes.csv")
    steps = before.steps_done + 60

    with pytest.raises(OptionError, match="--resume"):
        short(folder, seed=3, steps=steps)
    result = short(folder, seed=3, steps=steps, resume=True)

    assert result.record.sessions == 2
    assert result.record.steps_done == steps
    kept = [episode for episode in logged if episode.step <= before.steps_done]
    assert kept
    assert list(result.episodes[: len(kept)]) == kept
    assert len(result.episodes) > len(kept)
    numbers = [episode.episode for episode in result.episodes]
    assert numbers == list(range(1, len(numbers) + 1))
    assert result.episodes[-1].step > before.steps_done
    assert result.episodes[-1].wall_seconds > kept[-1].wall_seconds
    # Its starts are drawn from another stream than those of the first session.
    with zipfile.ZipFile(folder / "checkpoint.zip") as archive:
        replay = np.load(io.BytesIO(archive.read("sme_replay_buffer.npz")))
    starts = replay["observations"][[0, before.steps_done], 0, :2]
    assert not np.array_equal(starts[0], starts[1])


def test_the_checkpoint_holds_the_model_its_optimisers_and_its_replay_buffer(
    killed: Path,
) -> None:
    from stable_baselines3 import TD3

    from sme_registry.sb3 import SMEVecEnv
    from sme_registry.training import checkpoint

    path = killed / "checkpoint.zip"
    model = checkpoint.load(TD3, path, SMEVecEnv(TINY, 1), buffer_size=5_000)
    steps = model.num_timesteps
    assert steps % 50 == 0
    assert steps >= 150
    assert model.replay_buffer.size() == steps
    assert not model.replay_buffer.full
    replayed = model.replay_buffer
    # Observations' time input shows that the buffer holds the run's own steps, in order.
    time_input = replayed.observations[:steps, 0, 2] * 20
    assert time_input == pytest.approx(np.arange(steps) % 20, abs=1e-4)
    assert model.critic.optimizer.state_dict()["state"]
    assert TD3.load(path, device="cpu").num_timesteps == steps


def test_resuming_with_fewer_steps_than_are_done_only_evaluates(
    killed: Path, tmp_path: Path
) -> None:
    _copy(killed, tmp_path / "run")
    before = RunRecord.read(killed)
    assert before is not None
    result = short(tmp_path / "run", seed=3, steps=20, resume=True)
    assert result.record.steps_done >= before.steps_done
    assert result.model_path.exists()


def test_resuming_twice_from_one_checkpoint_gives_the_same_run(
    killed: Path, tmp_path: Path
) -> None:
    reports = []
    for name in ("one", "two"):
        _copy(killed, tmp_path / name)
        record = RunRecord.read(killed)
        assert record is not None
        result = short(tmp_path / name, seed=3, steps=record.steps_done + 40, resume=True)
        reports.append(result.report.regions)
    assert reports[0] == reports[1]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"seed": 4}, "seed"),
        ({"algorithm": "SAC"}, "algorithm"),
        ({"action_range": "unit"}, "action_range"),
        ({"num_envs": 2}, "num_envs"),
    ],
)
def test_another_plan_cannot_be_resumed(killed: Path, change: dict[str, Any], field: str) -> None:
    before = (killed / "run.json").read_bytes()
    with pytest.raises(OptionError, match=f"^{field}="):
        short(killed, **{"seed": 3, "resume": True, **change})
    assert (killed / "run.json").read_bytes() == before


def test_an_interrupt_waits_until_what_is_being_saved_is_written() -> None:
    written, before = [], signal.getsignal(signal.SIGINT)

    def save() -> None:
        with defer_interrupts():
            signal.raise_signal(signal.SIGINT)
            written.append("checkpoint and record")

    with pytest.raises(KeyboardInterrupt):
        save()
    assert written == ["checkpoint and record"]
    assert signal.getsignal(signal.SIGINT) is before


def test_a_broken_checkpoint_is_refused_with_the_way_out(killed: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    _copy(killed, folder)
    (folder / "checkpoint.zip").write_bytes(b"PK\x03\x04 no checkpoint")
    with pytest.raises(PolicyError, match="--force"):
        short(folder, seed=3, resume=True)


def test_a_run_killed_before_its_first_checkpoint_begins_again(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    finished = short(folder, steps=40)
    finished.record.updated(status="running", steps_done=0).write(folder)
    (folder / "checkpoint.zip").unlink()
    again = short(folder, steps=40, resume=True)
    assert [e.regret for e in again.episodes] == [e.regret for e in finished.episodes]


def test_a_finished_run_is_refused_unless_forced(run: TrainingResult, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    _copy(run.folder, folder)
    for resume in (False, True):
        with pytest.raises(OptionError, match="finished run"):
            short(folder, resume=resume)
    replaced = short(folder, seed=9, steps=30, force=True)
    assert replaced.record.seed == 9
    assert len(replaced.episodes) == 1


@pytest.mark.parametrize("force", [False, True])
def test_a_folder_with_other_files_is_never_touched(force: bool, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OptionError, match=r"thesis\.tex"):
        short(tmp_path, force=force)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"algorithm": "TD4"}, "Did you mean 'TD3'"),
        ({"steps": 0}, "steps=0"),
        ({"steps": 10.5}, r"steps=10\.5"),
        ({"steps": True}, "steps=True"),
        ({"seed": -1}, "seed=-1"),
        ({"seed": 2**32}, "seed="),
        ({"num_envs": 0}, "num_envs=0"),
        ({"num_envs": 5000}, "num_envs=5000"),
        ({"checkpoint_every": 0}, "checkpoint_every=0"),
        ({"action_range": "both"}, "action_range='both'"),
        ({"protocol": "papr-v1"}, "Did you mean"),
        ({"protocol": {"states": 4}}, "states=4"),
    ],
)
def test_bad_input_is_a_typed_error_and_makes_no_folder(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SMEError, match=message):
        short(tmp_path / "run", **change)
    assert not (tmp_path / "run").exists()


def test_without_stable_baselines_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(MissingDependencyError, match=r"sme-registry\[train\]"):
        short(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_without_matplotlib_a_run_has_no_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    result = short(tmp_path / "run", steps=30)
    assert result.figures == ()
    assert not list((tmp_path / "run").glob("*.png"))
    assert result.record.status == "finished"


def test_a_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file")
    with pytest.raises(OptionError, match="is a file"):
        short(tmp_path / "run")


@pytest.mark.parametrize(
    ("task", "error"),
    [
        ("Defalt", UnknownNameError),
        ({"state_dim": 2**20, "action_dim": 2**20}, ResourceLimitError),
        ({"state_dim": 0}, SpecError),
    ],
)
def test_a_task_that_cannot_be_drawn_makes_no_folder(
    task: Any, error: type[Exception], tmp_path: Path
) -> None:
    with pytest.raises(error):
        train(task, folder=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", list(ALGORITHMS))
def test_algorithms_are_known_in_any_case(name: str) -> None:
    assert known_algorithm(name.lower()) == name


def test_importing_the_package_of_training_imports_no_torch() -> None:
    code = "import sys, sme_registry.training; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def episode(number: int) -> Episode:
    return Episode(number, 20 * number, 1.5, 20, 0.25, 0.9, 0, 0.5)


def test_each_episode_is_on_disk_before_the_next_begins(tmp_path: Path) -> None:
    path = tmp_path / "episodes.csv"
    log = EpisodeLog(path)
    assert path.read_text() == ",".join(COLUMNS) + "\n"
    log.add(episode(1))
    assert read_episodes(path) == [episode(1)]
    log.close()


def test_a_row_cut_short_and_rows_after_the_checkpoint_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "episodes.csv"
    log = EpisodeLog(path)
    for number in (1, 2, 3):
        log.add(episode(number))
    log.close()
    with path.open("a") as stream:
        stream.write("4,80,1.5,2")
    assert read_episodes(path) == [episode(1), episode(2), episode(3)]
    EpisodeLog(path, up_to_step=45).close()
    assert read_episodes(path) == [episode(1), episode(2)]


def test_a_csv_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "episodes.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(OptionError, match="columns"):
        read_episodes(path)


TEAM = SMESpec.from_dict(
    {
        "state_dim": 3, "action_dim": 3, "horizon": 20, "seed": 5,
        "team": {"agents": [{"action_dim": 1, "observes": [0, 2]}, {"action_dim": 2}]},
    }
)  # fmt: skip


@pytest.fixture(scope="module")
def team_run(tmp_path_factory: pytest.TempPathFactory) -> TrainingResult:
    folder = tmp_path_factory.mktemp("team") / "run"
    return train(TEAM, steps=1000, folder=folder, protocol=PROTOCOL, progress=False)


def test_a_team_is_trained_by_ppo_and_the_record_says_how(team_run: TrainingResult) -> None:
    record = RunRecord.read(team_run.folder)
    assert record == team_run.record
    assert record is not None
    assert (record.status, record.algorithm, record.num_envs, record.agents) == (
        "finished", "PPO", 8, 2,
    )  # fmt: skip
    # 2,048 transitions for an update, of 8 teams of 2 agents: 128 steps each, 1,024 of teams.
    assert record.hyperparameters == "stable-baselines3 defaults, but n_steps=128"
    assert record.steps_done == 1024
    from stable_baselines3 import PPO

    model = PPO.load(team_run.model_path, device="cpu")
    assert model.n_steps == 128
    assert model.num_timesteps == 2 * 1024


def test_each_agent_of_a_team_has_a_column_of_its_exact_regret(team_run: TrainingResult) -> None:
    path = team_run.folder / "episodes.csv"
    rows = list(csv.DictReader(io.StringIO(path.read_text())))
    assert tuple(rows[0]) == (*COLUMNS, "regret/agent_0", "regret/agent_1")
    assert [int(row["step"]) for row in rows] == [160 * (1 + i // 8) for i in range(48)]
    for row, episode in zip(rows, team_run.episodes, strict=True):
        regrets = [float(row["regret/agent_0"]), float(row["regret/agent_1"])]
        assert regrets == pytest.approx(episode.agents_regret)
        assert float(row["regret"]) == pytest.approx(sum(regrets) / 2)
        # With k = 1 and r_min = 0 a return is the horizon less the sum of regrets.
        assert float(row["return"]) == pytest.approx(20 * (1 - float(row["regret"])), abs=1e-4)
        assert row["length"] == "20"
    assert regrets[0] != regrets[1]
    read = read_episodes(path)
    assert [e.agents_regret for e in read] == [
        pytest.approx(e.agents_regret) for e in team_run.episodes
    ]


def test_the_logged_regret_is_what_the_agents_were_told(tmp_path: Path) -> None:
    """The first episode, taken from the replay buffer and played again."""
    from sme_registry.sb3 import SMETeamVecEnv

    folder = tmp_path / "run"
    result = train(
        TEAM, algorithm="TD3", steps=20, seed=3, folder=folder, protocol=PROTOCOL, progress=False
    )
    env = SMETeamVecEnv(TEAM, 1)
    env.seed(3)
    first = env.reset()
    with zipfile.ZipFile(folder / "checkpoint.zip") as archive:
        replay = np.load(io.BytesIO(archive.read("sme_replay_buffer.npz")))
    np.testing.assert_array_equal(replay["observations"][0], first)
    assert len(replay["actions"]) == 20
    told = [[info["regret"] for info in env.step(a)[3]] for a in replay["actions"]]
    (episode,) = result.episodes
    assert episode.agents_regret == pytest.approx(np.mean(told, axis=0))


def test_a_team_is_evaluated_by_the_policy_its_agents_share(team_run: TrainingResult) -> None:
    report = EvaluationReport.read(team_run.folder / "evaluation.json")
    assert report == team_run.report
    assert list(report.agents) == ["agent_0", "agent_1"]
    again = evaluate(team_run.model_path, TEAM, PROTOCOL, name="PPO")
    assert (again.regions, again.agents) == (report.regions, report.agents)
    assert {path.name for path in team_run.figures} == {"training_curve.png", "decay_curve.png"}


def test_training_lowers_the_regret_of_each_agent(tmp_path: Path) -> None:
    spec = SMESpec.from_dict(
        {"state_dim": 1, "action_dim": 2, "horizon": 25, "seed": 2,
         "team": {"agents": [{"action_dim": 1}, {"action_dim": 1}]}}
    )  # fmt: skip
    result = train(spec, algorithm="TD3", steps=225, folder=tmp_path / "run", protocol=PROTOCOL,
                   progress=False)  # fmt: skip
    assert result.record.num_envs == 1
    regrets = np.array([episode.agents_regret for episode in result.episodes])
    assert (regrets[-2:].mean(axis=0) < 0.7 * regrets[:2].mean(axis=0)).all()


def test_a_teams_run_that_stopped_goes_on_with_its_columns(
    team_run: TrainingResult, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    _copy(team_run.folder, folder)
    team_run.record.updated(status="running").write(folder)
    result = train(TEAM, steps=1500, folder=folder, protocol=PROTOCOL, progress=False, resume=True)
    assert (result.record.sessions, result.record.steps_done) == (2, 2048)
    assert [e.step for e in result.episodes[:48]] == [e.step for e in team_run.episodes]
    assert len(result.episodes) == 96
    assert all(len(episode.agents_regret) == 2 for episode in result.episodes)


def _copy(source: Path, target: Path) -> None:
    target.mkdir()
    for path in source.iterdir():
        if path.is_file():
            (target / path.name).write_bytes(path.read_bytes())


def test_the_run_file_is_strict_json(run: TrainingResult) -> None:
    plain = json.loads((run.folder / "run.json").read_text())
    assert plain["hyperparameters"] == "stable-baselines3 defaults"
    with zipfile.ZipFile(run.model_path) as archive:
        assert "policy.pth" in archive.namelist()
    assert os.access(run.model_path, os.R_OK)
