"""Frames of the lanes of a batch are those of single environments."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import sme_registry
from sme_registry.envs import SMEEnv, SMEVectorEnv
from sme_registry.errors import EpisodeError, OptionError

pytest.importorskip("pygame")
# Lanes drift apart, and payouts are late.
TASK = sme_registry.SMESpec(horizon=6, k=4, D=0.1, seed=4)


def drawn(lanes: int = 3, **kwargs: Any) -> SMEVectorEnv:
    return SMEVectorEnv(TASK, lanes, render_mode="rgb_array", **kwargs)


@pytest.mark.parametrize(
    ("mode", "action_range"),
    [("NextStep", "symmetric"), ("SameStep", "unit"), ("Disabled", "unit")],
)
def test_frames_are_those_of_single_environments(mode: str, action_range: Any) -> None:
    batch = drawn(2, autoreset_mode=mode, action_range=action_range)
    make = lambda: SMEEnv(TASK, render_mode="rgb_array", action_range=action_range)  # noqa: E731
    singles: Any = SyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode(mode))
    for env in (batch, singles):
        env.reset(seed=1)
        env.action_space.seed(0)
    np.testing.assert_array_equal(batch.render(), singles.render())
    for _ in range(8):
        action = batch.action_space.sample()
        _, _, terminated, truncated, _ = batch.step(action)
        singles.step(action)
        ended = terminated | truncated
        if mode == "Disabled" and ended.any():
            for env in (batch, singles):
                env.reset(options={"reset_mask": ended.copy()})
        np.testing.assert_array_equal(batch.render(), singles.render())


def test_lanes_that_are_not_chosen_share_one_white_frame() -> None:
    few, each = drawn(4, render_lanes=[2]), drawn(4)
    for env in (few, each):
        env.reset(seed=0)
        env.step(np.full((4, 4), 0.3, np.float32))
    frames = few.render()
    assert frames is not None
    assert len(frames) == 4
    assert frames[0] is frames[3]
    assert (frames[0] == 255).all()
    assert frames[0].shape == frames[2].shape
    np.testing.assert_array_equal(frames[2], each.render()[2])  # type: ignore[index]


def test_frames_need_a_mode_a_reset_and_lanes_that_exist() -> None:
    assert SMEVectorEnv(TASK, 2).render() is None
    with pytest.raises(EpisodeError, match="render"):
        drawn().render()
    for lanes in ([3], [-1], [0.5], 1, "0", []):
        with pytest.raises(OptionError, match="render_lanes"):
            drawn(render_lanes=lanes)
