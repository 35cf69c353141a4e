"""Streams: a step compared with one of its phase's environment, a switch with 100 such steps."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import sme_registry
from benchmarks.test_step import BATCH, batch_stepping, stepping
from sme_registry import SMESpec, StreamSpec

ACTIONS = np.random.default_rng(0).random((BATCH, 4), dtype=np.float32)


def two_phases(complexity: int, steps: int, **fields: Any) -> StreamSpec:
    """Two unrelated tasks in turn, each for so many steps."""
    specs = [SMESpec(complexity=complexity, seed=seed) for seed in range(2)]
    phases = [{"spec": spec, "steps": steps} for spec in specs]
    return StreamSpec(phases=phases, cycles=10**6, **fields)


@pytest.mark.parametrize("complexity", [1, 3])
@pytest.mark.parametrize("switch", ["episode", "step"])
def test_step_of_a_stream(compare: Any, switch: str, complexity: int) -> None:
    stream, spec = two_phases(complexity, 10**9, switch=switch), SMESpec(complexity=complexity)
    single, alone = (stepping(sme_registry.make(each)) for each in (stream, spec))
    batch, batch_alone = (
        batch_stepping(sme_registry.make_vec(each, BATCH), ACTIONS) for each in (stream, spec)
    )
    title, peer = f"stream, complexity {complexity}, switch={switch}", "its phase alone"
    compare(f"{title}, single", "step", single, 5000, {peer: (alone, 5000, 1 / 1.15)})
    compare(f"{title}, batch", "batch", batch, 200, {peer: (batch_alone, 200, 1 / 1.15)})


@pytest.mark.parametrize("complexity", [1, 3])
def test_switch(compare: Any, complexity: int) -> None:
    """Each step of these streams is followed by a switch."""
    stream = two_phases(complexity, 1, switch="step")
    env = gymnasium.make("SME/Default-v1", complexity=complexity)
    hundred, batch = stepping(env), sme_registry.make_vec(stream, BATCH)
    batch_hundred = batch_stepping(
        sme_registry.make_vec("SME/Default-v1", BATCH, complexity=complexity), ACTIONS
    )
    title, peer = f"step and switch, complexity {complexity}", "100 steps of its phase alone"
    compare(
        f"{title}, single", "switch", stepping(sme_registry.make(stream)), 500,
        {peer: (lambda times: hundred(100 * times), 20, 1)},
    )  # fmt: skip
    compare(
        f"{title}, batch", "switch", batch_stepping(batch, ACTIONS), 100,
        {peer: (lambda times: batch_hundred(100 * times), 1, 1)},
    )  # fmt: skip
