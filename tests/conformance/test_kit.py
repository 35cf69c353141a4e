"""The conformance kit detects faults: each check fails for an environment that has its fault."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from sme_registry import SMESpec, testing
from sme_registry.compiled.values import ACCUMULATED_REWARD, LANE_STATE, LANE_VALUES
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.testing import ConformanceError

TASK = SMESpec(horizon=12, k=5, D=0.2, complexity=2)


def stepping(change: Any, base: Any = SMEEnv) -> Any:
    """An environment whose `step` returns something else: `change(env, *returned)`."""

    class Faulty(base):
        def step(self, action: Any) -> Any:
            return change(self, *super().step(action))

    return Faulty


def resetting(change: Any) -> Any:
    """An environment whose `reset` is `change(reset, seed, options)`."""

    class Faulty(SMEEnv):
        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return change(super().reset, seed, options)

    return Faulty


def changed_info(change: Any, base: Any = SMEEnv) -> Any:
    """An environment whose `step` has another info: `change(env, info)`."""
    return stepping(lambda env, *returned: (*returned[:4], change(env, returned[4])), base)


def loses_the_last_payout(env: Any, seen: Any, reward: Any, *rest: Any) -> Any:
    return seen, 0.0 if rest[1] else reward, *rest


def drifts(env: Any, *returned: Any) -> Any:
    """One channel of the state is off by one unit in the last place."""
    env._lane[LANE_STATE] = np.nextafter(env._lane[LANE_STATE], 0.5)
    return returned


def reuses(env: Any, info: Any) -> Any:
    """Hands out the same info arrays at each step."""
    env.__dict__.setdefault("kept", info["optimal_action"])[:] = info["optimal_action"]
    return {**info, "optimal_action": env.kept}


def outside(reset: Any, seed: Any, options: Any) -> Any:
    observation, info = reset(seed=seed, options=options)
    return observation + np.float32(1.0), info


class Forgets(SMEEnv):
    """Loses what it has accumulated when it is copied."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._lane[LANE_VALUES + ACCUMULATED_REWARD] = 0.0


class Shares(SMEEnv):
    """Its deep copies share their state with it."""

    def __deepcopy__(self, memo: Any) -> Shares:
        return self


class Warns(SMEEnv):
    """Has an observation space that Gymnasium warns of."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        box = self.observation_space
        self.observation_space = type(box)(-np.inf, np.inf, box.shape, np.float32)


def off_by_one_bit(env: Any, observations: Any, rewards: Any, *rest: Any) -> Any:
    rewards[-1] = np.nextafter(rewards[-1], 9.0)
    return observations, rewards, *rest


def mislays_last(env: Any, observations: Any, *rest: Any) -> Any:
    """Gives the first observation of the next episode as the last of this one."""
    for lane in np.flatnonzero(rest[-1].get("_final_obs", [])):
        rest[-1]["final_obs"][lane] = observations[lane].copy()
    return observations, *rest


def keeps_the_last_regret(env: Any, infos: Any) -> Any:
    return {key: np.nan_to_num(v) if key == "regret" else v for key, v in infos.items()}


class CopiesLate(SMEVectorEnv):
    """A copy has lost the time of its lanes."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._batch._t = self._batch._t + 1


EMPTY_FINALS = {"final_obs": np.full(3, None), "_final_obs": np.zeros(3, bool)}
PAYS_TOO_MUCH = stepping(lambda env, seen, reward, *rest: (seen, reward * (1 + 1e-9), *rest))
UNSEEDED = resetting(lambda reset, seed, options: reset(seed=None, options=options))
NO_INFO = resetting(lambda reset, seed, options: (reset(seed=seed, options=options)[0], {}))
LEAKS = changed_info(lambda env, info: {**info, "state": env.state})
PYTHON_NUMBERS = changed_info(lambda env, info: {**info, "regret": float(info["regret"])})
WITH_EMPTY_FINALS = changed_info(lambda env, infos: EMPTY_FINALS | infos, SMEVectorEnv)


@functools.cache
def passes(check: Any) -> None:
    check(TASK)


@pytest.mark.parametrize(
    ("check", "faulty", "words"),
    [
        (testing.check_definition, PAYS_TOO_MUCH, "the reward"),
        (testing.check_definition, stepping(loses_the_last_payout), "the reward"),
        (testing.check_definition, stepping(drifts), "the next state"),
        (testing.check_optimum, stepping(loses_the_last_payout), "the optimum's return"),
        (testing.check_info, changed_info(reuses), "later step reuses an array"),
        (testing.check_info, LEAKS, "keys"),
        (testing.check_info, NO_INFO, "info at reset: the keys"),
        (testing.check_info, PYTHON_NUMBERS, "regret=.*must be a float64"),
        (testing.check_determinism, UNSEEDED, "two runs of one seed"),
        (testing.check_pickling, Forgets, "pickled copy of the single"),
        (testing.check_pickling, Shares, "deep copy of the single"),
        (testing.check_gymnasium, resetting(outside), "observation space"),
        (testing.check_gymnasium, Warns, "warns: .*infinity"),
        (testing.check_sme, PAYS_TOO_MUCH, "the reward"),
    ],
)
def test_a_faulty_environment_is_seen(check: Any, faulty: type[SMEEnv], words: str) -> None:
    passes(check)
    with pytest.raises(ConformanceError, match=words):
        check(TASK, single=faulty)


@pytest.mark.parametrize(
    ("check", "faulty", "words"),
    [
        (testing.check_vector, stepping(off_by_one_bit, SMEVectorEnv), "NextStep, unit: step 1"),
        (testing.check_vector, stepping(mislays_last, SMEVectorEnv), "SameStep.*final_obs"),
        (
            testing.check_vector,
            changed_info(keeps_the_last_regret, SMEVectorEnv),
            "regret: expected",
        ),
        (testing.check_vector, WITH_EMPTY_FINALS, "NextStep, unit: step 1: the keys"),
        (testing.check_pickling, CopiesLate, "vector"),
    ],
)
def test_a_faulty_batch_is_seen(check: Any, faulty: type[SMEVectorEnv], words: str) -> None:
    passes(check)
    with pytest.raises(ConformanceError, match=words):
        check(TASK, vector=faulty)


def test_an_env_spec_that_names_another_task_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    original = testing.single.env_spec
    monkeypatch.setattr(
        testing.single, "env_spec", lambda spec, **kw: original(spec.derive(seed=99), **kw)
    )
    with pytest.raises(ConformanceError, match="the digest after EnvSpec"):
        testing.check_env_spec(TASK)
