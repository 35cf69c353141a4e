"""What an environment is called: ids, EnvSpecs, and that nothing pretends to be a named task."""

import copy
import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import sme_registry
from sme_registry import SMESpec, StreamSpec
from sme_registry.errors import (
    OptionError,
    SpecError,
    UnexpectedKeywordError,
    UnknownNameError,
)
from sme_registry.spec import EnvFile, catalogue
from sme_registry.testing import expect_same, mixed_actions

ROOT = Path(sme_registry.__file__).resolve().parents[1]


def fresh_python(code):
    """What a new interpreter prints that imports nothing beforehand; warnings are errors."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_a_json_env_spec_makes_the_task_in_a_process_that_did_not_register_it():
    sent = sme_registry.env_spec(SMESpec(complexity=3, seed=11), action_range="symmetric").to_json()
    answer = fresh_python(
        "import gymnasium, json\n"
        f"spec = gymnasium.envs.registration.EnvSpec.from_json({sent!r})\n"
        "env = gymnasium.make(spec)\n"
        "stream = gymnasium.make('sme_registry:SME/Switch5-v1').unwrapped.stream.digest\n"
        "low = float(env.action_space.low[0])\n"
        "print(json.dumps([env.unwrapped.sme_spec.digest, low, stream]), end='')"
    )
    stream = sme_registry.load("Switch5", StreamSpec).digest
    assert json.loads(answer) == [SMESpec(complexity=3, seed=11).digest, -1.0, stream]


def test_module_and_id_make_the_task_in_a_fresh_process_of_an_older_gymnasium():
    # `AutoresetMode` is of Gymnasium 1.1; CleanRL pins 0.29.
    answer = fresh_python(
        "import gymnasium, gymnasium.vector, json, sys\n"
        "del gymnasium.vector.AutoresetMode\n"
        "env = gymnasium.make('sme_registry:SME/Complexity2Symmetric-v1')\n"
        "env.reset(seed=0)\n"
        "env.step(env.action_space.sample())\n"
        "vectors = 'sme_registry.envs.vector' in sys.modules\n"
        "low = float(env.action_space.low[0])\n"
        "print(json.dumps([env.unwrapped.sme_spec.digest, low, vectors]), end='')"
    )
    assert json.loads(answer) == [sme_registry.load("Complexity2").digest, -1.0, False]


def test_overrides_give_the_derived_digest_and_do_not_keep_the_name():
    before = copy.deepcopy(gymnasium.registry["SME/Default-v1"])
    assert before.max_episode_steps is None
    same = gymnasium.make("SME/Default-v1", action_range="symmetric", render_mode="rgb_array")
    assert same.spec.id == "SME/Default-v1"
    env = gymnasium.make("SME/Default-v1", complexity=10, seed=3)
    assert gymnasium.registry["SME/Default-v1"] == before
    derived = sme_registry.load("Default").derive(complexity=10, seed=3)
    assert env.unwrapped.sme_spec == derived
    assert env.spec.id == f"SME/{derived.content_name}-v1"
    assert env.spec.name == derived.content_name
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.sme_spec.digest == derived.digest
    assert again.spec.id == env.spec.id


def test_another_spec_given_to_a_named_id_does_not_take_its_name(tmp_path):
    other = SMESpec(seed=9)
    path = sme_registry.save(other, tmp_path / "Mine.json")
    for given in (other, other.to_dict(), str(path), path):
        env = gymnasium.make("SME/Default-v1", spec=given)
        assert env.spec.id == f"SME/{other.content_name}-v1"
        assert env.spec.id not in gymnasium.registry
        path.unlink(missing_ok=True)  # what is sent must not need the sender's files
        again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
        assert again.unwrapped.sme_spec == other
        sme_registry.save(other, path)


@pytest.mark.parametrize("overrides", [{}, {"horizon": 7}], ids=["named", "derived"])
def test_env_specs_present_the_horizon_as_the_episodes_longest_length(overrides):
    horizon = overrides.get("horizon", 100)
    made = [
        gymnasium.make("SME/Default-v1", **overrides),
        gymnasium.make_vec("SME/Default-v1", num_envs=2, **overrides),
        sme_registry.make(sme_registry.load("Default").derive(**overrides)),
    ]
    for env in made:
        assert env.spec.max_episode_steps == horizon
        recreate = gymnasium.make_vec if env is made[1] else gymnasium.make
        for spec in (env.spec, EnvSpec.from_json(env.spec.to_json())):
            again = recreate(spec)
            assert again.spec == env.spec
            assert recreate(EnvSpec.from_json(again.spec.to_json())).spec == env.spec


def test_the_time_limit_of_a_recreated_environment_changes_no_number():
    # Episodes are terminated early, truncated with a pending payout, or both at once.
    env = gymnasium.make("SME/Default-v1", horizon=12, k=5, D=0.2)
    limited = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(limited, gymnasium.wrappers.TimeLimit)
    rng, ends = np.random.default_rng(0), set()
    for seed in range(8):
        expect_same("reset", limited.reset(seed=seed), env.reset(seed=seed))
        ended = False
        while not ended:
            unwrapped = env.unwrapped
            action = mixed_actions(unwrapped.task.optimal_action(unwrapped.state), rng)
            step = env.step(action)
            expect_same("step", limited.step(action), step)
            ended = step[2] or step[3]
        ends.add(step[2:4])
    assert {(True, False), (False, True)} <= ends


def test_an_env_spec_of_a_shorter_task_makes_a_longer_one():
    env = gymnasium.make("SME/Default-v1", horizon=5)
    longer = gymnasium.make(env.spec, horizon=9, max_episode_steps=9)
    assert longer.spec.max_episode_steps == 9


@pytest.mark.parametrize(
    "make",
    [
        lambda **unknown: gymnasium.make("SME/Default-v1", **unknown),
        lambda **unknown: gymnasium.make_vec("SME/Default-v1", **unknown),
        lambda **unknown: sme_registry.make("Default", **unknown),
        lambda **unknown: sme_registry.make_parallel("Team2", **unknown),
        lambda **unknown: sme_registry.make_aec("Team2", **unknown),
    ],
    ids=["make", "make_vec", "sme_registry.make", "make_parallel", "make_aec"],
)
def test_an_unknown_keyword_is_a_type_error_in_pythons_words(make):
    # Frameworks try `frameskip=1` and go on only after exactly this error.
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'") as caught:
        make(frameskip=1)
    assert isinstance(caught.value, UnexpectedKeywordError)
    with pytest.raises(SpecError, match="Did you mean 'complexity'"):
        make(complexty=2)
    with pytest.raises(SpecError, match="complexity=0"):
        make(complexity=0)
    with pytest.raises(OptionError, match="'unit' or 'symmetric'"):
        make(action_range="centred")


def test_each_single_agent_name_has_an_id_with_symmetric_actions():
    names = [path.stem for path in catalogue.paths(EnvFile)]
    assert not [name for name in names if catalogue.SYMMETRIC in name]
    singles = [name for name in names if f"SME/{name}" in gymnasium.registry]
    assert len(singles) >= 30
    for name in singles:
        plain, symmetric = (
            gymnasium.spec(f"SME/{each}") for each in (name, catalogue.symmetric_name(name))
        )
        assert symmetric.kwargs == {**plain.kwargs, "action_range": "symmetric"}
    ours = [env_id for env_id in gymnasium.registry if env_id.startswith("SME/")]
    assert sum(env_id.endswith("Symmetric-v1") for env_id in ours) >= len(singles)
    assert not [env_id for env_id in ours if env_id.startswith("SME/Team") or "Duo" in env_id]


def test_a_symmetric_id_is_the_same_task_with_other_actions():
    default = sme_registry.load("Default")
    for env in (
        gymnasium.make("SME/DefaultSymmetric-v1"),
        gymnasium.make_vec("SME/DefaultSymmetric-v1"),
        sme_registry.make("DefaultSymmetric"),
        sme_registry.make("sme_registry:SME/DefaultSymmetric-v1"),
        sme_registry.make_vec("DefaultSymmetric"),
    ):
        unwrapped = env.unwrapped
        assert unwrapped.sme_spec == default
        assert env.action_space.low.min() == -1.0
        assert env.spec.id == "SME/DefaultSymmetric-v1"
    # Other actions, or another task, do not keep the name.
    for changed in ({"action_range": "unit"}, {"k": 3}):
        env = gymnasium.make("SME/DefaultSymmetric-v1", **changed)
        unwrapped = env.unwrapped
        assert env.spec.id == f"SME/{unwrapped.sme_spec.content_name}-v1"
        again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
        assert again.action_space == env.action_space


def test_a_symmetric_name_is_not_that_of_a_task():
    with pytest.raises(UnknownNameError, match=r"Use 'Default', and action_range='symmetric'"):
        sme_registry.load("SME/DefaultSymmetric-v1")
    with pytest.raises(UnknownNameError, match="Did you mean 'Default-v1'"):
        sme_registry.make("DefalutSymmetric")
    with pytest.raises(OptionError, match="must not end with 'Symmetric'"):
        sme_registry.register(SMESpec(k=7), "MineSymmetric")
    with pytest.raises(OptionError, match="names the document of another digest"):
        sme_registry.register(SMESpec(k=3), SMESpec(k=7).content_name)
    sme_registry.register(SMESpec(k=7, seed=123), "Seven")
    env = gymnasium.make("SME/SevenSymmetric-v1")
    assert env.unwrapped.sme_spec == SMESpec(k=7, seed=123)
    assert env.action_space.low[0] == -1.0


def test_batches_and_env_specs_with_overrides_do_not_keep_the_name_either():
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    env = gymnasium.make_vec("SME/Default-v1", num_envs=2, horizon=5, autoreset_mode=mode)
    assert env.spec.id == f"SME/{env.unwrapped.sme_spec.content_name}-v1"
    again = gymnasium.make_vec(EnvSpec.from_json(env.spec.to_json()))
    assert again.num_envs == 2
    assert again.metadata["autoreset_mode"] is mode
    assert again.unwrapped.sme_spec == env.unwrapped.sme_spec
    derived = sme_registry.load("Default").derive(complexity=10)
    made = sme_registry.env_spec(sme_registry.load("Default"), complexity=10, action_range="unit")
    assert made.id == f"SME/{derived.content_name}-v1"
    assert made.kwargs == {"spec": derived.to_dict(), "action_range": "unit"}
    with pytest.raises(sme_registry.SMEError, match="complexity=0"):
        sme_registry.env_spec(derived, complexity=0)
