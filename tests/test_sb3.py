"""`SMEVecEnv` and `RegretCallback`: SB3's own numbers, under its algorithms and wrappers."""

import importlib
import pickle
import sys

import gymnasium
import numpy as np
import pytest

import sme_registry
from sme_registry import SMESpec
from sme_registry.errors import (
    ActionError,
    EpisodeError,
    MissingDependencyError,
    OptionError,
    SpecError,
    StateError,
)

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sme_registry.sb3 import RegretCallback, SMETeamVecEnv, SMEVecEnv
from sme_registry.testing import expect_same

# Ends early and late, pays late, and its lanes drift apart.
HARD = sme_registry.SMESpec(horizon=12, k=5, D=0.2, r_min=0.1, complexity=2, seed=4)
# Many a last step is terminated and truncated at once, or either alone.
BOTH = sme_registry.SMESpec(horizon=2, k=5, D=0.5)
DRIVEN = sme_registry.SMESpec(
    horizon=20, D=0.2, observation={"distractors": 5, "dynamics": "driven", "mixing": "nonlinear"}
)


def assert_same(got, expected):
    """Equal in every bit and type."""
    expect_same("ours", got, expected)
    expect_same("theirs", expected, got)


def dummy(spec=HARD, lanes=3, **kwargs):
    kwargs = {"action_range": "symmetric", **kwargs}
    return DummyVecEnv([lambda: sme_registry.make(spec, **kwargs)] * lanes)


@pytest.mark.parametrize(
    ("spec", "action_range"),
    [(HARD, "unit"), (BOTH, "symmetric"), ("HardSafeMixed", "symmetric"), (DRIVEN, "symmetric")],
    ids=["hard", "both-flags", "HardSafeMixed", "driven"],
)
def test_every_number_is_that_of_a_dummy_vec_env_of_singles(spec, action_range):
    ours = SMEVecEnv(spec, 3, action_range=action_range)
    theirs = dummy(spec, action_range=action_range)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.seed(42) == theirs.seed(42)
    assert_same(ours.reset(), theirs.reset())
    assert_same(ours.reset_infos, theirs.reset_infos)
    rng = np.random.default_rng(0)
    low = ours.action_space.low[0]
    ends = 0
    for _ in range(120):
        optimal = ours.get_attr("task", 0)[0].optimal_action(np.array(ours.get_attr("state")))
        action = low + (1 - low) * (0.6 * optimal + 0.4 * rng.random(optimal.shape))
        got, expected = ours.step(action.astype(np.float32)), theirs.step(action.astype(np.float32))
        assert_same(got, expected)
        assert_same(ours.reset_infos, theirs.reset_infos)
        ends += int(got[2].sum())
        assert_same(ours.get_attr("distractors"), theirs.get_attr("distractors"))
    assert ends >= 3
    for env in (ours, theirs):
        env.set_options({"state": np.full(8, 0.5)})
        if spec is DRIVEN:
            env.set_options({"distractors": np.full(5, 0.5)})
    assert_same(ours.reset(), theirs.reset())


def test_sb3s_wrappers_and_its_evaluation_work_on_it():
    env = VecNormalize(VecFrameStack(VecCheckNan(VecMonitor(SMEVecEnv(HARD, 3))), 2))
    env.seed(0)
    env.reset()
    rng = np.random.default_rng(0)
    episodes = 0
    for _ in range(40):
        observations, _, dones, infos = env.step(rng.uniform(-1, 1, (3, 4)).astype(np.float32))
        assert observations.shape == (3, 2 * 10)
        episodes += sum("episode" in info for info in infos)
        assert all(("terminal_observation" in i) == d for i, d in zip(infos, dones, strict=True))
    assert episodes > 0

    class Optimum:
        def predict(self, observation, **_):
            state = observation[:, :-2].astype(np.float64)
            return 2.0 * task.optimal_action(state) - 1.0, None

    env = VecMonitor(SMEVecEnv("Complexity2", 4, k=7, horizon=20))
    task = env.get_attr("task")[0]
    mean, spread = evaluate_policy(Optimum(), env, n_eval_episodes=8)  # type: ignore[arg-type]
    assert (mean, spread) == pytest.approx((20.0, 0.0), abs=1e-3)


def test_attributes_and_methods_of_the_lanes_are_reached():
    env = SMEVecEnv("Default", 3, complexity=2)
    env.seed(1)
    observations = env.reset()
    assert env.num_envs == 3
    assert env.sme_spec.complexity == 2
    assert [spec.complexity for spec in env.get_attr("sme_spec")] == [2, 2, 2]
    assert env.get_attr("spec", 0)[0].id == f"SME/{env.sme_spec.content_name}-v1"
    np.testing.assert_array_equal(env.get_attr("state", [2])[0].astype(np.float32),
                                  observations[2, :8])  # fmt: skip
    assert env.get_attr("render_mode") == [None] * 3
    assert env.has_attr("task")
    assert not env.has_attr("tusk")
    with pytest.raises(AttributeError):
        env.get_attr("tusk")
    env.set_attr("tusk", 5, indices=1)
    assert env.get_attr("tusk", 1) == [5]
    assert not env.has_attr("tusk")
    assert env.env_is_wrapped(Monitor) == [False] * 3
    assert env.env_is_wrapped(gymnasium.wrappers.TimeLimit, indices=[0]) == [False]
    with pytest.raises(AttributeError):
        env.env_method("no_such_method")
    # SB3 reads attributes of Gymnasium's environments like this.
    assert env.env_method("get_wrapper_attr", "sme_spec") == [env.sme_spec] * 3
    assert env.env_method("set_wrapper_attr", "tick", 1, indices=[1]) == [True]
    assert env.env_method("has_wrapper_attr", "tick") == [False, True, False]
    env.set_attr("plus", (5).__add__, indices=[0, 2])
    assert env.env_method("plus", 1, indices=[0, 2]) == [6, 6]
    env.close()


def test_options_begin_lanes_where_they_say():
    ours, theirs = SMEVecEnv("Plane1", 3), dummy("Plane1")
    for options in ({"state": [0.25, 0.5]}, [{}, {"state": [0.5, 1.0]}, {}], None):
        for env in (ours, theirs):
            env.seed(3)
            env.set_options(options)  # type: ignore[arg-type]
        assert_same(ours.reset(), theirs.reset())
        action = np.zeros((3, 2), np.float32)
        for _ in range(101):
            assert_same(ours.step(action), theirs.step(action))
        assert_same(ours.reset(), theirs.reset())  # options, like seeds, are used once
    ours.set_options({"state": [2.0, 0.0]})
    with pytest.raises(StateError):
        ours.reset()


def test_infos_are_fresh_and_writing_into_what_is_returned_moves_nothing():
    env, untouched = SMEVecEnv(HARD, 3), SMEVecEnv(HARD, 3)
    rng = np.random.default_rng(0)
    for e in (env, untouched):
        e.seed(0)
        e.reset()
    env.set_attr("note", "mine", indices=[1])
    for t in range(40):
        action = rng.uniform(-1, 1, (3, 4)).astype(np.float32)
        got, expected = env.step(action), untouched.step(action)
        assert_same(got, expected)
        observations, rewards, dones, infos = got
        observations[:], rewards[:], dones[:] = 9.0, 9.0, ~dones
        for info in infos:
            info["optimal_action"][:] = 9.0
            info.get("terminal_observation", observations)[:] = 9.0
            info.clear()
        if t == 5:
            env = pickle.loads(pickle.dumps(env))  # goes on as the original
            assert env.get_attr("note", 1) == ["mine"]
    assert_same(env.get_attr("state"), untouched.get_attr("state"))


def test_what_cannot_be_used_is_a_typed_error():
    with pytest.raises(OptionError, match="num_envs=0"):
        SMEVecEnv("Default", 0)
    with pytest.raises(OptionError, match="action_range"):
        SMEVecEnv("Default", action_range="wide")  # type: ignore[arg-type]
    with pytest.raises(SpecError, match="complexity"):
        SMEVecEnv("Default", complexity=0)
    with pytest.raises(SpecError, match="for a stream"):
        SMEVecEnv("Switch5", 2, complexity=3)
    env = SMEVecEnv("Default", 2)
    with pytest.raises(EpisodeError, match="reset"):
        env.step(np.zeros((2, 4)))
    with pytest.raises(EpisodeError, match="step_async"):
        env.step_wait()
    env.reset()
    with pytest.raises(ActionError, match="shape"):
        env.step(np.zeros((2, 3)))
    with pytest.raises(ActionError, match="NaN"):
        env.step(np.full((2, 4), np.nan))
    env.step(np.zeros((2, 4)))


def test_without_sb3_the_way_to_install_it_is_named(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("sme_registry.sb3")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(MissingDependencyError, match=r"\[train\]"):
        importlib.import_module("sme_registry.sb3")


def test_frames_are_those_of_a_dummy_vec_env_of_singles():
    pytest.importorskip("pygame")
    ours = SMEVecEnv(HARD, 2, render_mode="rgb_array")
    few = SMEVecEnv(HARD, 2, render_mode="rgb_array", render_lanes=[1])
    theirs = dummy(HARD, 2, render_mode="rgb_array")
    assert (ours.render_mode, ours.metadata["render_fps"]) == ("rgb_array", 10)
    for env in (ours, few, theirs):
        env.seed(3)
        env.reset()
    ours.action_space.seed(0)
    for _ in range(6):
        actions = np.stack([ours.action_space.sample() for _ in range(2)])
        for env in (ours, few, theirs):
            env.step(actions)
        frames = ours.get_images()
        np.testing.assert_array_equal(frames, theirs.get_images())
        np.testing.assert_array_equal(few.render(), frames[1])
    np.testing.assert_array_equal(ours.render(), theirs.render())


def test_a_vec_env_is_shown_with_its_task_and_its_lanes():
    assert repr(SMEVecEnv("Default", 2)) == "SMEVecEnv(SME/Default-v1, num_envs=2)"
    name = SMEVecEnv("Default", 2, k=3).get_attr("sme_spec")[0].content_name
    assert repr(SMEVecEnv("Default", 2, k=3)) == f"SMEVecEnv(SME/{name}, num_envs=2)"
    assert "num_envs=8, 2 teams of 4 agents" in repr(SMETeamVecEnv("Team4", 2))


@pytest.mark.parametrize("switch", ["episode", "step"])
def test_lives_of_a_stream_are_those_of_a_dummy_vec_env(switch):
    fields = {"horizon": 12, "D": 0.3, "complexity": 2}
    phases = [{"spec": fields | {"k": k, "seed": k}, "steps": 40} for k in (5, 2)]
    stream = sme_registry.StreamSpec(phases=phases, cycles=2, switch=switch, observes_phase=True)
    ours, theirs = SMEVecEnv(stream, 3), dummy(stream, 3)
    assert ours.observation_space == theirs.observation_space
    assert ours.seed(1) == theirs.seed(1)
    assert_same(ours.reset(), theirs.reset())
    assert_same(ours.reset_infos, theirs.reset_infos)
    rng = np.random.default_rng(0)
    lifetimes = set()
    for t in range(200):
        lanes = zip(ours.get_attr("task"), ours.get_attr("state"), strict=True)
        optimal = np.array([task.optimal_action(s) for task, s in lanes])
        share = rng.uniform(0.0, 0.6, (3, 1))
        action = 2 * ((1 - share) * optimal + share * rng.random(optimal.shape)) - 1
        got, expected = ours.step(action.astype(np.float32)), theirs.step(action.astype(np.float32))
        assert_same(got, expected)
        assert_same(ours.reset_infos, theirs.reset_infos)
        lifetimes.add(got[3][0]["lifetime"] - t)
        if t == 90:
            assert_same(ours.reset(), theirs.reset())  # goes on
            ours = pickle.loads(pickle.dumps(ours))
    assert lifetimes == {1}
    for env in (ours, theirs):
        env.set_options({"lifetime": 85})
    assert_same(ours.reset(), theirs.reset())
    assert_same(ours.reset_infos, theirs.reset_infos)
    assert [info["phase"] for info in ours.reset_infos] == [0, 0, 0]
    assert ours.get_attr("spec", 0)[0].id == f"SME/{stream.content_name}-v1"


SPEC = SMESpec(state_dim=2, action_dim=2, horizon=8, seed=5)


def make_env():
    return sme_registry.make(SPEC, action_range="symmetric")


def vec_env(kind):
    if kind == "batch":
        return SMEVecEnv(SPEC, 2)
    return DummyVecEnv([lambda: Monitor(make_env())] * 2)


def ppo(env):
    return PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=1, device="cpu")


@pytest.mark.parametrize("kind", ["batch", "dummy"])
def test_the_mean_regret_of_each_episode_is_logged(kind, tmp_path):
    env = vec_env(kind)
    model = ppo(env)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    callback = RegretCallback()
    model.learn(32, callback=callback)
    model.logger.close()
    env.close()
    assert [episode.step for episode in callback.episodes] == [16, 16, 32, 32]
    for episode in callback.episodes:
        # With k = 1 and r_min = 0 the return is the horizon less the sum of regrets.
        assert episode.episode_return == pytest.approx(8 * (1 - episode.regret), abs=1e-5)
        assert episode.length == 8
        assert not episode.terminated
    header, first, *_ = (tmp_path / "progress.csv").read_text().splitlines()
    logged = dict(zip(header.split(","), first.split(","), strict=True))
    expected = np.mean([episode.regret for episode in callback.episodes])
    assert float(logged["rollout/regret"]) == pytest.approx(expected)
    assert "rollout/similarity" in logged


def test_a_second_learn_continues_the_episodes_or_begins_new_ones():
    model = ppo(vec_env("batch"))
    model.n_steps = model.rollout_buffer.buffer_size = 4
    callback = RegretCallback()
    model.learn(8, callback=callback)
    assert callback.episodes == []
    model.learn(8, callback=callback, reset_num_timesteps=False)
    assert [(e.step, e.length) for e in callback.episodes] == [(16, 8), (16, 8)]
    model.learn(8, callback=callback)
    model.learn(8, callback=callback)
    assert len(callback.episodes) == 2
    model.set_env(vec_env("batch"))  # whose episodes begin anew
    model.learn(16, callback=callback, reset_num_timesteps=False)
    assert [e.length for e in callback.episodes[2:]] == [8, 8]


def test_the_return_is_that_of_the_task_and_not_a_normalised_one():
    callback = RegretCallback()
    ppo(VecNormalize(vec_env("batch"))).learn(32, callback=callback)
    for episode in callback.episodes:
        assert episode.episode_return == pytest.approx(8 * (1 - episode.regret), abs=1e-5)


def test_a_teams_agents_have_their_own_regret():
    callback = RegretCallback()
    model = ppo(SMETeamVecEnv("Team2", 2, horizon=8))
    model.learn(64, callback=callback)
    assert [episode.step for episode in callback.episodes] == [16, 16, 32, 32]
    for episode in callback.episodes:
        assert episode.regret == pytest.approx(np.mean(episode.agents_regret))
        assert len(episode.agents_regret) == 2


def test_other_environments_are_rejected():
    with pytest.raises(OptionError, match="no 'regret'"):
        ppo(gymnasium.make("Pendulum-v1")).learn(16, callback=RegretCallback())
