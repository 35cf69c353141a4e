"""Teams: steps per second compared with MPE2, and a batch of teams compared with single agents."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import sme_registry
from sme_registry import SMESpec, materialize
from sme_registry.envs.batch import Batch

BATCH = 1024


def team_stepping(env: Any, actions: dict[str, Any]) -> Callable[[int], None]:
    """Parallel steps with fixed actions, and resets."""
    env.reset(seed=0)

    def work(steps: int) -> None:
        for _ in range(steps):
            env.step(actions)
            if not env.agents:
                env.reset()

    return work


def batch_stepping(spec: SMESpec) -> Callable[[int], None]:
    """Steps of 1,024 lanes, with resets of finished episodes."""
    batch = Batch(materialize(spec), BATCH)
    actions = np.random.default_rng(0).random((BATCH, spec.action_dim))
    batch.begin(np.arange(BATCH), batch.observe())

    def work(steps: int) -> None:
        for _ in range(steps):
            done = batch.advance(actions)
            ended = done.terminated | done.truncated
            if ended.any():
                batch.begin(np.flatnonzero(ended), done.observation)

    return work


def test_parallel_step(compare: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # importing it gives a deprecation warning
        simple_spread = pytest.importorskip("mpe2.simple_spread_v3")
        spread = simple_spread.parallel_env(N=3)
    spread.reset(seed=0)
    ours = sme_registry.make_parallel("SME/Team4-v1")
    compare(
        "team of 4, parallel",
        "step",
        team_stepping(ours, {name: np.full(2, 0.4, np.float32) for name in ours.possible_agents}),
        10_000,
        {
            "MPE2 simple_spread, 3 agents": (
                team_stepping(spread, dict.fromkeys(spread.possible_agents, 2)), 400, 25,
            )
        },
    )  # fmt: skip


@pytest.mark.parametrize("name", ["Team4", "TeamShared4", "TeamBlind4", "Team8"])
def test_batched_team_step(compare: Any, name: str) -> None:
    team = sme_registry.load(name)
    single = batch_stepping(team.derive(team=None))
    compare(
        f"{name}, batch of {BATCH}",
        "batch",
        batch_stepping(team),
        300,
        {"one agent, same S and A": (single, 300, 0.5)},
    )
