"""The regret of a ticket's steps, from its journal."""

import numpy as np
import pytest

from leaderboard.sealed.journal import Journal
from leaderboard.sealed.regret import measured_steps
from leaderboard.sealed.stepping import Start
from sme_registry import SMESpec
from sme_registry.envs import SMEEnv

SPEC = SMESpec(state_dim=3, action_dim=2, complexity=5, horizon=4, seed=12)
START = Start(SPEC, 5)


def journal(folder, actions):
    """A journal of actions `[requests, L, A]`."""
    made = Journal.create(folder / "0.journal", actions.shape[1], 2)
    for each in actions:
        made.append(each.astype("<f4").tobytes())
    return made


def regrets(actions):
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


@pytest.mark.parametrize(("taken", "budget"), [(250, 250), (130, 250), (5, 8)])
def test_the_curve_has_the_regret_of_each_part_relative_to_the_constant(tmp_path, taken, budget):
    """Steps that were not taken count like the constant's."""
    actions = np.random.default_rng(1).random((taken, 1, 2), dtype=np.float32)
    measured = measured_steps(START, journal(tmp_path, actions), budget)
    rows, parts = regrets(actions), min(budget, 100)
    part = np.arange(budget) * parts // budget
    curve = np.ones(parts)
    for number in range(parts):
        own = rows[part[:taken] == number]
        if len(own):
            share = len(own) / (part == number).sum()
            curve[number] = share * own[:, 0].sum() / own[:, 1].sum() + 1.0 - share
    np.testing.assert_allclose(measured.learning_curve, curve, rtol=1e-12)
    ratio = rows[:, 0].sum() / rows[:, 1].sum()
    expected = (taken * ratio + budget - taken) / budget
    assert measured.normalised_online_regret == pytest.approx(expected, rel=1e-12)
    assert measured.steps == taken


def test_the_constant_has_a_regret_of_one_with_any_lanes_and_without_a_start(tmp_path):
    half = np.full((6, 3, 2), 0.5, np.float32)
    measured = measured_steps(START, journal(tmp_path, half), 20)  # 18 of them can be taken
    np.testing.assert_allclose(measured.learning_curve, [1.0] * 6, rtol=1e-12)
    assert measured.steps == 18
    never = measured_steps(START, None, 1000)
    assert (never.steps, never.normalised_online_regret) == (0, 1.0)
    assert never.learning_curve == (1.0,) * 100
