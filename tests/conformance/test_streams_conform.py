"""Streams keep every promise of the conformance kit; ids and EnvSpecs name them."""

import gymnasium
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import sme_registry
from sme_registry import SMESpec, StreamSpec, testing
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.errors import (
    NameTakenError,
    StreamError,
    UnexpectedKeywordError,
    UnknownNameError,
)
from sme_registry.spec import StreamFile, catalogue
from sme_registry.testing import ConformanceError

NAMES = catalogue.names(StreamFile)
SPEC = {"state_dim": 3, "action_dim": 2, "horizon": 9, "D": 0.3, "complexity": 2}
SHORT = StreamSpec.from_dict(
    {
        "phases": [
            {"spec": SPEC | {"k": 4}, "steps": 20},
            {"spec": SPEC | {"k": 2}, "steps": 15, "drift": {"rotation": 1.5, "increments": 3}},
        ],
        "cycles": 2,
    }
)


def short(**fields):
    return StreamSpec.from_dict({**SHORT.to_dict(), **fields})


@pytest.mark.parametrize(
    ("switch", "backend"), [("episode", "auto"), ("step", "auto"), ("step", "numpy")]
)
def test_streams_pass_the_conformance_kit(switch, backend, monkeypatch):
    monkeypatch.setenv("SME_BACKEND", backend)
    testing.check_stream(short(switch=switch, observes_phase=switch == "step"))


def test_streams_of_the_catalogue_have_their_ids():
    for name in NAMES:
        stream = sme_registry.load(name, StreamSpec)
        ids = [name, f"Stream{name}", catalogue.symmetric_name(name), f"{stream.content_name}-v1"]
        for env_id in (f"SME/{each}" for each in ids):
            env = gymnasium.make(env_id)
            assert env.unwrapped.stream == stream
            assert env.spec.id == env_id
            assert env.spec.max_episode_steps == stream.horizon
            assert env.action_space.low[0] == (-1.0 if "Symmetric" in env_id else 0.0)
            again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
            assert again.unwrapped.stream == stream
            assert again.spec.id == env_id
    assert not hasattr(gymnasium.make("SME/Default-v1").unwrapped, "stream")
    check_env(gymnasium.make("SME/Switch5-v1").unwrapped)


def test_names_make_single_environments_and_native_batches():
    for name in ("Switch5", "SME/Switch5-v1", "sme_registry:SME/StreamSwitch5-v1"):
        env, batch = sme_registry.make(name), sme_registry.make_vec(name, 2)
        assert isinstance(env.unwrapped, SMEEnv)
        assert isinstance(batch.unwrapped, SMEVectorEnv)
        assert env.spec.id == batch.spec.id == f"SME/{name.split('/')[-1].removesuffix('-v1')}-v1"
    batch = gymnasium.make_vec("SME/Switch5Symmetric-v1", num_envs=2, autoreset_mode="SameStep")
    assert batch.single_action_space.low[0] == -1.0
    assert str(batch) == "SMEVectorEnv(SME/Switch5-v1, num_envs=2)"
    assert repr(env.unwrapped) == "SMEEnv(SME/Switch5-v1)"


def test_a_stream_of_ones_own_goes_by_content_or_by_a_registered_name():
    env = sme_registry.make(SHORT, action_range="symmetric")
    assert env.spec.id == f"SME/{SHORT.content_name}-v1"
    assert sme_registry.env_spec(SHORT).kwargs == {"stream": SHORT.to_dict()}
    assert sme_registry.register(SHORT, "Short") == "SME/Short-v1"
    assert sme_registry.register(SHORT, "Short-v1") == "SME/Short-v1"  # again
    for env_id in ("SME/Short-v1", "SME/ShortSymmetric-v1"):
        assert gymnasium.make(env_id).unwrapped.stream == SHORT
    assert sme_registry.make_vec("Short", 2).spec.id == "SME/Short-v1"
    with pytest.raises(NameTakenError, match="stands for another stream"):
        sme_registry.register(short(cycles=3), "Short")
    with pytest.raises(NameTakenError, match="stands for another stream"):
        sme_registry.register(SMESpec(), "Switch5")
    with pytest.raises(NameTakenError, match="stands for another spec"):
        sme_registry.register(SHORT, "Default")
    with pytest.raises(UnexpectedKeywordError, match="'k' for a stream"):
        sme_registry.env_spec(SHORT, k=3)
    with pytest.raises(UnknownNameError, match="Did you mean 'Switch5-v1'"):
        sme_registry.make("Swicth5")


@pytest.mark.parametrize("name", ["Switch5", "SME/StreamSwitch5-v1", SHORT, SHORT.to_dict()])
def test_a_stream_where_one_task_is_needed_is_a_typed_error(name):
    with pytest.raises(StreamError, match=r"is a stream.*phases\[0\]\.spec"):
        sme_registry.evaluate("optimal", name)
    with pytest.raises(StreamError):
        sme_registry.make_parallel(name)


class _Forgets(SMEEnv):
    """Restarts the life at each reset."""

    def _live(self, lifetime):
        return super()._live(0)


class _Lags(SMEEnv):
    """Tells the phase of the observation, rather than that of the action."""

    def step(self, action):
        *returned, info = super().step(action)
        return *returned, {**info, "phase": self._phase}


class _Swaps(SMEVectorEnv):
    """Switches one lane too late."""

    def reset(self, **arguments):
        returned = super().reset(**arguments)
        self._batch._next_switch[1] += int(self._batch._next_switch[1] < SHORT.steps)
        return returned


@pytest.mark.parametrize(
    ("switch", "faulty", "words"),
    [
        ("episode", {"single": _Forgets}, "lifetime"),
        ("step", {"single": _Lags}, "phase"),
        ("step", {"vector": _Swaps}, "SameStep|NextStep"),
    ],
)
def test_the_kit_detects_faults_of_streams(switch, faulty, words):
    with pytest.raises(ConformanceError, match=words):
        testing.check_stream(short(switch=switch, observes_phase=True), **faulty)
