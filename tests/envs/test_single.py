"""`SMEEnv`: thresholds, what is refused, and cards in notebooks. The kit checks every step."""

import copy
import pickle
import re
import warnings

import gymnasium
import numpy as np
import pytest

import sme_registry
from sme_registry import SMESpec
from sme_registry.envs import SMEEnv
from sme_registry.errors import ActionError, EpisodeError, OptionError, StateError

START = np.array([0.3, 0.6, 0.9])


def env_of(**fields):
    """A small task, begun at a fixed state."""
    env = SMEEnv({"state_dim": 3, "action_dim": 2, **fields})
    env.reset(seed=0, options={"state": START})
    return env


def earn(env, step_reward):
    """Step with an action that earns `step_reward`: each channel (1 − r)/4 off, or 0.3 for 0."""
    optimal = env.task.optimal_action(env.state)
    off = (1.0 - step_reward) / 4.0 if step_reward > 0 else 0.3
    observation, reward, *ends, info = env.step(
        np.where(optimal < 0.5, optimal + off, optimal - off)
    )
    return observation, float(reward), *ends, info


def exactly_half(**fields):
    """A step whose reward, before any threshold, is ½ in every bit."""
    env = SMEEnv({"state_dim": 1, "action_dim": 1, **fields})
    for start in np.linspace(0, 1, 200):
        env.reset(options={"state": [start]})
        optimal = env.task.optimal_action(env.state)
        returned = env.step(optimal + (0.125 if optimal[0] < 0.5 else -0.125))
        if returned[4]["similarity"] == 0.875:
            return returned
    raise AssertionError("no state gives a reward of exactly one half")


def test_a_step_reward_of_exactly_r_min_pays_nothing_and_of_exactly_D_survives():
    assert exactly_half(r_min=0.5)[1] == 0.0
    assert exactly_half(r_min=float(np.nextafter(0.5, 0)))[1] == 0.5
    assert not exactly_half(D=0.5)[2]
    assert exactly_half(D=float(np.nextafter(0.5, 1)))[2]


def test_both_flags_are_set_on_one_step_and_truncation_pays():
    env = env_of(k=5, D=0.5, horizon=3)
    earn(env, 1.0)
    earn(env, 1.0)
    observation, reward, terminated, truncated, info = earn(env, 0.25)
    assert (terminated, truncated) == (True, True)
    assert reward == pytest.approx(2.25)
    assert info["accumulated_reward"] == observation[-1] == 0.0
    assert observation[-2] == 1.0


def test_the_symmetric_range_is_the_same_task_rescaled_and_both_are_clipped():
    unit, symmetric = SMEEnv("Default"), SMEEnv("Default", action_range="symmetric")
    unit.reset(seed=0)
    symmetric.reset(seed=0)
    for action in np.random.default_rng(0).integers(-9, 19, (50, 4)) / 8.0:  # exact in both
        first = unit.step(np.clip(action, 0.0, 1.0))
        second = symmetric.step(np.where(action > 2.0, 1e30, 2.0 * action - 1.0))
        np.testing.assert_array_equal(first[0], second[0])
        assert first[1] == second[1]
        rescaled = 2.0 * first[4]["optimal_action"] - 1.0
        np.testing.assert_array_equal(rescaled, second[4]["optimal_action"])
    beyond, within = copy.deepcopy(unit), unit
    assert beyond.step(np.full(4, -7.0))[1] == within.step(np.zeros(4))[1]
    np.testing.assert_array_equal(beyond.state, within.state)


def test_actions_far_below_the_unit_range_are_announced_once():
    far, near = np.full(4, -0.5, np.float32), np.full(4, -0.09, np.float32)
    envs = gymnasium.make_vec("SME/Default-v1", 2)
    team = sme_registry.make_parallel("Team2")
    names = team.possible_agents
    steps = {
        r'"symmetric", or make "SME/DefaultSymmetric-v1"': (SMEEnv("Default"), lambda a: a),
        "SME/DefaultSymmetric-v1": (envs, lambda a: np.array([a, a])),
        r'action_range="symmetric"\.': (
            team,
            lambda a: {n: a[: team.action_space(n).shape[0]] for n in names},
        ),
    }
    for remedy, (env, form) in steps.items():
        env.reset(seed=0)
        env.step(form(near))
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            for t in range(2000):
                ended = (team is env and not env.agents) or (
                    isinstance(env, SMEEnv) and t % 100 == 99
                )
                if ended:
                    env.reset()
                env.step(form(far))
        assert len(seen) == 1
        assert re.search(remedy, str(seen[0].message))
    symmetric = SMEEnv("Default", action_range="symmetric")
    symmetric.reset(seed=0)
    symmetric.step(far)


def test_an_action_is_the_same_in_whatever_form_it_comes():
    action = np.array([0.125, 0.75, 0.5, 0.25], np.float32)
    plain, other = SMEEnv("Default"), SMEEnv("Default")
    plain.reset(seed=0)
    other.reset(seed=0)
    for same in (
        action.tolist(),
        action.astype(np.float64),
        np.repeat(action, 3)[::3],
        action[::-1].copy()[::-1],
        np.array([action, action]).T.copy()[:, 0],
        action.astype(">f4"),
        action.view(np.ma.MaskedArray),
    ):
        np.testing.assert_array_equal(plain.step(action)[0], other.step(same)[0])
    for library, array in (("jax.numpy", "asarray"), ("torch", "from_numpy"), ("pandas", "Series")):
        same = getattr(pytest.importorskip(library), array)(action)
        np.testing.assert_array_equal(plain.step(action)[0], other.step(same)[0])
    with pytest.raises(ActionError, match="grad"):
        other.step(pytest.importorskip("torch").from_numpy(action).requires_grad_())
    whole = np.array([0, 1, 0, 1])
    np.testing.assert_array_equal(plain.step(whole.astype("f4"))[0], other.step(whole)[0])


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
def test_an_unusable_action_is_refused_and_nothing_moves(action_range):
    env, untouched = (SMEEnv("Plane1", action_range=action_range) for _ in range(2))
    for e in (env, untouched):
        e.reset(seed=0)
        e.step(np.full(2, 0.5, np.float32))
    for action, words in (
        (np.array([np.nan, 0.5], np.float32), "NaN"),
        (np.array([np.inf, 0.5]), "infinite"),
        (np.zeros(3, np.float32), r"shape \(3,\): must be of shape \(2,\)"),
        (np.zeros((1, 2), np.float32), "shape"),
        (0.5, "shape"),
        (None, "numbers"),
        ("ab", "numbers"),
        ([True, False], "numbers"),
        (np.array([True, False]), "numbers"),
        ([1j, 0], "numbers"),
        ([[0.1], [0.2, 0.3]], "array of shape"),
        ({"a": 1}, "numbers"),
    ):
        with pytest.raises(ActionError, match=words):
            env.step(action)
    good = np.full(2, 0.25, np.float32)
    np.testing.assert_array_equal(env.step(good)[0], untouched.step(good)[0])


def test_a_step_before_reset_or_after_the_end_is_refused():
    env = SMEEnv("Plane1", horizon=2)
    actions = np.zeros(2, np.float32), np.zeros(2), [0, 0]
    for message in ("has not begun", "has ended"):
        for action in actions:
            with pytest.raises(EpisodeError, match=message):
                env.step(action)
        env.reset()
        for _ in range(2):
            env.step(np.zeros(2, np.float32))


def test_a_given_state_begins_the_episode_and_takes_nothing_from_the_generator():
    first, second = SMEEnv("Plane1"), SMEEnv("Plane1")
    for state in ([0.25, 0.75], (0, 1), np.array([1.0, 0.0], np.float32)):
        observation, _ = first.reset(seed=0, options={"state": state})
        assert observation.tolist() == [*map(float, state), 0.0, 0.0]
        assert first.state.tolist() == [*map(float, state)]
    second.reset(seed=0, options={"state": [0.1, 0.2]})
    np.testing.assert_array_equal(first.reset()[0], second.reset()[0])
    np.testing.assert_array_equal(first.reset(options={})[0], second.reset(options=None)[0])


def test_a_state_that_cannot_begin_an_episode_is_refused():
    env = SMEEnv("Plane1")
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    before, twin = env.state, copy.deepcopy(env)
    for state, words in (
        ([0.5, 1.0000001], "outside"),
        ([-1e-300, 0.5], "outside"),
        ([np.nan, 0.5], "outside"),
        ([[0.5, 0.5]], "shape"),
        (["a", "b"], "shape"),
        (None, "shape"),
    ):
        with pytest.raises(StateError, match=words):
            env.reset(seed=9, options={"state": state})
        np.testing.assert_array_equal(env.state, before)
    with pytest.raises(OptionError, match=r"unknown option.*Did you mean 'state'"):
        env.reset(options={"sate": [0, 0]})
    with pytest.raises(OptionError, match="must be a dictionary"):
        env.reset(options=["state"])
    np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])  # nor has it been seeded


def test_rendering_without_a_mode_warns_and_gives_nothing():
    env = SMEEnv("Plane1")
    env.reset()
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


@pytest.mark.parametrize("name", ["Complexity10", "HardSafeMixed", "Distract32Driven"])
def test_an_episode_pickled_under_one_back_end_goes_on_under_the_other(name, monkeypatch):
    pytest.importorskip("numba")
    for here, there in (("numba", "numpy"), ("numpy", "numba")):
        for make in (SMEEnv, lambda name, **kw: sme_registry.make_vec(name, 3, **kw)):
            monkeypatch.setenv("SME_BACKEND", here)
            env = make(name, D=0.0, horizon=12)
            env.reset(seed=0)
            action = np.full(env.action_space.shape, 0.25, np.float32)
            env.step(action)
            monkeypatch.setenv("SME_BACKEND", there)
            moved = pickle.loads(pickle.dumps(env))
            for _ in range(11):
                got, expected = moved.step(action), env.step(action)
                np.testing.assert_array_equal(env.state, moved.state)
                np.testing.assert_array_equal(env.distractors, moved.distractors)
                for key in expected[4]:
                    np.testing.assert_allclose(got[4][key], expected[4][key], atol=3e-12)


def test_seeds_are_integers_of_at_least_0():
    first, second = SMEEnv("Plane1"), SMEEnv("Plane1")
    np.testing.assert_array_equal(first.reset(seed=7)[0], second.reset(seed=np.int64(7))[0])  # type: ignore[arg-type]
    for seed in ("abc", 1.5, True, -1, [1], np.array([1])):
        with pytest.raises(OptionError, match=r"seed=.*integer of at least 0"):
            first.reset(seed=seed)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "texts"),
    [
        (
            lambda: gymnasium.make("SME/Default-v1").unwrapped,
            ["SME/Default-v1", "[10] float32 in [0, 1]: state, t/T, r_cum/k", "not begun"],
        ),
        (lambda: SMEEnv(SMESpec(k=17).named("<script>")), ["Not the default: k=17"]),
        (lambda: sme_registry.make_vec("Default", num_envs=7).unwrapped, ["num_envs=7"]),
        (lambda: sme_registry.make_parallel("TeamBlind4"), ["agent_3", "0–1, 6–7"]),
        (lambda: sme_registry.make("Switch5").unwrapped, ["5 visits", "seed=4"]),
    ],
)
def test_a_card_in_a_notebook_shows_spaces_and_task(make, texts):
    html = make()._repr_html_()
    for text in texts:
        assert text in html
    assert "<script" not in html
    assert len(html.encode()) < 20_000
