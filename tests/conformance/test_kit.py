"""The conformance kit detects faults: each check fails for an environment that has its fault."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sme_registry import SMESpec, testing
from sme_registry.compiled.values import ACCUMULATED_REWARD, LANE_STATE, LANE_VALUES
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.testing import ConformanceError

TASK = SMESpec(horizon=12, k=5, D=0.2, complexity=2)


class Pays(SMEEnv):
    """Pays a little too much at the end of each interval."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward * (1 + 1e-9), terminated, truncated, info


class Swallows(SMEEnv):
    """Loses what is still to be paid when time runs out."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, 0.0 if truncated else reward, terminated, truncated, info


class Drifts(SMEEnv):
    """Is off by one unit in the last place of one channel."""

    def step(self, action: Any) -> Any:
        returned = super().step(action)
        self._lane[LANE_STATE] = np.nextafter(self._lane[LANE_STATE], 0.5)
        return returned


class Reuses(SMEEnv):
    """Hands out the same info arrays at each step."""

    def step(self, action: Any) -> Any:
        *returned, info = super().step(action)
        self.__dict__.setdefault("kept", info["optimal_action"])[:] = info["optimal_action"]
        return *returned, {**info, "optimal_action": self.kept}


class Leaks(SMEEnv):
    """Has more in its info than was promised."""

    def step(self, action: Any) -> Any:
        *returned, info = super().step(action)
        return *returned, {**info, "state": self.state}


class SaysNothingAtReset(SMEEnv):
    """Has no info at reset, where collectors expect the keys of a step."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(seed=seed, options=options)[0], {}


class PythonNumbers(SMEEnv):
    """Has numbers without a dtype in its info."""

    def step(self, action: Any) -> Any:
        *returned, info = super().step(action)
        return *returned, {**info, "regret": float(info["regret"])}


class Unseeded(SMEEnv):
    """Ignores its seed."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(seed=None, options=options)


class Forgets(SMEEnv):
    """Loses what it has accumulated when it is copied."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._lane[LANE_VALUES + ACCUMULATED_REWARD] = 0.0


class Shares(SMEEnv):
    """Its deep copies share their state with it."""

    def __deepcopy__(self, memo: Any) -> Shares:
        return self


class Outside(SMEEnv):
    """Observes what its space does not hold."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        observation, info = super().reset(seed=seed, options=options)
        return observation + np.float32(1.0), info


class Warns(SMEEnv):
    """Has an observation space that Gymnasium warns of."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.observation_space = type(self.observation_space)(
            -np.inf, np.inf, self.observation_space.shape, np.float32
        )


class OffByOneBit(SMEVectorEnv):
    """Its last lane is paid one unit in the last place too much."""

    def step(self, actions: Any) -> Any:
        observations, rewards, *rest = super().step(actions)
        rewards[-1] = np.nextafter(rewards[-1], 9.0)
        return observations, rewards, *rest


class MislaysLast(SMEVectorEnv):
    """Gives the first observation of the next episode as the last of this one."""

    def step(self, actions: Any) -> Any:
        observations, *rest, infos = super().step(actions)
        for lane in np.flatnonzero(infos.get("_final_obs", [])):
            infos["final_obs"][lane] = observations[lane].copy()
        return observations, *rest, infos


class KeepsTheLastRegret(SMEVectorEnv):
    """Has a regret of 0, not NaN, in lanes that were reset."""

    def step(self, actions: Any) -> Any:
        *rest, infos = super().step(actions)
        return *rest, {k: np.nan_to_num(v) if k == "regret" else v for k, v in infos.items()}


class EmptyFinals(SMEVectorEnv):
    """Has the keys of last observations where no episode has ended."""

    def step(self, actions: Any) -> Any:
        *rest, infos = super().step(actions)
        nothing = {"final_obs": np.full(3, None), "_final_obs": np.zeros(3, bool)}
        return *rest, nothing | infos


class CopiesLate(SMEVectorEnv):
    """A copy has lost the time of its lanes."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._batch._t = self._batch._t + 1


@pytest.mark.parametrize(
    ("check", "faulty", "words"),
    [
        (testing.check_definition, Pays, "the reward"),
        (testing.check_definition, Swallows, "the reward"),
        (testing.check_definition, Drifts, "the next state"),
        (testing.check_optimum, Swallows, "the optimum's return"),
        (testing.check_info, Reuses, "later step reuses an array"),
        (testing.check_info, Leaks, "keys"),
        (testing.check_info, SaysNothingAtReset, "info at reset: the keys"),
        (testing.check_info, PythonNumbers, "regret=.*must be a float64"),
        (testing.check_determinism, Unseeded, "two runs of one seed"),
        (testing.check_pickling, Forgets, "pickled copy of the single"),
        (testing.check_pickling, Shares, "deep copy of the single"),
        (testing.check_gymnasium, Outside, "observation space"),
        (testing.check_gymnasium, Warns, "warns: .*infinity"),
    ],
)
def test_a_faulty_environment_is_seen(check: Any, faulty: type[SMEEnv], words: str) -> None:
    check(TASK)
    with pytest.raises(ConformanceError, match=words):
        check(TASK, single=faulty)


@pytest.mark.parametrize(
    ("check", "faulty", "words"),
    [
        (testing.check_vector, OffByOneBit, "NextStep, unit: step 1"),
        (testing.check_vector, MislaysLast, "SameStep.*final_obs"),
        (testing.check_vector, KeepsTheLastRegret, "regret: expected"),
        (testing.check_vector, EmptyFinals, "NextStep, unit: step 1: the keys"),
        (testing.check_pickling, CopiesLate, "vector"),
    ],
)
def test_a_faulty_batch_is_seen(check: Any, faulty: type[SMEVectorEnv], words: str) -> None:
    check(TASK)
    with pytest.raises(ConformanceError, match=words):
        check(TASK, vector=faulty)


def test_an_env_spec_that_names_another_task_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def other(spec: SMESpec, **kwargs: Any) -> Any:
        return original(spec.derive(seed=99), **kwargs)

    original = testing.single.env_spec
    monkeypatch.setattr(testing.single, "env_spec", other)
    with pytest.raises(ConformanceError, match="the digest after EnvSpec"):
        testing.check_env_spec(TASK)


def test_the_whole_kit_stops_at_the_first_fault() -> None:
    with pytest.raises(ConformanceError, match="the reward"):
        testing.check_sme(TASK, single=Pays)
