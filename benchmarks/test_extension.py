"""What `shaping`, `safety` and `observation` cost a step, compared with the task without them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import sme_registry
from benchmarks.test_step import BATCH, batch_stepping, stepping
from sme_registry import SMESpec

# A ratio is the plain step's time over the extended one's.
EXTENSIONS: dict[str, tuple[dict[str, Any], float]] = {
    "shaping": ({"shaping": {"scale": 3.0}}, 1 / 1.3),
    "safety": ({"safety": {"tightness": 0.2}}, 1 / 2),
    "32 distractors, nonlinear": (
        {"observation": {"distractors": 32, "mixing": "nonlinear"}},
        1 / 3,
    ),
    "32 driven distractors, nonlinear": (
        {"observation": {"distractors": 32, "dynamics": "driven", "mixing": "nonlinear"}},
        1 / 3,
    ),
}


@pytest.mark.parametrize("complexity", [1, 3])
@pytest.mark.parametrize("name", EXTENSIONS)
def test_extended_single_step(compare: Any, name: str, complexity: int) -> None:
    plain, (fields, target) = SMESpec(complexity=complexity), EXTENSIONS[name]
    envs = [gymnasium.make(sme_registry.env_spec(plain.derive(**each))) for each in (fields, {})]
    ours, peer = map(stepping, envs)
    title = f"single, complexity {complexity}, {name}"
    compare(title, "step", ours, 5_000, {"the same without": (peer, 5_000, target)})


@pytest.mark.parametrize("complexity", [1, 3])
@pytest.mark.parametrize("name", EXTENSIONS)
def test_extended_batched_step(compare: Any, name: str, complexity: int) -> None:
    plain, (fields, target) = SMESpec(complexity=complexity), EXTENSIONS[name]
    actions = np.random.default_rng(0).random((BATCH, 4), dtype=np.float32)
    ours, peer = (
        batch_stepping(sme_registry.make_vec(plain.derive(**each), BATCH), actions)
        for each in (fields, {})
    )
    title = f"batch of {BATCH}, complexity {complexity}, {name}"
    compare(title, "batch", ours, 200, {"the same without": (peer, 200, target)})
