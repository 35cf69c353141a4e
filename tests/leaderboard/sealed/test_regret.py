"""The regret of a ticket's steps, from its journal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from leaderboard.sealed.journal import Journal
from leaderboard.sealed.regret import measured_steps
from leaderboard.sealed.stepping import Start
from sme_registry import SMESpec
from sme_registry.envs import SMEEnv

SPEC = SMESpec(state_dim=3, action_dim=2, complexity=5, horizon=4, seed=12)
START = Start(SPEC, 5)


def journal(path: Path, lanes: int, actions: np.ndarray) -> Journal:
    """A journal of actions `[requests, L, A]`."""
    made = Journal.create(path / f"{len(actions)}.journal", lanes, 2)
    for each in actions:
        made.append(each.astype("<f4").tobytes())
    return made


def regrets(actions: np.ndarray) -> np.ndarray:
    """The regret of a single lane's actions, and of ½ in the same states, `[requests, 2]`."""
    env, rows = SMEEnv(SPEC), []
    env.reset(seed=START.seed)
    for each in actions[:, 0]:
        half = env.task.regret(env.state, np.full(2, 0.5))
        *_, terminated, truncated, info = env.step(each)
        rows.append((info["regret"], half))
        if terminated or truncated:
            env.reset()
    return np.array(rows)


def test_the_curve_has_the_regret_of_each_part_relative_to_the_constant(tmp_path: Path) -> None:
    actions = np.random.default_rng(1).random((250, 1, 2), dtype=np.float32)
    measured = measured_steps(START, journal(tmp_path, 1, actions), 250)
    rows = regrets(actions)
    part = np.arange(250) * 100 // 250
    curve = [rows[part == i, 0].sum() / rows[part == i, 1].sum() for i in range(100)]
    np.testing.assert_allclose(measured.learning_curve, curve, rtol=1e-12)
    expected = rows[:, 0].sum() / rows[:, 1].sum()
    assert measured.normalised_online_regret == pytest.approx(expected, rel=1e-12)
    assert measured.steps == 250


def test_steps_not_taken_count_like_the_constant(tmp_path: Path) -> None:
    actions = np.random.default_rng(2).random((5, 1, 2), dtype=np.float32)
    measured = measured_steps(START, journal(tmp_path, 1, actions), 8)
    rows = regrets(actions)
    np.testing.assert_allclose(
        measured.learning_curve, [*(rows[:, 0] / rows[:, 1]), 1.0, 1.0, 1.0], rtol=1e-12
    )
    ratio = rows[:, 0].sum() / rows[:, 1].sum()
    assert measured.normalised_online_regret == pytest.approx((5 * ratio + 3) / 8, rel=1e-12)


def test_the_constant_has_a_regret_of_one_with_any_lanes(tmp_path: Path) -> None:
    half = np.full((6, 3, 2), 0.5, np.float32)
    measured = measured_steps(START, journal(tmp_path, 3, half), 20)  # 18 of them can be taken
    np.testing.assert_allclose(measured.learning_curve, [1.0] * 6, rtol=1e-12)
    assert measured.steps == 18


def test_an_instance_that_was_never_started_is_the_constant_throughout() -> None:
    measured = measured_steps(START, None, 1000)
    assert (measured.steps, measured.normalised_online_regret) == (0, 1.0)
    assert measured.learning_curve == (1.0,) * 100
