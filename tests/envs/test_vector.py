"""`SMEVectorEnv`: resets of some lanes, autoreset modes, and what is refused."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.errors import (
    ActionError,
    EpisodeError,
    OptionError,
    ResourceLimitError,
    StateError,
)

MODES = [mode.value for mode in AutoresetMode]
HALF = np.full((3, 2), 0.5, np.float32)


def plane(mode="NextStep", **fields):
    return SMEVectorEnv("Plane1", 3, autoreset_mode=mode, **fields)


def test_next_step_ignores_the_actions_of_lanes_that_rest_but_not_their_form():
    env = plane(horizon=1)
    env.reset(seed=0)
    assert env.step(HALF)[3].all()
    for bad in (np.zeros((3, 1)), np.zeros((3, 3)), np.zeros(2), [["a", "b"]] * 3, HALF > 0):
        with pytest.raises(ActionError):
            env.step(bad)
    observations, rewards, terminated, truncated, infos = env.step(np.full((3, 2), np.nan))
    assert not rewards.any()
    assert not terminated.any()
    assert not truncated.any()
    assert not observations[:, 2:].any()
    assert not infos["similarity"].any()
    assert not infos["_similarity"].any()  # Gymnasium's mask: there was no step
    assert env.step(HALF)[3].all()


def test_disabled_refuses_to_step_ended_lanes_and_resets_those_asked_for():
    env = plane("Disabled", horizon=2)
    env.reset(seed=0)
    env.step(HALF)
    last = env.step(HALF)[0]
    with pytest.raises(EpisodeError, match=r"3 environments have ended.*reset_mask"):
        env.step(HALF)
    observations, _ = env.reset(options={"reset_mask": np.array([True, False, True])})
    np.testing.assert_array_equal(observations[1], last[1])
    assert not observations[[0, 2], 2:].any()
    with pytest.raises(EpisodeError, match=r"1 environments have ended \(the first is 1\)"):
        env.step(HALF)
    env.reset(options={"reset_mask": np.array([False, True, False])})
    assert env.step(HALF)[0][:, 2].tolist() == [0.5] * 3


@pytest.mark.parametrize("mode", MODES)
def test_lanes_that_are_not_reset_go_on_untouched(mode):
    env, whole = plane(mode, horizon=9), plane(mode, horizon=9)
    for batch in (env, whole):
        batch.reset(seed=0)
        batch.step(HALF)
    env.reset(seed=[None, 5, None], options={"reset_mask": np.array([False, True, False])})
    first, second = env.step(HALF), whole.step(HALF)
    np.testing.assert_array_equal(first[0][[0, 2]], second[0][[0, 2]])
    assert first[0][1, 2] == np.float32(1 / 9)
    assert second[0][1, 2] == np.float32(2 / 9)


def test_a_batch_begins_at_one_state_for_all_or_one_for_each():
    env = plane()
    env.reset(options={"state": [0.25, 0.5]})
    assert env.state.tolist() == [[0.25, 0.5]] * 3
    states = [[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]]
    observations, _ = env.reset(options={"state": states})
    assert env.state.tolist() == states
    assert observations[:, :2].tolist() == states
    mask = np.array([False, True, False])
    env.reset(options={"state": [0.125, 0.125], "reset_mask": mask})
    assert env.state.tolist() == [states[0], [0.125, 0.125], states[2]]


def test_a_step_before_every_lane_has_begun_is_refused():
    env = plane()
    with pytest.raises(EpisodeError, match="not begun"):
        env.step(HALF)
    env.reset(options={"reset_mask": np.array([True, True, False])})
    with pytest.raises(EpisodeError, match="not begun"):
        env.step(HALF)
    env.reset(options={"reset_mask": np.array([False, False, True])})
    env.step(HALF)


@pytest.mark.parametrize("mode", MODES)
def test_unusable_actions_are_refused_and_no_lane_moves(mode):
    symmetric = {"action_range": "symmetric"} if mode == "SameStep" else {}
    env, untouched = (plane(mode, k=2, **symmetric) for _ in range(2))
    for e in (env, untouched):
        e.reset(seed=0)
        e.step(HALF)
    for bad in (
        np.full((3, 2), np.nan, np.float32),
        np.array([[0.5, 0.5], [0.5, 0.5], [0.5, -np.inf]]),
        np.zeros((2, 3)),
        np.zeros(2),
        "abc",
        [[0.1, 0.2], [0.3], [0.4, 0.5]],
    ):
        with pytest.raises(ActionError, match="action"):
            env.step(bad)
    got, expected = env.step(HALF), untouched.step(HALF)
    for mine, other in zip(got[:4], expected[:4], strict=True):
        np.testing.assert_array_equal(mine, other)


def test_a_batch_that_cannot_be_made_is_a_typed_error():
    for kwargs, error, words in (
        ({"num_envs": 0}, OptionError, "num_envs=0.*at least 1"),
        ({"num_envs": 2.0}, OptionError, "num_envs=2.0"),
        ({"num_envs": 2**40}, ResourceLimitError, "fewer environments"),
        ({"autoreset_mode": "Sometimes"}, OptionError, "'NextStep', 'SameStep' or 'Disabled'"),
        ({"render_mode": "human"}, OptionError, "single environment"),
        ({"render_lanes": [0]}, OptionError, "needs render_mode='rgb_array'"),
        ({"action_range": "wide"}, OptionError, "action_range='wide'"),
        ({"max_episode_steps": 0}, OptionError, "max_episode_steps=0.*at least 1"),
    ):
        for make in (SMEVectorEnv, gymnasium.make_vec):
            name = "Plane1" if make is SMEVectorEnv else "SME/Plane1-v1"
            with pytest.raises(error, match=words):
                make(name, **{"num_envs": 2, **kwargs})  # type: ignore[operator]
    with pytest.raises(OptionError, match="num_envs='3'"):
        SMEVectorEnv("Plane1", num_envs="3")  # type: ignore[arg-type]


def test_options_and_seeds_that_cannot_be_used_are_refused_and_no_lane_moves():
    env = plane()
    env.reset(seed=0)
    env.step(HALF)
    before, twin = env.state, copy.deepcopy(env)
    for options, error, words in (
        ({"state": [0.5, 1.5]}, StateError, "outside"),
        ({"state": [[0.5, 0.5]] * 2}, StateError, "shape"),
        ({"reset_mask": [True, True, True]}, OptionError, "dtype bool"),
        ({"reset_mask": np.ones(2, bool)}, OptionError, "shape"),
        ({"reset_mask": np.zeros(3, bool)}, OptionError, "at least one"),
        ({"reset_maks": np.ones(3, bool)}, OptionError, "Did you mean 'reset_mask'"),
    ):
        with pytest.raises(error, match=words):
            env.reset(seed=9, options=options)
    for seed in ([1, 2], "abc", 1.5, True, [1, 2, 3.5], [1, 2, "c"], -1, [0, 0, -1]):
        with pytest.raises(OptionError, match="seed"):
            env.reset(seed=seed)  # type: ignore[arg-type]
    np.testing.assert_array_equal(env.state, before)
    np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])  # nor has it been seeded
    first = SMEVectorEnv("Plane1", num_envs=np.int64(3)).reset(seed=np.array(5))[0]  # type: ignore[arg-type]
    np.testing.assert_array_equal(first, env.reset(seed=5)[0])
    one = np.array([False, True, False])  # a masked seed is of the lanes of the mask
    again = env.reset(seed=40, options={"reset_mask": one})[0]
    np.testing.assert_array_equal(again[[0, 2]], first[[0, 2]])
    np.testing.assert_array_equal(again[1], SMEEnv("Plane1").reset(seed=41)[0])


@pytest.mark.parametrize("mode", MODES)
def test_a_pickled_batch_keeps_its_resting_lanes(mode):
    env = plane(mode, horizon=2)
    env.reset(seed=0)
    env.step(HALF)
    env.step(HALF)
    twin = pickle.loads(pickle.dumps(env))
    if mode == "Disabled":
        with pytest.raises(EpisodeError):
            twin.step(HALF)
        return
    for _ in range(5):
        for got, expected in zip(twin.step(HALF)[:4], env.step(HALF)[:4], strict=True):
            np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("mode", MODES)
def test_attributes_of_lanes_are_asked_for_as_of_gymnasiums_vectors(mode):
    env = gymnasium.make_vec("SME/Plane1-v1", num_envs=3, autoreset_mode=mode)
    assert env.autoreset_mode is env.metadata["autoreset_mode"] is AutoresetMode(mode)
    env.reset(seed=0)
    env.step(HALF)
    np.testing.assert_array_equal(env.get_attr("state"), env.unwrapped.state)
    assert env.get_attr("sme_spec") == (env.unwrapped.sme_spec,) * 3
    assert env.get_attr("spec") == (env.unwrapped.spec,) * 3
    assert env.call("action_space") == (env.single_action_space,) * 3
    best = env.get_attr("task")[0].optimal_action(env.get_attr("state")[1])
    assert best.shape == (2,)

    env.set_attr("label", ["a", "b", "c"])
    assert env.get_attr("label") == ("a", "b", "c")
    env.set_attr("label", "d")
    assert env.get_attr("label") == ("d",) * 3
    env.set_attr("act", lambda x: x + 1)
    assert env.call("act", 2) == (3, 3, 3)
    with pytest.raises(OptionError, match="each of the 3 environments"):
        env.set_attr("label", ["a", "b"])
    with pytest.raises(AttributeError, match="nothing"):
        env.get_attr("nothing")


@pytest.mark.parametrize("fields", [{}, {"observation": {"distractors": 2}}])
@pytest.mark.parametrize(("lanes", "steps"), [(1, 0), (1, 47), (1, 48), (3, 100)])
def test_a_restored_batch_goes_on_as_the_one_of_the_snapshot(fields, lanes, steps):
    there, here = (
        SMEVectorEnv("Plane1", lanes, autoreset_mode="SameStep", horizon=3, **fields)
        for _ in range(2)
    )
    there.reset(seed=5)
    actions = np.random.default_rng(1).random((steps + 60, lanes, 2))
    for each in actions[:steps]:
        there.step(each)
    here.restore(there.snapshot(), 5)
    for each in actions[steps:]:
        for one, other in zip(there.step(each)[:4], here.step(each)[:4], strict=True):
            assert np.array_equal(one, other)
