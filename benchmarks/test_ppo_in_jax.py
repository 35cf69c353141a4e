"""Training steps of PPO in JAX: beside SB3, of tasks of unequal rewards, and of streams."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from benchmarks.test_training import learner
from sme_registry import SMESpec
from sme_registry.spec import StreamSpec
from sme_registry.task import load
from sme_registry.training.algorithms import one_thread

pytest.importorskip("jax")

ROLLOUT = 2048
# The paper's settings that differ in rewards alone, and so share a program.
SETTINGS = [
    SMESpec(**fields)
    for fields in (
        *({"k": k} for k in (1, 5, 10, 25, 100)),
        *({"r_min": r_min} for r_min in (0.25, 0.5, 0.75)),
        *({"D": D} for D in (0.1, 0.25, 0.5)),
    )
]
TARGET = {1: 18.0, 10: 25.0}  # of an agent, among so many


def training(specs: Sequence[SMESpec | StreamSpec]) -> Callable[[int], None]:
    """Steps of agents, and their updates; the number is that of all agents together."""
    from sme_registry.jax.run import new_program

    program = new_program("jax:PPO", specs, range(len(specs)), steps=ROLLOUT)

    def train(steps: int) -> None:
        program.advance(program.steps + steps // len(specs))
        program.finish()
        program.failed()  # waits for the update

    return train


@pytest.mark.parametrize("agents", TARGET)
def test_training_steps_of_agents(compare: Any, agents: int) -> None:
    from sme_registry.sb3 import SMEVecEnv

    model = learner("PPO", SMEVecEnv(SMESpec()))

    def sb3(steps: int) -> None:
        model.learn(steps, reset_num_timesteps=False)

    with one_thread():
        sb3(ROLLOUT)
        compare(
            f"PPO in JAX, one of {agents} agent{'s' * (agents > 1)}", "step",
            training([SMESpec()] * agents), agents * ROLLOUT,
            {"SB3": (sb3, ROLLOUT, TARGET[agents])},
            clock=time.process_time,
        )  # fmt: skip


def test_training_steps_of_all_rewards(compare: Any) -> None:
    n = len(SETTINGS)
    compare(
        f"PPO in JAX, {n} settings of k, r_min and D", "step", training(SETTINGS), n * ROLLOUT,
        {f"{n} agents of one setting": (training(SETTINGS[:1] * n), n * ROLLOUT, 1 / 1.1)},
        clock=time.process_time,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["Switch5", "Drift"])
def test_training_steps_in_a_stream(compare: Any, name: str) -> None:
    """Whose switches are 20,000 steps apart; or 1,000, so that each rollout has parts.

    Each part draws the random numbers of the whole rollout.
    """
    stream = StreamSpec(phases=load(f"SME/{name}-v1", StreamSpec).phases, cycles=1000)
    steps = 10 * ROLLOUT
    compare(
        f"PPO in JAX, a life in {name}", "step", training([stream]), steps,
        {"its first phase": (training([stream.phases[0].spec]), steps, 1 / 1.15)},
        clock=time.process_time,
    )  # fmt: skip
