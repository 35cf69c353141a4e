"""`SMETeamEnv`: what is refused, by whose name; pictures; beginnings."""

import copy
import pickle
import warnings

import numpy as np
import pytest

import sme_registry
from sme_registry import teams
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.errors import (
    ActionError,
    EpisodeError,
    OptionError,
    SpecError,
    StateError,
)

START = np.linspace(0.1, 0.9, 8)


def begun(spec="Team4", **kwargs):
    env = sme_registry.make_parallel(spec, **kwargs)
    env.reset(seed=0, options={"state": START})
    return env


def middle(env):
    return {name: np.full(env.action_space(name).shape, 0.5) for name in env.possible_agents}


def test_spaces_are_each_agents_own_and_the_same_object_each_time():
    env = sme_registry.make_parallel("DuoDeep", action_range="symmetric")
    assert env.possible_agents == ["scout_0", "driver_0"]
    assert [env.action_space(name).shape for name in env.possible_agents] == [(1,), (3,)]
    assert [env.observation_space(name).shape for name in env.possible_agents] == [(5,), (7,)]
    assert env.state_space.shape == (8,)
    for space in (env.action_space, env.observation_space):
        for name in env.possible_agents:
            assert space(name) is space(name)
        with pytest.raises(OptionError, match=r"agent='scot_0': no such agent\. .*'scout_0'"):
            space("scot_0")
    assert env.action_space("driver_0").low.tolist() == [-1.0] * 3


def test_bad_actions_are_refused_by_their_agents_name_and_nothing_moves():
    env, twin = begun(k=3), begun(k=3)
    good = middle(env)
    env.step(good)
    twin.step(good)
    for bad, words in (
        ({"agent_1": None}, "agent_1: action=None: must be numbers"),
        ({"agent_1": [[0.1], 0.2]}, r"agent_1: action=.*: must be an array of shape \(2,\)"),
        ({"agent_1": np.zeros(3)}, r"agent_1: action of shape \(3,\): must be of shape \(2,\)"),
        ({"agent_3": np.array([0.1, np.nan])}, "agent_3: action: has NaN or infinite"),
        ({"agent_2": np.array([0.1j, 0.1])}, "agent_2: action=.*dtype complex128"),
        ({"agnt_2": np.zeros(2)}, r"'agnt_2': no such agent\. Did you mean 'agent_"),
    ):
        with pytest.raises(ActionError, match=words):
            env.step({**good, **bad})
    mistyped = {("agent_22" if name == "agent_2" else name): a for name, a in good.items()}
    for actions, words in (
        ({}, "actions: agent_0, agent_1, agent_2, agent_3: action missing"),
        (mistyped, r"agent_2: action missing.*'agent_22'.*mean 'agent_2'"),
        (None, "actions=None: must be a dict from each agent's name to its action"),
    ):
        with pytest.raises(ActionError, match=words):
            env.step(actions)  # type: ignore[arg-type]
    for _ in range(5):
        ours, theirs = env.step(good), twin.step(good)
        assert ours[1:4] == theirs[1:4]
        for name in env.possible_agents:
            np.testing.assert_array_equal(ours[0][name], theirs[0][name])


def test_stepping_before_the_first_reset_and_after_the_end_is_refused():
    env = sme_registry.make_parallel("Team2", horizon=1)
    with pytest.raises(EpisodeError, match=r"has not begun. Call reset\(\) first"):
        env.step(middle(env))
    env.reset(seed=0)
    env.step(middle(env))
    with pytest.raises(EpisodeError, match=r"has ended. Call reset\(\) first"):
        env.step(middle(env))
    assert env.step({}) == ({}, {}, {}, {}, {})  # SuperSuit's black_death steps once more
    env.reset()
    env.step(middle(env))


def test_in_turns_a_bad_action_is_refused_in_its_own_turn_and_can_be_mended():
    env = sme_registry.make_aec("Team2", horizon=2)
    with pytest.raises(EpisodeError, match="has not begun"):
        env.step(np.zeros(2))
    env.reset(seed=0)
    for bad in (np.array([np.nan, 0.0]), np.zeros(3), None, "up"):
        with pytest.raises(ActionError, match="agent_0: action"):
            env.step(bad)
        assert env.agent_selection == "agent_0"
    for _ in range(4):
        env.step(np.zeros(2))
    assert env.truncations == {"agent_0": True, "agent_1": True}
    with pytest.raises(EpisodeError, match=r"agent_0: the episode has ended\. Pass None"):
        env.step(np.zeros(2))
    env.step(None)
    env.step(None)
    for action in (None, np.zeros(2)):
        with pytest.raises(EpisodeError, match="has ended"):
            env.step(action)


def test_a_bad_reset_is_refused_and_the_episode_goes_on():
    env = begun()
    env.step(middle(env))
    before = env.state()
    for arguments, error, words in (
        ({"seed": -1}, OptionError, "seed=-1: must be an integer of at least 0"),
        ({"options": {"sate": START}}, OptionError, "Did you mean 'state'"),
        ({"options": {"state": START[:3]}}, StateError, r"state of shape \(3,\)"),
        ({"options": {"state": START + 1.0}}, StateError, r"outside \[0, 1\]"),
    ):
        with pytest.raises(error, match=words):
            env.reset(**arguments)  # type: ignore[arg-type]
    np.testing.assert_array_equal(env.state(), before)
    assert env.agents == env.possible_agents
    assert env.step(middle(env))[0]["agent_0"][-2] == np.float32(2 / 100)


def test_reset_begins_at_the_given_state_with_empty_accounts():
    env = sme_registry.make_parallel("TeamBlind4", k=50)
    for _ in range(2):  # the second in the middle of an episode; unknown options are ignored
        observations, _ = env.reset(seed=1, options={"state": START, "render": 5})
        for name, channels in zip(env.possible_agents, env.task.observed, strict=True):
            expected = np.array([*START[list(channels)], 0.0, 0.0], np.float32)
            np.testing.assert_array_equal(observations[name], expected)
        env.state()[:] = 0.5  # of a copy, and of all channels, whatever is observed
        np.testing.assert_array_equal(env.state(), START)
        assert env.state_space.contains(env.state())
        best = np.split(env.task.optimal_action(START), 4)
        infos = env.step(dict(zip(env.agents, best, strict=True)))[4]
        assert all(info["accumulated_reward"] == info["step_reward"] for info in infos.values())


def test_making_with_a_bad_argument_is_a_typed_error():
    for spec, arguments, error, words in (
        ("Team4", {"render_mode": "ansi"}, OptionError, "render_mode='ansi'"),
        ("Team4", {"horizn": 3}, SpecError, "Did you mean 'horizon'"),
        ("Team4", {"action_dim": 9}, SpecError, "add up to 8: must be action_dim=9"),
        ("TeamBlind4", {"state_dim": 5}, SpecError, r"agent_1.observes=\[2, 3, 4, 5\]"),
    ):
        for make in (sme_registry.make_parallel, sme_registry.make_aec):
            with pytest.raises(error, match=words):
                make(spec, **arguments)  # type: ignore[arg-type]
    env = sme_registry.make_parallel("Team4", complexity=3, seed=8)
    assert env.sme_spec == sme_registry.load("Team4").derive(complexity=3, seed=8)


def test_gymnasiums_environments_refuse_a_team_and_say_what_to_use():
    for make in (
        lambda: SMEEnv("Team4"),
        lambda: SMEVectorEnv("Team4", 3),
        lambda: sme_registry.make("Team4"),
        lambda: sme_registry.make_vec("SME/Team4-v1", 3),
    ):
        with pytest.raises(SpecError, match=r"team: .* for 4 agents .*make_parallel"):
            make()


def test_a_rendered_team_is_a_picture_of_all_its_channels():
    pytest.importorskip("pygame")
    env = sme_registry.make_parallel("DuoDeep", render_mode="rgb_array")
    with pytest.raises(EpisodeError, match="has not begun"):
        env.render()
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (520, 800, 3)
    assert first.dtype == np.uint8
    twins = pickle.loads(pickle.dumps(env)), copy.deepcopy(env)
    for team in (env, *twins):
        team.step(middle(team))
    assert not np.array_equal(env.render(), first)
    for twin in twins:
        np.testing.assert_array_equal(twin.render(), env.render())
    env.close()


def test_a_team_has_the_attributes_that_skrl_and_supersuit_read():
    env = sme_registry.make_parallel("DuoDeep")
    for name in env.possible_agents:
        assert env.action_spaces[name] is env.action_space(name)
        assert env.observation_spaces[name] is env.observation_space(name)
    draws = []
    for _ in range(2):
        env.reset(seed=3)
        draws.append(env.np_random.integers(2**40))
    assert draws[0] == draws[1]
    assert pickle.loads(pickle.dumps(env)).np_random.integers(2**40) == env.np_random.integers(
        2**40
    )


def test_max_cycles_is_pettingzoos_name_of_the_horizon():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # importing it raises a deprecation warning of its own
        from pettingzoo.test.max_cycles_test import max_cycles_test
    max_cycles_test(teams)
    assert sme_registry.make_parallel("Team4", max_cycles=7).sme_spec.horizon == 7
    both = sme_registry.make_aec("Team4", max_cycles=7, horizon=7)
    assert both.unwrapped.sme_spec == sme_registry.load("Team4").derive(horizon=7)
    with pytest.raises(OptionError, match="max_cycles=7: must equal horizon=8"):
        sme_registry.make_aec("Team4", max_cycles=7, horizon=8)
    with pytest.raises(SpecError, match="horizon=0"):
        sme_registry.make_parallel("Team4", max_cycles=0)


def test_infos_of_an_aec_environment_are_zeros_before_its_first_step():
    env = sme_registry.make_aec("Team2")
    assert repr(env) == str(env) == "TurnBasedTeam(SMETeamEnv(SME/Team2-v1, 2 agents))"
    env.reset(seed=0)
    assert [info["regret"] for info in env.infos.values()] == [0.0, 0.0]
    for _ in env.possible_agents:
        env.step(env.action_space(env.agent_selection).sample())
    assert np.isfinite(env.last()[-1]["regret"])
