"""`gymnasium.make_vec` in every mode, and batches against singles over many episodes."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from sme_registry import SMESpec, testing
from sme_registry.envs import SMEVectorEnv

# Ends early and late, pays late, and its lanes drift apart.
HARD = {"horizon": 12, "k": 5, "r_min": 0.3, "D": 0.35, "complexity": 2, "seed": 4}


def rollout(env: Any, steps: int = 30) -> list[np.ndarray]:
    """Observations, rewards and ends under fixed actions."""
    rng = np.random.default_rng(1)
    seen = [env.reset(seed=3)[0]]
    for _ in range(steps):
        action = rng.random(env.action_space.shape, np.float32)
        seen += env.step(action)[:4]
    env.close()
    return seen


def test_make_vec_gives_the_same_numbers_in_every_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONWARNINGS", "error")  # in the worker processes, too
    kwargs: dict[str, Any] = {"num_envs": 2, "horizon": 12, "k": 5}
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


def test_a_batch_of_a_hard_task_equals_its_singles_in_all_autoreset_modes() -> None:
    for seed in range(2):
        testing.check_vector(HARD, seed=seed)


def test_a_lane_does_not_depend_on_how_many_others_there_are() -> None:
    seen = []
    for lanes in (1, 7, 64, 200):
        env = SMEVectorEnv("Complexity10", lanes)
        env.reset(seed=0)
        for action in np.random.default_rng(0).random((20, 1, 4), np.float32):
            _, reward, _, _, infos = env.step(np.repeat(action, lanes, axis=0))
        numbers = infos["similarity"][:1], infos["optimal_action"][0], reward[:1], env.state[0]
        seen.append(np.concatenate(numbers).tolist())
    assert seen == seen[:1] * 4


@pytest.mark.parametrize("mode", [mode.value for mode in AutoresetMode])
def test_returned_arrays_are_fresh_and_writing_into_them_moves_nothing(mode: str) -> None:
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


def spoil(returned: Any) -> None:
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
