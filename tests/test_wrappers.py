"""Recorded regret is that of `info`, in every kind of loop, and the file is that of `sme train`."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics

import sme_registry
from sme_registry import SMESpec
from sme_registry.errors import OptionError
from sme_registry.task import materialize
from sme_registry.training.record import read_episodes
from sme_registry.wrappers import (
    RecordRegret,
    RecordVectorRegret,
    StepWithCost,
    VectorStepWithCost,
)

# Some episodes end by D, others at the horizon.
SPEC = SMESpec(state_dim=3, action_dim=1, D=0.1, r_min=0.1, horizon=3)
STEPS = 60


def actions(lanes=1):
    return np.random.default_rng(4).random((STEPS, lanes, 1), dtype=np.float32)


def by_hand(env, taken, seed=0):
    """Return, length, mean regret, mean similarity and end of each episode."""
    env.reset(seed=seed)
    episodes = []
    rows = []
    for action in taken:
        _, reward, terminated, truncated, info = env.step(action)
        rows.append((reward, info["regret"], info["similarity"]))
        if terminated or truncated:
            rewards, regrets, similarities = np.array(rows, float).T
            episodes.append(
                (rewards.sum(), len(rows), regrets.mean(), similarities.mean(), terminated)
            )
            rows = []
            env.reset()
    return episodes


def as_rows(env):
    return [
        (each.episode_return, each.length, each.regret, each.similarity, each.terminated)
        for each in env.episodes
    ]


def test_each_episode_has_its_mean_regret(tmp_path):
    path = tmp_path / "runs" / "episodes.csv"
    env = RecordRegret(sme_registry.make(SPEC), path)
    assert np.isnan(env.online_regret)
    env.reset(seed=0)
    infos, regrets = [], []
    for action in actions()[:, 0]:
        _, _, terminated, truncated, info = env.step(action)
        regrets.append(info["regret"])
        assert ("episode" in info) == (terminated or truncated)
        if terminated or truncated:
            infos.append(info["episode"])
            env.reset()
    env.close()
    expected = by_hand(sme_registry.make(SPEC), actions()[:, 0])
    assert {episode[-1] for episode in expected} == {True, False}
    np.testing.assert_allclose(as_rows(env), expected, atol=1e-12)
    assert [info["regret"] for info in infos] == [episode.regret for episode in env.episodes]
    assert env.online_regret == pytest.approx(np.mean(regrets))
    last = env.episodes[-1].step
    assert infos[-1]["online_regret"] == pytest.approx(np.mean(regrets[:last]))
    read = read_episodes(path)
    assert [each.step for each in read] == [each.step for each in env.episodes]
    assert [each.regret for each in read] == pytest.approx([each.regret for each in env.episodes])


@pytest.mark.parametrize(
    ("kind", "mode"),
    [("native", "NextStep"), ("native", "SameStep"), ("sync", "NextStep"), ("sync", "Disabled")],
)
def test_a_vector_records_the_same_episodes_in_every_mode(kind, mode):
    lanes, mode_ = 3, AutoresetMode(mode)
    taken = actions(lanes)
    if kind == "native":
        envs = sme_registry.make_vec(SPEC, lanes, autoreset_mode=mode)
    else:
        makers = [lambda: sme_registry.make(SPEC)] * lanes
        envs = SyncVectorEnv(makers, autoreset_mode=mode_)
    recorded = RecordVectorRegret(envs)
    recorded.reset(seed=0)
    ended = np.zeros(lanes, bool)
    used = [[] for _ in range(lanes)]
    in_infos = 0
    for action in taken:
        if mode_ is AutoresetMode.DISABLED and ended.any():
            recorded.reset(options={"reset_mask": ended})
            ended = np.zeros(lanes, bool)
        for lane in range(lanes):
            if not (mode_ is AutoresetMode.NEXT_STEP and ended[lane]):
                used[lane].append(action[lane])
        _, _, terminated, truncated, info = recorded.step(action)
        ended = terminated | truncated
        if ended.any():
            np.testing.assert_array_equal(info["_episode"], ended)
            assert (info["episode"]["regret"][ended] > 0).all()
            assert (info["episode"]["l"][~ended] == 0).all()
        in_infos += int(ended.sum())
    expected = []
    for lane in range(lanes):
        expected += by_hand(sme_registry.make(SPEC), used[lane], seed=lane)
    assert in_infos == len(recorded.episodes) == len(expected)
    np.testing.assert_allclose(sorted(as_rows(recorded)), sorted(expected), atol=1e-9)


def test_it_stands_beside_gymnasiums_statistics():
    env = RecordRegret(RecordEpisodeStatistics(sme_registry.make(SPEC)))
    env.reset(seed=0)
    info = {}
    while "episode" not in info:
        info = env.step(np.ones(1, np.float32))[-1]
    assert {"r", "l", "t", "regret", "similarity", "online_regret"} == set(info["episode"])
    envs = RecordVectorRegret(RecordVectorStatistics(sme_registry.make_vec(SPEC, 2)))
    envs.reset(seed=0)
    info = {}
    while "episode" not in info:
        info = envs.step(np.ones((2, 1), np.float32))[-1]
    assert {"r", "regret"} <= set(info["episode"])


def test_a_file_that_exists_is_kept_unless_forced_and_other_environments_refused(tmp_path):
    path = tmp_path / "episodes.csv"
    path.write_text("mine")
    with pytest.raises(OptionError, match=r"already exists.*force=True"):
        RecordRegret(sme_registry.make(SPEC), path)
    assert path.read_text() == "mine"
    RecordRegret(sme_registry.make(SPEC), path, force=True).close()
    assert path.read_text().startswith("episode,step,")
    env = RecordRegret(gymnasium.make("Pendulum-v1"))
    env.reset(seed=0)
    with pytest.raises(OptionError, match="info has no 'regret'"):
        env.step(np.zeros(1, np.float32))


LIMITED = SMESpec(state_dim=3, action_dim=2, horizon=4, safety={"tightness": 0.3})


def high_actions(lanes, steps=11):
    return np.random.default_rng(2).uniform(0.5, 1.0, (steps, lanes, 2)).astype(np.float32)


def singles(taken):
    """Cost and safe regret of each step, `[steps, lanes, 2]`, of single environments."""
    rows = []
    for lane in range(taken.shape[1]):
        env = sme_registry.make(LIMITED)
        env.reset(seed=lane)
        rows.append([])
        for action in taken[:, lane]:
            *_, truncated, info = env.step(action)
            rows[-1].append((info["cost"], info["safe_regret"]))
            if truncated:
                env.reset()
    return np.array(rows).swapaxes(0, 1)


def test_a_step_with_cost_has_the_six_values_of_safety_gymnasium():
    env = StepWithCost(sme_registry.make(LIMITED))
    env.reset(seed=0)
    taken = high_actions(1)[:4]
    costs = []
    for action in taken[:, 0]:
        observation, reward, cost, terminated, truncated, info = env.step(action)
        assert env.observation_space.contains(observation)
        assert (reward, terminated) == (info["step_reward"], False)
        assert type(cost) is float
        costs.append(cost)
    assert truncated
    assert costs == singles(taken)[:, 0, 0].tolist()
    assert max(costs) > 0.0


@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_a_vector_with_costs_has_those_of_its_singles(mode):
    lanes = 3
    taken = high_actions(lanes)
    expected = singles(taken)[:, :, 0]
    envs = VectorStepWithCost(sme_registry.make_vec(LIMITED, lanes, autoreset_mode=mode))
    envs.reset(seed=0)
    index, begins = 0, False
    while index < len(taken):
        observations, _, costs, _, truncated, info = envs.step(taken[index])
        if begins:  # the step that begins an episode in the mode NEXT_STEP
            assert costs.tolist() == [0.0] * lanes
            begins = False
            continue
        assert costs.tolist() == expected[index].tolist()
        if truncated.any():
            begins = mode == "NextStep"
            if mode == "Disabled":
                envs.reset(options={"reset_mask": truncated})
            if mode == "SameStep":
                assert not np.array_equal(info["final_observation"][0], observations[0])
                assert info["_final_observation"].all()
        index += 1


@pytest.mark.parametrize("kind", ["single", "SameStep", "NextStep"])
def test_recorded_episodes_have_their_cost(kind, tmp_path):
    path, lanes = tmp_path / "episodes.csv", 1 if kind == "single" else 2
    taken = high_actions(lanes, 4)
    infos = {}
    if kind == "single":
        env = RecordRegret(sme_registry.make(LIMITED), path)
        env.reset(seed=0)
        for action in taken[:, 0]:
            infos = env.step(action)[4]
    else:
        env = RecordVectorRegret(sme_registry.make_vec(LIMITED, 2, autoreset_mode=kind), path)
        env.reset(seed=0)
        for action in taken:
            infos = env.step(action)[4]
    env.close()
    values = singles(taken)
    expected = [
        (cost.mean(), (cost > 0).mean(), regret.mean())
        for cost, regret in values.transpose(1, 2, 0)
    ]
    for episodes in (env.episodes, read_episodes(path)):
        np.testing.assert_allclose([each.safety for each in episodes], expected, rtol=1e-8)
    assert np.ravel(infos["episode"]["cost"]) == pytest.approx([row[0] for row in expected])


@pytest.mark.parametrize(
    ("tightness", "channels", "above", "share"),
    [(0.005, 1, 0.0, 0.0), (0.005, 1, 2e-6, 1.0), (0.2, 200, 0.0, 0.0)],
)
def test_steps_above_a_limit_by_more_than_rounding_are_violations(
    tightness, channels, above, share
):
    spec = SMESpec(
        action_dim=channels,
        horizon=20,
        safety={"tightness": tightness},
        policy_init="unit_variance",
    )
    single = RecordRegret(sme_registry.make(spec))
    ours = RecordVectorRegret(sme_registry.make_vec(spec, 2))
    gymnasiums = RecordVectorRegret(
        gymnasium.vector.SyncVectorEnv([lambda: sme_registry.make(spec)])
    )
    finished = []
    for env in (single, ours, gymnasiums):
        env.reset(seed=0)
        for _ in range(spec.horizon):
            state = (env if env is not gymnasiums else env.unwrapped.envs[0]).unwrapped.state
            action = materialize(spec).limit(state)
            action[..., 0] += above
            if env is gymnasiums:
                action = action[None]
            env.step(action.astype(np.float32))
        finished += env.episodes
    assert len(finished) == 4
    for episode in finished:
        assert episode.safety is not None
        assert episode.safety.violating_share == share


def test_a_task_without_limits_has_no_costs():
    vector = SyncVectorEnv([lambda: sme_registry.make(LIMITED)])
    for wrapper, env, words in (
        (StepWithCost, sme_registry.make(SPEC), "needs a task with limits"),
        (VectorStepWithCost, sme_registry.make_vec(SPEC, 2), "needs a task with limits"),
        (StepWithCost, gymnasium.make("Pendulum-v1"), ".* has no `sme_spec`"),
        (VectorStepWithCost, vector, r".* vector of sme_registry\.make_vec"),
    ):
        with pytest.raises(OptionError, match=f"^{wrapper.__name__}: {words}"):
            wrapper(env)  # type: ignore[operator]
