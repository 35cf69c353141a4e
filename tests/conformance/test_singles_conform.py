"""Single agents' environments and batches keep every promise: each kind, edges, every mode.

That every entry of the catalogue is drawn and stepped as published is in `tests/spec`, kinds of
safety and observation are in `tests/envs/test_safety_observation.py`, and teams are below.
"""

import copy
import functools
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from pettingzoo.utils.conversions import (
    aec_to_parallel,
    aec_to_parallel_wrapper,
    parallel_to_aec,
)

import sme_registry
from sme_registry import SMESpec, testing
from sme_registry.envs import SMEVectorEnv
from sme_registry.spec import catalogue
from sme_registry.spec.files import EnvFile
from sme_registry.testing import expect_same, next_action, play

NAMES = [file.versioned_name for file in catalogue.entries(EnvFile) if file.spec.team is None]
KINDS = ["Default", "StateDim64", "HardFragile", "HardSafeMixed"]


@pytest.mark.parametrize("name", KINDS)
def test_ids_pass_the_checkers_of_gymnasium_and_sb3(name):
    # With the id, and so the EnvSpec: check_env then also makes and tries each render mode.
    check_env(gymnasium.make(f"SME/{name}-v1").unwrapped, skip_render_check=name != "Default")
    sb3_checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gymnasium.make(f"SME/{name}-v1", action_range="symmetric")
    sb3_checker.check_env(env.unwrapped, warn=True)


def test_every_catalogue_entry_has_an_id_by_name_and_one_by_content():
    assert "Default-v1" in NAMES
    for name in NAMES:
        spec = sme_registry.load(name)
        for env_id in (f"SME/{name}", f"SME/{spec.content_name}-v1"):
            env = gymnasium.make(env_id)
            assert env.spec.id == env_id
            assert env.unwrapped.sme_spec == spec
            sent = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
            assert gymnasium.make(sent).unwrapped.sme_spec.digest == spec.digest


# Ends early and late, pays late, and its lanes drift apart.
HARD = {"horizon": 12, "k": 5, "r_min": 0.3, "D": 0.35, "complexity": 2, "seed": 4}


@pytest.mark.parametrize(
    "task",
    [
        *(f"SME/{name}-v1" for name in KINDS),
        HARD,
        {"horizon": 1, "state_dim": 1, "action_dim": 1},
        {"k": 7, "D": 0.75, "r_min": 0.9, "horizon": 20, "complexity": 3},
        {"k": 50, "horizon": 12},
        {"state_dim": 3, "action_dim": 9, "hidden_width": 5, "complexity": 4, "horizon": 15},
        {"seed": "0xabcdef0123456789", "policy_init": "unit_variance", "complexity": 2,
         "horizon": 10},
    ],
    ids=str,
)  # fmt: skip
def test_entries_of_each_kind_and_specs_at_the_edges_pass_the_conformance_kit(task):
    testing.check_env(task)


def rollout(env, steps=30):
    """Observations, rewards and ends under fixed actions."""
    rng = np.random.default_rng(1)
    seen = [env.reset(seed=3)[0]]
    for _ in range(steps):
        action = rng.random(env.action_space.shape, np.float32)
        seen += env.step(action)[:4]
    env.close()
    return seen


def test_make_vec_gives_the_same_numbers_in_every_mode(monkeypatch):
    monkeypatch.setenv("PYTHONWARNINGS", "error")  # in the worker processes, too
    kwargs = {"num_envs": 2, "horizon": 12, "k": 5}
    native = gymnasium.make_vec("SME/Default-v1", **kwargs)
    assert isinstance(native, SMEVectorEnv)
    listed, _ = native.reset(seed=[3, 4])
    np.testing.assert_array_equal(native.reset(seed=3)[0], listed)
    expected = rollout(native)
    for mode, vector_kwargs in (("sync", {}), ("async", {"context": "spawn"})):
        env = gymnasium.make_vec(
            "SME/Default-v1", vectorization_mode=mode, vector_kwargs=vector_kwargs, **kwargs
        )
        for got, wanted in zip(rollout(env), expected, strict=True):
            np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("mode", [mode.value for mode in AutoresetMode])
def test_returned_arrays_are_fresh_and_writing_into_them_moves_nothing(mode):
    env = SMEVectorEnv(SMESpec.from_dict({**HARD, "D": 0.0}), 3, autoreset_mode=mode)
    clean = copy.deepcopy(env)
    rng = np.random.default_rng(2)
    first, second = env.reset(seed=0), clean.reset(seed=0)
    for _ in range(40):
        for got, expected in zip(first[:-1], second[:-1], strict=True):
            np.testing.assert_array_equal(got, expected)
        ended = second[2] | second[3] if len(second) > 2 else np.zeros(3, bool)
        spoil(first)
        action = rng.random((3, 4), np.float32)
        if mode == "Disabled" and ended.any():
            first, second = (e.reset(options={"reset_mask": ended.copy()}) for e in (env, clean))
        else:
            given = action.copy()
            first, second = env.step(given), clean.step(action)
            np.testing.assert_array_equal(given, action)  # an action is not written into, either
            given[:] = 0.9


def spoil(returned):
    """Write into every array that a call has returned."""
    if isinstance(returned, np.ndarray):
        if returned.dtype == object:
            for part in returned:
                spoil(part)
        else:
            returned[...] = ~returned if returned.dtype == bool else 77.0
    elif isinstance(returned, dict):
        for part in returned.values():
            spoil(part)
    elif isinstance(returned, tuple):
        for part in returned:
            spoil(part)


with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # importing PettingZoo's tests warns of their own module's age
    from pettingzoo.test import (
        api_test,
        parallel_api_test,
        parallel_seed_test,
        render_test,
        seed_test,
    )
    from pettingzoo.test.state_test import state_test

TEAMS = [file.versioned_name for file in catalogue.entries(EnvFile) if file.spec.team is not None]
UNEQUAL = {
    "agents": [
        {"name": "scout_0", "action_dim": 1, "observes": [0, 2]},
        {"name": "driver_0", "action_dim": 2},
        {"name": "scout_1", "action_dim": 1, "observes": [1]},
    ]
}


@pytest.mark.parametrize(
    "task",
    [
        *("Team2", "TeamBlindShared4", "DuoDeep", "HardFragile"),
        {"horizon": 1, "action_dim": 2, "team": {"agents": [{"action_dim": 1}] * 2}},
        {"k": 3, "r_min": 0.2, "D": 0.3, "horizon": 10, "team": UNEQUAL},
        {"k": 50, "horizon": 12, "D": 0.4, "team": {**UNEQUAL, "reward": "team"}},
        {"team": {"agents": [{"name": "lone_7", "action_dim": 4, "observes": [1, 3]}]}},
    ],
    ids=str,
)
def test_teams_of_each_kind_and_at_the_edges_pass_the_conformance_kit(task):
    testing.check_team(task)


@pytest.mark.filterwarnings("ignore:Agents have different", "ignore:Observations are different")
@pytest.mark.parametrize(
    ("action_range", "fields"),
    [("unit", {}), ("symmetric", {"action_dim": 4, "k": 3, "D": 0.3, "team": UNEQUAL})],
)
def test_a_team_passes_pettingzoos_tests(action_range, fields):
    kwargs = {"horizon": 20, "action_range": action_range, **fields}
    make = functools.partial(sme_registry.make_parallel, "Team4-v1", **kwargs)
    make_aec = functools.partial(sme_registry.make_aec, "Team4-v1", **kwargs)
    parallel_api_test(make(), num_cycles=100)
    api_test(make_aec(), num_cycles=100)
    parallel_seed_test(make)
    seed_test(make_aec)
    state_test(make_aec(), make())


@pytest.mark.parametrize(
    "fields", [{}, {"action_dim": 4, "k": 3, "D": 0.3, "team": UNEQUAL}], ids=["four", "three"]
)
def test_turns_and_back_keep_every_number(fields):
    make = functools.partial(sme_registry.make_parallel, "Team4-v1", horizon=12, **fields)
    # Not `aec_to_parallel`, which would return the original environment.
    converted = aec_to_parallel_wrapper(parallel_to_aec(make()))
    converted.task = make().task
    expect_same("parallel, AEC and back", play(converted, 1, 2), play(make(), 1, 2))

    env, aec, rng = make(), parallel_to_aec(make()), np.random.default_rng(3)
    observations, infos = env.reset(seed=1)
    aec.reset(seed=1)
    rewards = dict.fromkeys(env.agents, 0.0)
    terminated = truncated = dict.fromkeys(env.agents, False)
    playing = True
    while playing:
        playing = bool(env.agents)
        actions = next_action(env, rng) if playing else dict.fromkeys(env.possible_agents)
        for agent in actions:
            name = aec.agent_selection
            assert name == agent or not playing  # after the end, they follow by their names
            expected = (
                each[name] for each in (observations, rewards, terminated, truncated, infos)
            )
            expect_same(f"{name} in an AEC environment", list(aec.last()), list(expected))
            aec.step(actions[name])
        if playing:
            observations, rewards, terminated, truncated, infos = env.step(actions)


def test_a_team_passes_pettingzoos_render_test(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(lambda render_mode: sme_registry.make_aec("Team2", render_mode=render_mode))


def test_teams_are_in_pettingzoos_registry_by_name_and_by_content():
    assert {"Team2-v1", "Team4-v1", "Team8-v1", "TeamBlind4-v1", "TeamShared4-v1"} <= set(TEAMS)
    for name in TEAMS:
        spec = sme_registry.load(name)
        for env_id in (f"SME/{name}", f"SME/{spec.content_name}-v1"):
            assert pettingzoo.make("parallel", env_id).sme_spec == spec
            assert pettingzoo.make("aec", env_id).unwrapped.sme_spec == spec
            assert pettingzoo.make("parallel", env_id, seed=5).sme_spec == spec.derive(seed=5)


def test_single_agents_stay_out_of_pettingzoos_registry_and_teams_out_of_gymnasiums():
    import gymnasium

    ours = {env_id for env_id in pettingzoo.parallel_registry if env_id.startswith("SME/")}
    assert ours == {env_id for env_id in pettingzoo.aec_registry if env_id.startswith("SME/")}
    assert {f"SME/{name}" for name in TEAMS} <= ours
    assert not ours & gymnasium.registry.keys()


def test_pettingzoo_before_its_registry_has_everything_else():
    code = """
import sys
import gymnasium, pettingzoo
sys.modules["pettingzoo.env_registry"] = None  # as in 1.26, which AgileRL requires
import sme_registry
gymnasium.make("SME/Default-v1").reset(seed=0)
sme_registry.register(sme_registry.load("Team2").derive(seed=7), "ApiDuo")
assert sme_registry.make_parallel("ApiDuo").reset(seed=0)
sme_registry.make_aec("Team2").reset(seed=0)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_spec_of_your_own_with_a_team_is_made_by_its_name():
    spec = SMESpec(team=UNEQUAL, seed=301)
    assert sme_registry.register(spec, "ApiTrio") == "SME/ApiTrio-v1"
    assert pettingzoo.make("parallel", "SME/ApiTrio-v1").sme_spec == spec
    assert sme_registry.make_parallel("ApiTrio").sme_spec == spec
    with pytest.raises(sme_registry.SMEError, match="stands for another spec"):
        sme_registry.register(SMESpec(seed=302), "ApiTrio")


def test_a_team_is_made_from_an_id_a_path_a_digest_a_spec_and_its_fields(tmp_path):
    spec = sme_registry.load("DuoDeep")
    path = sme_registry.save(spec, tmp_path / "duo.json")
    for given in ("SME/DuoDeep-v1", "DuoDeep", path, str(path), spec.digest, spec, spec.to_dict()):
        assert sme_registry.make_parallel(given).sme_spec == spec
        assert sme_registry.make_aec(given).unwrapped.sme_spec == spec


def test_the_conversion_back_from_turns_gives_the_environment_itself():
    env = sme_registry.make_parallel("Team2")
    assert aec_to_parallel(parallel_to_aec(env)) is env
    assert aec_to_parallel(sme_registry.make_aec("Team2")).sme_spec == env.sme_spec
