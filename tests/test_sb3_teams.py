"""`SMETeamVecEnv`: a policy shared by the agents of a team, on the numbers of `SMETeamEnv`."""

import numpy as np
import pytest

import sme_registry
from sme_registry.errors import ActionError, EpisodeError, OptionError, SpecError, StateError

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sme_registry.sb3 import SMETeamVecEnv

# Unequal agents that see parts of the state; ends early and late, pays late, teams drift apart.
UNEQUAL = sme_registry.SMESpec.from_dict(
    {
        "state_dim": 5, "action_dim": 6, "horizon": 12, "k": 5, "D": 0.2, "r_min": 0.1,
        "complexity": 2, "seed": 4,
        "team": {"agents": [
            {"action_dim": 1, "observes": [1, 3]},
            {"action_dim": 3},
            {"action_dim": 2, "observes": [0, 2, 4]},
        ]},
    }
)  # fmt: skip
SHARED = UNEQUAL.derive(team={**UNEQUAL.to_dict()["team"], "reward": "team"}, D=0.1)
# Many a last step is terminated and truncated at once, or either alone.
BOTH = UNEQUAL.derive(horizon=2, D=0.5)


def shown(env, agent, own):
    """The shared observation of an agent, put together from its own one."""
    task = env.task
    S, n = task.spec.state_dim, len(task.names)
    observation = np.zeros(S + 2 + n, np.float32)
    channels = list(task.observed[agent])
    observation[channels] = own[: len(channels)]
    observation[S : S + 2] = own[len(channels) :]
    observation[S + 2 + agent] = 1.0
    return observation


@pytest.mark.parametrize(
    ("spec", "action_range"),
    [(UNEQUAL, "symmetric"), (SHARED, "unit"), (BOTH, "symmetric"), ("Default", "unit")],
    ids=["unequal", "shared", "both-flags", "team-of-one"],
)
def test_every_number_is_that_of_teams_stepped_in_a_loop(spec, action_range):
    teams = 3
    ours = SMETeamVecEnv(spec, teams, action_range=action_range)
    theirs = [sme_registry.make_parallel(spec, action_range=action_range) for _ in range(teams)]
    task = ours.get_attr("task", 0)[0]
    n, own = len(task.names), task.owned
    assert ours.num_envs == teams * n
    assert ours.get_attr("agent") == list(task.names) * teams
    ours.seed(42)
    got = ours.reset()
    observed = [env.reset(seed=42 + team)[0] for team, env in enumerate(theirs)]
    rng = np.random.default_rng(0)
    low = ours.action_space.low[0]
    ends = set()
    for _ in range(101):
        for lane in range(teams * n):
            team, agent = divmod(lane, n)
            name = task.names[agent]
            expected = shown(theirs[team], agent, observed[team][name])
            np.testing.assert_array_equal(got[lane], expected, strict=True)
        optimal = task.optimal_action(np.array([env.state() for env in theirs]))
        joint = low + (1 - low) * (0.6 * optimal + 0.4 * rng.random(optimal.shape))
        joint = joint.astype(np.float32)
        actions = rng.uniform(low, 1, (teams * n, ours.action_space.shape[0])).astype(np.float32)
        for lane in range(teams * n):
            team, agent = divmod(lane, n)
            actions[lane, : own[agent].stop - own[agent].start] = joint[team, own[agent]]
        got, rewards, dones, infos = ours.step(actions)
        assert rewards.dtype == np.float32
        for team, env in enumerate(theirs):
            acted = {name: joint[team, own[i]] for i, name in enumerate(task.names)}
            observed[team], paid, dead, late, infos_by_agent = env.step(acted)
            for agent, name in enumerate(task.names):
                lane = team * n + agent
                info = infos[lane]
                assert rewards[lane] == np.float32(paid[name])
                assert dones[lane] == (dead[name] or late[name])
                assert info.pop("TimeLimit.truncated") == (late[name] and not dead[name])
                assert ("terminal_observation" in info) == dones[lane]
                if dones[lane]:
                    ends.add((dead[name], late[name]))
                    last = info.pop("terminal_observation")
                    expected = shown(env, agent, observed[team][name])
                    np.testing.assert_array_equal(last, expected, strict=True)
                assert info.keys() == infos_by_agent[name].keys()
                for key, value in infos_by_agent[name].items():
                    assert type(info[key]) is type(value)
                    np.testing.assert_array_equal(info[key], value, strict=True)
            if not env.agents:
                observed[team], _ = env.reset()
    assert ends
    if spec is BOTH:
        assert ends == {(True, False), (False, True), (True, True)}


def test_entries_beyond_an_agents_own_channels_move_nothing():
    one, other = SMETeamVecEnv(UNEQUAL, 2, D=0), SMETeamVecEnv(UNEQUAL, 2, D=0)
    for env in (one, other):
        env.seed(0)
        env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 3)).astype(np.float32)
    changed = actions.copy()
    changed[[0, 3], 1:] = 0.5  # agent_0 owns one channel
    changed[[2, 5], 2:] = -0.5  # agent_2 owns two
    np.testing.assert_array_equal(one.step(actions)[0], other.step(changed)[0])
    changed[1, 2] = 0.123  # agent_1 owns all three
    assert not np.array_equal(one.step(actions)[0], other.step(changed)[0])


def test_sb3_learns_one_policy_for_all():
    env = VecNormalize(VecMonitor(SMETeamVecEnv("Team4", 2, horizon=10, k=5)))
    model = PPO("MlpPolicy", env, seed=0, device="cpu", n_steps=32, batch_size=64, n_epochs=1)
    model.learn(256)
    assert model.num_timesteps == 256
    assert [episode["l"] for episode in model.ep_info_buffer] == [10] * 24  # of each agent


def test_options_begin_teams_where_they_say_and_are_used_once():
    env = SMETeamVecEnv(UNEQUAL, 2)
    start = [0.25, 0.5, 0.75, 0.0, 1.0]
    env.set_options({"state": start})
    env.reset()
    assert [list(state) for state in env.get_attr("state")] == [start] * 6
    env.set_options([{}] * 3 + [{"state": start}] * 3)
    env.seed(1)
    env.reset()
    drawn, given = env.get_attr("state", [0, 3])
    assert list(given) == start
    assert list(drawn) != start
    env.reset()
    assert list(env.get_attr("state", 3)[0]) != start


def test_what_cannot_be_used_is_a_typed_error():
    with pytest.raises(OptionError, match="num_envs=0"):
        SMETeamVecEnv("Team2", 0)
    with pytest.raises(SpecError, match="action_dim"):
        SMETeamVecEnv("Team2", action_dim=7)
    env = SMETeamVecEnv(UNEQUAL, 2)
    action = np.zeros((6, 3), np.float32)
    with pytest.raises(EpisodeError, match="reset"):
        env.step(action)
    with pytest.raises(EpisodeError, match="step_async"):
        env.step_wait()
    env.seed(0)
    env.reset()
    before = env.get_attr("state", 0)[0]
    counted, unused = action.copy(), action.copy()
    counted[0, 0] = unused[0, 2] = np.nan
    for broken, words in ((action[:5], "shape"), (counted, "NaN"), (unused, "NaN")):
        with pytest.raises(ActionError, match=words):
            env.step(broken)
    np.testing.assert_array_equal(env.get_attr("state", 0)[0], before)
    env.step(action)
    with pytest.raises(AttributeError):
        env.env_method("reset")  # an agent cannot be reset without its team
    for options, error in (
        ({"state": [2.0] * 5}, StateError),
        ({"stat": [0.5] * 5}, OptionError),
        ([{"state": [0.5] * 5}] + [{}] * 5, OptionError),
        ([{"state": [0.1 * lane] * 5} for lane in range(6)], OptionError),
    ):
        env.set_options(options)  # type: ignore[arg-type]
        with pytest.raises(error):
            env.reset()
