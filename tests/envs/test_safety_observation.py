"""Environments of tasks with `safety` and `observation`: what agents see and what limits them."""

import copy

import gymnasium
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from sme_registry import SMESpec, StreamSpec
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.errors import OptionError, SpecError, StateError
from sme_registry.task.draw import counted
from sme_registry.teams import SMETeamEnv
from tests.strategies import specs

SPECS = {
    "safe": SMESpec(horizon=20, safety={"tightness": 0.2}),
    "safe and deep": SMESpec(
        horizon=20, complexity=3, hidden_width=20, r_min=0.3, k=3, safety={"tightness": 0.5}
    ),
    "noise": SMESpec(horizon=20, observation={"distractors": 8}),
    "autonomous": SMESpec(
        horizon=20,
        observation={"distractors": 5, "dynamics": "autonomous", "mixing": "orthogonal"},
    ),
    "driven": SMESpec(
        horizon=20,
        D=0.2,
        k=3,
        observation={"distractors": 32, "dynamics": "driven", "mixing": "nonlinear"},
    ),
    "mixed": SMESpec(
        horizon=20, state_dim=3, observation={"mixing": "nonlinear", "mixing_depth": 3}
    ),
    "both": SMESpec(
        horizon=20,
        action_dim=17,
        complexity=2,
        safety={"tightness": 0.3},
        observation={"distractors": 20, "mixing": "nonlinear", "mixing_depth": 2},
    ),
}


def actions_of(env, rng):
    """Actions between the optimum and noise."""
    best = env.task.optimal_action(env.state)
    share = rng.uniform(0.0, 0.5, (*best.shape[:-1], 1))
    return ((1.0 - share) * best + share * rng.random(best.shape)).astype(np.float32)


@pytest.mark.parametrize("name", ["safe and deep", "autonomous", "driven", "both"])
def test_a_batch_of_any_size_is_its_singles(name, backend):
    lanes = 131
    batch = SMEVectorEnv(SPECS[name], lanes)
    checked = [0, lanes // 2, lanes - 1]
    singles = [SMEEnv(SPECS[name]) for _ in checked]
    first, _ = batch.reset(seed=5)
    for lane, env in zip(checked, singles, strict=True):
        np.testing.assert_array_equal(first[lane], env.reset(seed=5 + lane)[0])
    rng = np.random.default_rng(0)
    for _ in range(12):
        action = actions_of(batch, rng)
        observation, *_, infos = batch.step(action)
        for lane, env in zip(checked, singles, strict=True):
            if env._status != "running":
                continue
            seen, *_, info = env.step(action[lane])
            np.testing.assert_array_equal(observation[lane], seen)
            np.testing.assert_array_equal(batch.state[lane], env.state)
            np.testing.assert_array_equal(batch.distractors[lane], env.distractors)
            for key, value in info.items():
                np.testing.assert_array_equal(infos[key][lane], value, err_msg=key)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(spec=specs(team=False), seed=st.integers(0, 99))
@example(spec=SMESpec(complexity=50, state_dim=5, action_dim=3), seed=0)
@example(spec=SMESpec(state_dim=33, action_dim=17, hidden_width=70, complexity=3), seed=0)
def test_a_step_of_any_spec_is_the_definitions_single_and_in_a_batch(spec, seed, backend):
    env, batch = SMEEnv(spec), SMEVectorEnv(spec, 3)
    task, rng = env.task, np.random.default_rng(seed)
    env.reset(seed=seed)
    batch.reset(seed=seed)
    for _ in range(3):
        s, d, noise = env.state, env.distractors, env.noise
        action = actions_of(batch, rng)
        observation, _, terminated, truncated, info = env.step(action[0])
        together = batch.step(action)
        np.testing.assert_array_equal(env.state, task.transition(s, action[0], noise[1:]))
        np.testing.assert_allclose(info["optimal_action"], task.optimal_action(s), atol=1e-12)
        assert info["similarity"] == pytest.approx(task.similarity(s, action[0]), abs=1e-12)
        assert info["regret"] == 1.0 - info["step_reward"]
        if spec.r_min == 0.0:
            earned = task.step_reward(s, action[0].astype(np.float64))
            assert info["step_reward"] == pytest.approx(earned, abs=1e-11)
        np.testing.assert_allclose(
            observation[:-2], task.seen(env.state, env.distractors), rtol=0, atol=2e-7
        )
        if spec.observation is not None and spec.observation.dynamics == "driven":
            np.testing.assert_array_equal(env.distractors, task.distractor_step(d, action[0]))
        if spec.safety is not None:
            a, safe = action[0].astype(np.float64), task.safe_action(s)
            np.testing.assert_allclose(info["limit"], task.limit(s), rtol=0, atol=1e-12)
            np.testing.assert_allclose(info["safe_action"], safe, rtol=0, atol=1e-12)
            # A tiny tightness magnifies the rounding of the limits; so does a threshold of r.
            scale = 2.0 * spec.safety.tightness
            assert scale * info["cost"] == pytest.approx(scale * task.cost(s, a), abs=1e-12)
            safe_regret = task.step_reward(s, safe) - task.step_reward(s, a)
            if spec.r_min == 0.0:
                assert info["safe_regret"] == pytest.approx(safe_regret, abs=1e-11)
        np.testing.assert_array_equal(together[0][0], observation)
        for key, value in info.items():
            np.testing.assert_array_equal(together[4][key][0], value, err_msg=key)
        if terminated or truncated:
            break


def test_noise_and_first_distractors_follow_the_streams_definition(backend):
    env, m = SMEEnv(SPECS["noise"]), 8
    env.reset(seed=7)
    word = np.random.SeedSequence(7, spawn_key=(1,)).generate_state(1, np.uint64)
    numbers = counted(word >> np.uint64(12), np.array([1], np.uint64), 5 * m).reshape(5, m)
    for t, expected in enumerate(numbers):
        np.testing.assert_array_equal(env.distractors, expected)
        if t == 2:  # an episode begins where the last one stopped
            env.reset()
        else:
            env.step(np.full(4, 0.5, np.float32))


@pytest.mark.parametrize("name", ["noise", "driven"])
def test_a_reset_begins_at_the_state_and_the_distractors_that_are_given(name):
    spec = SPECS[name]
    s, d = np.full(spec.state_dim, 0.25), np.full(spec.distractors, 0.75)
    env, untouched = SMEEnv(spec), SMEEnv(spec)
    seen, _ = env.reset(seed=0, options={"state": s, "distractors": d})
    np.testing.assert_array_equal(env.state, s)
    np.testing.assert_array_equal(env.distractors, d)
    width = spec.state_dim + spec.distractors
    np.testing.assert_allclose(seen[:width], env.task.seen(s, d), rtol=0, atol=1e-7)
    first, _ = env.reset()  # what was given took nothing from the generators
    np.testing.assert_array_equal(first, untouched.reset(seed=0)[0])

    batch, mask = SMEVectorEnv(spec, 3), np.array([False, True, True])
    batch.reset(seed=0)
    before = batch.distractors
    each = np.stack([d, d / 2, d / 3])
    seen, _ = batch.reset(options={"distractors": each, "reset_mask": mask})
    np.testing.assert_array_equal(batch.distractors, np.where(mask[:, None], each, before))
    np.testing.assert_array_equal(batch.get_attr("distractors"), batch.distractors)
    batch.reset(options={"distractors": d, "state": s})
    np.testing.assert_array_equal(batch.distractors, [d] * 3)


@pytest.mark.parametrize("make", [SMEEnv, lambda spec: SMEVectorEnv(spec, 3)])
def test_distractors_that_cannot_be_used_are_refused_and_nothing_changes(make):
    for options, error, words in (
        ({"distractors": [0.5] * 7}, StateError, r"distractors of shape \(7,\).*\(8,\)"),
        ({"distractors": [1.5] * 8}, StateError, r"distractors: entry .*1\.5.* lies outside"),
        ({"distractors": [np.nan] * 8}, StateError, "distractors: entry nan lies outside"),
        ({"distractors": "many"}, StateError, "must be an array of shape"),
        ({"distractors": None}, StateError, r"distractors of shape \(\)"),
        ({"distractor": [0.5] * 8}, OptionError, "Did you mean 'distractors'"),
    ):
        plain = make(SPECS["mixed"])  # has no distractors, and so no option for them
        assert plain.distractors.shape[-1] == 0
        with pytest.raises(OptionError, match=r"'distractors'.*unknown option"):
            plain.reset(options={"distractors": []})
        env = make(SPECS["noise"])
        env.reset(seed=0)
        twin = copy.deepcopy(env)
        with pytest.raises(error, match=words):
            env.reset(seed=9, options=options)
        np.testing.assert_array_equal(env.distractors, twin.distractors)
        np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])


def test_an_environment_without_a_seed_can_be_repeated(monkeypatch):
    env, twin = SMEEnv(SPECS["noise"]), SMEEnv(SPECS["noise"])
    first, _ = env.reset()
    np.testing.assert_array_equal(twin.reset(seed=env.np_random_seed)[0], first)
    assert (SMEEnv(SPECS["noise"]).reset()[0] != first).any()
    assert (SMEVectorEnv(SPECS["noise"], 2).reset()[0] != first).any()
    monkeypatch.delattr(gymnasium.Env, "np_random_seed")  # Gymnasium 0.29 does not keep it
    np.testing.assert_array_equal(env.reset(seed=1)[0], twin.reset(seed=1)[0])
    assert (env.reset(seed=2)[0] != twin.reset(seed=3)[0]).any()


def test_a_generator_of_the_users_serves():
    env, twin = SMEEnv(SPECS["noise"]), SMEEnv(SPECS["noise"])
    env.reset(seed=1)
    for each in (env, twin):
        each.np_random = np.random.default_rng(3)
    plain, first = np.random.default_rng(3), None
    for _ in range(2):
        observation, _ = env.reset()
        np.testing.assert_array_equal(twin.reset()[0], observation)
        np.testing.assert_array_equal(env.state, plain.random(8))
        assert first is None or (env.distractors != first).all()
        first = env.distractors


@pytest.mark.parametrize(("name", "field"), [("safe", "safety"), ("noise", "observation")])
def test_streams_and_environments_of_teams_refuse_them(name, field):
    with pytest.raises(SpecError, match=rf"phases.0.spec: has {field}.*Remove its {field}"):
        StreamSpec.from_dict({"phases": [{"spec": SPECS[name].to_dict(), "steps": 10}]})
    with pytest.raises(SpecError, match=rf"{field}: not supported for teams"):
        SMETeamEnv(SPECS[name])
