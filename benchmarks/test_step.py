"""Steps per second, single and batched, compared with Gymnasium's environments and plain NumPy."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import sme_registry
from benchmarks.plain_numpy import PlainBatch, PlainEnv
from sme_registry import SMESpec, Task, materialize

BATCH = 1024

gymnasium.register("PlainNumPy-v0", entry_point=PlainEnv)


def stepping(env: gymnasium.Env[Any, Any]) -> Callable[[int], None]:
    """Steps with a fixed action (sampling one would cost more than a step), and resets."""
    env.reset(seed=0)
    action = np.full(env.action_space.shape, 0.4, np.float32)

    def work(steps: int) -> None:
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return work


def reading_weights(task: Task) -> Callable[[int], None]:
    """NumPy's `dot` over as many numbers as the optimal policy has weights."""
    weights = np.concatenate([W.ravel() for W, _ in task.policies[0]])

    def work(times: int) -> None:
        for _ in range(times):
            np.dot(weights, weights)

    return work


def batch_stepping(env: Any, actions: Any) -> Callable[[int], None]:
    if isinstance(env, gymnasium.vector.VectorEnv):
        env.reset(seed=0)

    def work(steps: int) -> None:
        for _ in range(steps):
            env.step(actions)

    return work


@pytest.mark.parametrize(("complexity", "units", "target"), [(1, 20_000, 12), (50, 1_000, 10)])
def test_single_step(compare: Any, complexity: int, units: int, target: float) -> None:
    ours = gymnasium.make("SME/Default-v1", complexity=complexity)
    plain = gymnasium.make("PlainNumPy-v0", task=materialize(SMESpec(complexity=complexity)))
    peers = {"plain NumPy": (stepping(plain), units // 10, target)}
    if complexity == 50:
        # A lower bound for any step in float64 whose weights exceed the cache.
        peers["reading the weights once"] = (reading_weights(ours.unwrapped.task), units, 0)
    if complexity == 1:
        peers["Pendulum-v1"] = (stepping(gymnasium.make("Pendulum-v1")), units // 10, 6)
    compare(f"single, complexity {complexity}", "step", stepping(ours), units, peers)


def test_batched_step(compare: Any) -> None:
    actions = np.random.default_rng(0).random((BATCH, 4), dtype=np.float32)
    ours = batch_stepping(sme_registry.make_vec("SME/Default-v1", BATCH), actions)
    plain = batch_stepping(PlainBatch(materialize(SMESpec()), BATCH), actions)
    cartpole = gymnasium.make_vec(
        "CartPole-v1", num_envs=BATCH, vectorization_mode="vector_entry_point"
    )
    pendulum = gymnasium.make_vec("Pendulum-v1", num_envs=BATCH, vectorization_mode="sync")
    compare(
        f"batch of {BATCH}",
        "batch",
        ours,
        500,
        {
            "plain batched NumPy": (plain, 200, 1.8),
            "native CartPole-v1": (batch_stepping(cartpole, np.zeros(BATCH, np.int64)), 200, 1.0),
            "SyncVectorEnv of Pendulum-v1": (
                batch_stepping(pendulum, np.full((BATCH, 1), 0.4, np.float32)),
                4,
                200,
            ),
        },
    )


SCRIPT = f"""
import sys
import numpy as np
import sme_registry

env = sme_registry.make_vec("SME/Default-v1", {BATCH})
actions = np.random.default_rng(0).random(({BATCH}, 4), dtype=np.float32)
env.reset(seed=0)
for line in sys.stdin:
    for _ in range(int(line)):
        observations, rewards, terminated, truncated, infos = env.step(actions)
    print(flush=True)
"""


def script_stepping(script: subprocess.Popen[str]) -> Callable[[int], None]:
    """Steps in the process of `SCRIPT`; a request costs as much as a step or two."""

    def work(steps: int) -> None:
        assert script.stdin is not None
        assert script.stdout is not None
        print(steps, file=script.stdin, flush=True)
        assert script.stdout.readline() == "\n"

    return work


def started_script(trim_threshold: int) -> subprocess.Popen[str]:
    """The process of `SCRIPT`, where glibc returns free memory above the threshold at once."""
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "MALLOC_TRIM_THRESHOLD_": str(trim_threshold)},
    )


def test_batched_step_of_a_plain_script(compare: Any) -> None:
    """A script steps as fast as this process, however readily its heap shrinks.

    Whether it does depends on all that a process has ever allocated; glibc's default threshold,
    128 KiB, stays in force if it is set explicitly.
    """
    actions = np.random.default_rng(0).random((BATCH, 4), dtype=np.float32)
    here = batch_stepping(sme_registry.make_vec("SME/Default-v1", BATCH), actions)
    with started_script(2**17) as shrinking, started_script(2**27) as growing:
        compare(
            f"batch of {BATCH}, a plain script",
            "batch",
            script_stepping(shrinking),
            500,
            {
                "a heap that never shrinks": (script_stepping(growing), 500, 0.95),
                "the same in this process": (here, 500, 0.9),
            },
        )
        shrinking.communicate()
        growing.communicate()
