"""Independent learners of a team: the same updates as SB3's, one model for each agent, resuming."""

import numpy as np
import pytest

from sme_registry import EvaluationReport, SMESpec, evaluate
from sme_registry.errors import OptionError, SpecError
from sme_registry.training import train
from sme_registry.training.record import read_episodes
from tests.training.runs import PROTOCOL, TINY, copy_files
from tests.training.test_team_runs import TEAM

pytest.importorskip("stable_baselines3")

SETTINGS = {"n_steps": 32, "batch_size": 32, "n_epochs": 2}


def independent(folder, **changes):
    settings = {
        "independent": True,
        "steps": 128,
        "num_envs": 2,
        "hyperparameters": SETTINGS,
        "protocol": PROTOCOL,
        "progress": False,
    }
    return train(TEAM, folder=folder, **{**settings, **changes})


@pytest.fixture(scope="module")
def team_run(tmp_path_factory):
    return independent(tmp_path_factory.mktemp("independent") / "run")


def test_a_team_of_one_learns_exactly_what_sb3s_ppo_learns(team_run):
    """The same weights after three rollouts with episodes cut off at the horizon.

    Up to float32 rounding: PyTorch's sums depend on how its tensors are aligned in memory.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.utils import set_random_seed

    from sme_registry.sb3 import SMEVecEnv
    from sme_registry.training.algorithms import find
    from sme_registry.training.learn import Run, Watch
    from sme_registry.training.models import silence

    spec = TINY.derive(team={"agents": [{"action_dim": 2}]})
    settings = team_run.record.hyperparameters
    run = Run(document=spec, seed=4, steps=192, hyperparameters=settings, num_envs=2)
    learner = find("independent:PPO").learner(run)
    learner.learn(Watch())
    (ours,) = learner.models.values()

    env = SMEVecEnv(TINY, 2)
    theirs = PPO("MlpPolicy", env, seed=ours.seed, device="cpu", **SETTINGS)
    silence(theirs)
    set_random_seed(4)
    env.seed(4)
    theirs.learn(192)
    for name, weights in theirs.policy.state_dict().items():
        learnt = ours.policy.state_dict()[name].numpy()
        np.testing.assert_allclose(learnt, weights.numpy(), rtol=1e-4, atol=1e-6, err_msg=name)


def test_each_agent_has_a_model_of_what_it_observes_and_owns(team_run):
    from stable_baselines3 import PPO

    folder = team_run.model_path
    assert sorted(path.name for path in folder.iterdir()) == ["agent_0.zip", "agent_1.zip"]
    shapes = []
    for path in sorted(folder.iterdir()):
        model = PPO.load(path, device="cpu")
        shapes.append((model.observation_space.shape, model.action_space.shape))
        assert model.num_timesteps == 128
        (log,) = (team_run.folder / "tensorboard" / path.stem).iterdir()
        assert b"rollout/regret" in log.read_bytes()
    assert shapes == [((4,), (1,)), ((5,), (2,))]
    assert team_run.record.hyperparameters == SETTINGS


def test_the_log_has_each_agents_regret_and_the_folder_is_evaluated(team_run):
    episodes = read_episodes(team_run.folder / "episodes.csv")
    assert [episode.step for episode in episodes] == [40, 40, 80, 80, 120, 120]
    for episode in episodes:
        assert episode.regret == pytest.approx(np.mean(episode.agents_regret))
    report = EvaluationReport.read(team_run.folder / "evaluation.json")
    assert report.policy == "independent PPO"
    again = evaluate(str(team_run.model_path), TEAM, PROTOCOL, name="independent PPO")
    assert (again.regions, again.agents) == (report.regions, report.agents)


def test_independent_runs_resume(team_run, tmp_path):
    folder = tmp_path / "run"
    copy_files(team_run.folder, folder)
    team_run.record.updated(status="running").write(folder)
    with pytest.raises(OptionError, match=r"^independent=False: the run in"):
        independent(folder, resume=True, independent=False)
    result = independent(folder, steps=192, resume=True)
    assert (result.record.sessions, result.record.steps_done) == (2, 192)
    assert [e.step for e in result.episodes[:6]] == [e.step for e in team_run.episodes]
    assert len(result.episodes) > 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "TD3", "hyperparameters": {}}, "on-policy algorithm"),
        ({"algorithm": "sb3_contrib:RecurrentPPO", "hyperparameters": {}}, "on-policy algorithm"),
        ({"hyperparameters": {"use_sde": True}}, "without use_sde"),
    ],
)
def test_other_algorithms_are_rejected(changes, message, tmp_path):
    with pytest.raises(OptionError, match=message):
        independent(tmp_path / "run", **changes)
    with pytest.raises(SpecError, match="this is a task of a single agent"):
        train(TINY, independent=True, folder=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_independent_training_lowers_the_regret_of_each_agent(tmp_path):
    spec = SMESpec.from_dict(
        {"state_dim": 1, "action_dim": 2, "horizon": 16, "seed": 2,
         "team": {"agents": [{"action_dim": 1}, {"action_dim": 1}]}}
    )  # fmt: skip
    settings = {"learning_rate": 0.003, "gamma": 0, "n_steps": 64, "batch_size": 128}
    result = train(spec, independent=True, steps=2560, num_envs=8, hyperparameters=settings,
                   folder=tmp_path / "run", protocol=PROTOCOL, progress=False)  # fmt: skip
    regrets = np.array([episode.agents_regret for episode in result.episodes])
    assert (regrets[-16:].mean(axis=0) < 0.8 * regrets[:16].mean(axis=0)).all()
