"""Training a team: its settings, its log and its evaluation."""

import csv
import io
import zipfile

import numpy as np
import pytest

from sme_registry import EvaluationReport, SMESpec, evaluate
from sme_registry.training import train
from sme_registry.training.record import COLUMNS, RunRecord, read_episodes
from tests.training.runs import PROTOCOL, copy_files

pytest.importorskip("stable_baselines3")

TEAM = SMESpec.from_dict(
    {
        "state_dim": 3, "action_dim": 3, "horizon": 20, "seed": 5,
        "team": {"agents": [{"action_dim": 1, "observes": [0, 2]}, {"action_dim": 2}]},
    }
)  # fmt: skip


@pytest.fixture(scope="module")
def team_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("team") / "run"
    return train(TEAM, steps=1000, folder=folder, protocol=PROTOCOL, progress=False)


def test_a_team_is_trained_by_ppo_and_the_record_has_its_settings(team_run):
    record = RunRecord.read(team_run.folder)
    assert record == team_run.record
    assert record is not None
    assert (record.status, record.algorithm, record.num_envs, record.agents) == (
        "finished", "PPO", 8, 2,
    )  # fmt: skip
    # 2,048 transitions for an update, of 8 teams of 2 agents: 128 steps each, 1,024 of teams.
    assert record.hyperparameters == {"n_steps": 128}
    assert record.steps_done == 1024
    from stable_baselines3 import PPO

    model = PPO.load(team_run.model_path, device="cpu")
    assert model.n_steps == 128
    assert model.num_timesteps == 2 * 1024


def test_each_agent_of_a_team_has_a_column_of_its_exact_regret(team_run):
    path = team_run.folder / "episodes.csv"
    rows = list(csv.DictReader(io.StringIO(path.read_text())))
    assert tuple(rows[0]) == (*COLUMNS, "regret/agent_0", "regret/agent_1")
    assert [int(row["step"]) for row in rows] == [160 * (1 + i // 8) for i in range(48)]
    for row, episode in zip(rows, team_run.episodes, strict=True):
        regrets = [float(row["regret/agent_0"]), float(row["regret/agent_1"])]
        assert regrets == pytest.approx(episode.agents_regret)
        assert float(row["regret"]) == pytest.approx(sum(regrets) / 2)
        # With k = 1 and r_min = 0 a return is the horizon less the sum of regrets.
        assert float(row["episode_return"]) == pytest.approx(
            20 * (1 - float(row["regret"])), abs=1e-4
        )
        assert row["length"] == "20"
    assert regrets[0] != regrets[1]
    read = read_episodes(path)
    assert [e.agents_regret for e in read] == [
        pytest.approx(e.agents_regret) for e in team_run.episodes
    ]


def test_the_logged_regret_is_that_in_the_infos(tmp_path):
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
    regrets = [[info["regret"] for info in env.step(a)[3]] for a in replay["actions"]]
    (episode,) = result.episodes
    assert episode.agents_regret == pytest.approx(np.mean(regrets, axis=0))


def test_a_team_is_evaluated_by_the_policy_its_agents_share(team_run):
    report = EvaluationReport.read(team_run.folder / "evaluation.json")
    assert report == team_run.report
    assert list(report.agents) == ["agent_0", "agent_1"]
    again = evaluate(team_run.model_path, TEAM, PROTOCOL, name="PPO")
    assert (again.regions, again.agents) == (report.regions, report.agents)
    assert {path.name for path in team_run.figures} == {
        "training_curve.png", "training_curve.pdf", "decay_curve.png", "decay_curve.pdf",
    }  # fmt: skip


def test_a_teams_run_resumes_with_its_columns(team_run, tmp_path):
    folder = tmp_path / "run"
    copy_files(team_run.folder, folder)
    team_run.record.updated(status="running").write(folder)
    result = train(TEAM, steps=1500, folder=folder, protocol=PROTOCOL, progress=False, resume=True)
    assert (result.record.sessions, result.record.steps_done) == (2, 2048)
    assert [e.step for e in result.episodes[:48]] == [e.step for e in team_run.episodes]
    assert len(result.episodes) == 96
    assert all(len(episode.agents_regret) == 2 for episode in result.episodes)
