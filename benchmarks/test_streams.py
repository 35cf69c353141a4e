"""Streams: a step compared with one of its phase's environment, a switch with 100 such steps."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

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


def stepping_of(made: Any, *, batched: bool) -> Callable[[int], None]:
    """Steps of a single environment, or of a batch of it."""
    if batched:
        return batch_stepping(sme_registry.make_vec(made, BATCH), ACTIONS)
    return stepping(sme_registry.make(made))


@pytest.mark.parametrize("batched", [False, True], ids=["single", "batch"])
@pytest.mark.parametrize("complexity", [1, 3])
@pytest.mark.parametrize("switch", ["episode", "step"])
def test_step_of_a_stream(compare: Any, switch: str, complexity: int, batched: bool) -> None:
    stream, spec = two_phases(complexity, 10**9, switch=switch), SMESpec(complexity=complexity)
    ours, alone = (stepping_of(each, batched=batched) for each in (stream, spec))
    units = 100 if batched else 5000
    compare(
        f"stream, {switch}, L = {complexity}{', batch' if batched else ''}",
        "step",
        ours,
        units,
        {"its phase alone": (alone, units, 1 / 1.15)},
        clock=time.thread_time,
    )


@pytest.mark.parametrize("batched", [False, True], ids=["single", "batch"])
@pytest.mark.parametrize("complexity", [1, 3])
def test_switch(compare: Any, complexity: int, batched: bool) -> None:
    """Each step of these streams is followed by a switch."""
    stream, spec = two_phases(complexity, 1, switch="step"), SMESpec(complexity=complexity)
    ours, alone = (stepping_of(each, batched=batched) for each in (stream, spec))
    compare(
        f"step and switch, L = {complexity}{', batch' if batched else ''}",
        "switch",
        ours,
        50 if batched else 500,
        {"100 steps alone": (lambda times: alone(100 * times), 1 if batched else 20, 1)},
        clock=time.thread_time,
    )
