"""`uses`: every kind of name, and what is said of those that lead nowhere."""

import sys

import numpy as np
import pytest

from sme_registry import SMESpec
from sme_registry.envs import SMEEnv
from sme_registry.envs.episodes import info_of_envs
from sme_registry.errors import OptionError, SpecError, UnknownNameError
from sme_registry.spec.document import StrictModel
from sme_registry.studies import run_cell
from sme_registry.training import train
from sme_registry.training.algorithms import (
    BACKENDS,
    Backend,
    check_hyperparameters,
    find,
    load_algorithm,
)
from sme_registry.training.learn import Learner, Steps
from sme_registry.training.models import new_model
from tests.studies.cells import cell_of

sb3 = pytest.importorskip("stable_baselines3")

SPEC = SMESpec(state_dim=2, action_dim=2, horizon=20)
MODULE = """
from stable_baselines3 import PPO
number = 3
def small(env, *, seed, width=8):
    return PPO("MlpPolicy", env, seed=seed, device="cpu", policy_kwargs={"net_arch": [width]})
def nothing(env, *, seed):
    return None
"""


@pytest.fixture
def env():
    from sme_registry.sb3 import SMEVecEnv

    return SMEVecEnv(SPEC)


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    (tmp_path / "own_learners.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("own_learners", None)


def made(uses, env, **hyperparameters):
    check_hyperparameters(uses, hyperparameters)
    return new_model(uses, env, seed=1, steps=100, hyperparameters=hyperparameters)


@pytest.mark.parametrize("name", ["PPO", "Td3", "ddpg"])
def test_sb3s_algorithms_are_found_in_any_case(name):
    assert load_algorithm(find(name).name) is getattr(sb3, name.upper())


def test_a_class_of_sb3s_kind_is_used_as_it_is(env):
    contrib = pytest.importorskip("sb3_contrib")
    tqc = made("sb3_contrib:TQC", env, top_quantiles_to_drop_per_net=3, train_freq=[2, "episode"])
    assert type(tqc) is contrib.TQC
    assert tqc.top_quantiles_to_drop_per_net == 3
    assert tqc.train_freq.frequency == 2
    assert tqc.seed == 1
    assert tqc.replay_buffer.buffer_size == 101
    assert tqc.learn(10).num_timesteps >= 10
    assert made("TD3", env, buffer_size=50).replay_buffer.buffer_size == 50


def test_a_function_makes_the_learner_by_its_module_or_an_installed_entry_point(
    env, own_module, monkeypatch
):
    info = own_module / "own_learners-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-learners\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[sme_registry.algorithms]\nsmall-ppo = own_learners:small\nlost = own_learners:lost\n"
    )
    monkeypatch.syspath_prepend(str(own_module))
    assert made("own_learners:small", env, width=5).policy.net_arch == [5]
    assert made("small-ppo", env).policy.net_arch == [8]
    with pytest.raises(UnknownNameError, match="Did you mean 'small-ppo'"):
        load_algorithm("smal-ppo")
    with pytest.raises(OptionError, match="entry point='own_learners:lost': cannot be imported"):
        load_algorithm("lost")


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("TD4", UnknownNameError, "Did you mean 'TD3'"),
        ("no_such_module:make", OptionError, "cannot be imported: ModuleNotFoundError"),
        ("own_learners:smal", OptionError, "AttributeError.*Did you mean 'small'"),
        ("own_learners:number", OptionError, "is of type int: must be a class"),
    ],
)
def test_a_name_that_leads_nowhere_is_explained(name, error, said, own_module):
    with pytest.raises(error, match=said):
        check_hyperparameters(name, {"width": 3})


@pytest.mark.parametrize(
    ("uses", "settings", "said"),
    [
        ("TD3", {"learning_rat": 0.1}, "Did you mean 'learning_rate'"),
        ("PPO", {"seed": 3}, "PPO has no such hyperparameter"),
        ("SAC", {"policy_kwargs": {"depth": 3}}, r"policy_kwargs\.depth=3: unknown field"),
        ("SAC", {"learning_rate": "fast"}, "rejects the task or the hyperparameters"),
        ("own_learners:small", {"depth": 3}, "small has no such hyperparameter.*Known: width"),
        ("own_learners:nothing", {}, "returned a NoneType, which has no learn and no predict"),
    ],
)
def test_what_an_algorithm_does_not_take_or_make_is_refused(uses, settings, said, env, own_module):
    with pytest.raises(OptionError, match=said):
        made(uses, env, **settings)


class ConstantSettings(StrictModel):
    level: float = 0.0


def constant_settings(name):
    """What a row of the table names."""
    return ConstantSettings


class Constant(Learner):
    """A back-end: it acts by a constant, and learns nothing."""

    def __init__(self, name, run):
        super().__init__(name, run)
        level = ConstantSettings(**run.hyperparameters).level
        self.steps, self.total = 0, run.steps
        self.model = lambda observations: np.full((len(observations), 2), level)

    def learn(self, watch):
        env = SMEEnv(self.run.document, action_range=self.run.action_range)
        observation, _ = env.reset(seed=self.run.seed)
        while self.steps < self.total:
            action = self.model(observation[None])[0].astype(np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            self.steps += 1
            ended = terminated or truncated
            watch.on_steps(Steps([reward], info_of_envs([info]), [terminated], [ended]))
            if ended:
                observation, _ = env.reset()


def test_a_back_end_is_a_module_and_a_row_for_training_and_for_studies(tmp_path, monkeypatch):
    row = Backend(
        settings=f"{__name__}:constant_settings",
        learns=("task",),
        learner=f"{__name__}:Constant",
        names=("centre",),
    )
    monkeypatch.setitem(BACKENDS, "constant", row)
    result, reference = (
        run_cell(cell_of(spec=SPEC, uses=uses, steps=40, evaluations=2))
        for uses in ("constant:centre", "reference:constant")
    )
    assert result.curve.to_dict() == reference.curve.to_dict()
    assert 0.0 < result.online_regret < 1.0
    options = {"steps": 40, "protocol": {"states_per_region": 50}, "progress": False}
    run = train(SPEC, algorithm="constant:Centre", folder=tmp_path / "run", **options)
    assert [episode.step for episode in run.episodes] == [20, 40]
    assert run.report.regions[0].similarity == result.report.regions[0].similarity
    with pytest.raises(OptionError, match="Did you mean 'level'"):
        check_hyperparameters("constant:centre", {"levl": 1.0})
    with pytest.raises(UnknownNameError, match="must be one of constant:centre"):
        find("constant:center")
    with pytest.raises(SpecError, match="learns a task of a single agent, and this is the task of"):
        train("Team4", algorithm="constant:centre", folder=tmp_path / "team")
