"""Training steps of TD3 and SAC in JAX, compared with SB3 and with their matrix products."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.test_training import learner
from sme_registry import SMESpec
from sme_registry.training.algorithms import one_thread

jax = pytest.importorskip("jax")

SPEC = SMESpec()
STEPS = 20  # of a round
BUFFER = 2_000  # transitions

TARGET = {"TD3": 1.3, "SAC": 1.5}
BATCH = 256


def multiplications(algorithm: str) -> float:
    """Multiplications of one update for each transition of its batch.

    Forward, a network costs the size of its matrices. So do gradients by its weights, and those by
    its inputs, except that the first layer has none where its input is data.
    """
    first, second = {"TD3": (400, 300), "SAC": (256, 256)}[algorithm]
    S, A = SPEC.state_dim + 2, SPEC.action_dim
    heads = {"TD3": A, "SAC": 2 * A}[algorithm]
    inner = first * second
    actor, critic = S * first + inner + heads * second, (S + A) * first + inner + second
    fit = 2 * (3 * critic - (S + A) * first)  # both critics
    act = 2 * actor - S * first  # the actor's gradients
    if algorithm == "TD3":
        return actor + 2 * critic + fit + (actor + 2 * critic + act) / 2
    return 2 * actor + 2 * critic + fit + 4 * critic + act


def products(algorithm: str) -> Callable[[int], None]:
    """Nothing but matrix products, with as many multiplications as that number of updates."""
    inputs, outputs = {"TD3": (400, 300), "SAC": (256, 256)}[algorithm]
    W = np.linalg.qr(np.random.default_rng(0).standard_normal((inputs, outputs)))[0]
    pairs = multiplications(algorithm) / (2 * inputs * outputs)

    @jax.jit
    def run(x: Any, W: Any, count: Any) -> Any:
        return jax.lax.fori_loop(0, count, lambda _, x: (x @ W) @ W.T, x)

    x, W = np.ones((BATCH, inputs), np.float32), W.astype(np.float32)
    return lambda updates: run(x, W, round(updates * pairs)).block_until_ready()


def training(algorithm: str, lanes: int = 1, budget: int = BUFFER) -> Callable[[int], None]:
    """Steps of a program whose updates have begun."""
    from sme_registry.jax.run import new_program

    program = new_program(
        f"jax:{algorithm}",
        [SPEC] * lanes,
        range(lanes),
        hyperparameters={"learning_starts": 10},
        steps=budget,
    )
    program.advance(20)
    return lambda steps: program.advance(program.steps + steps) and None


@pytest.mark.parametrize("algorithm", TARGET)
def test_training_steps_of_one_agent(compare: Any, algorithm: str) -> None:
    from sme_registry.sb3 import SMEVecEnv

    model = learner(algorithm, SMEVecEnv(SPEC))
    model.learn(STEPS)

    def sb3(steps: int) -> None:
        model.learn(steps, reset_num_timesteps=False)

    with one_thread():
        compare(
            f"{algorithm} in JAX, an agent", "step", training(algorithm), STEPS,
            {
                "SB3": (sb3, STEPS, TARGET[algorithm]),
                "four agents": (training(algorithm, lanes=4), STEPS, 0.0),
                "its matrix products": (products(algorithm), STEPS, 0.0),
            },
            clock=time.process_time,
        )  # fmt: skip


@pytest.mark.parametrize("algorithm", TARGET)
def test_training_steps_with_a_large_buffer(compare: Any, algorithm: str) -> None:
    large = 50 * BUFFER
    compare(
        f"{algorithm} in JAX, a buffer of {large:,}", "step", training(algorithm, budget=large),
        STEPS, {f"a buffer of {BUFFER:,}": (training(algorithm), STEPS, 1 / 1.2)},
        clock=time.process_time,
    )  # fmt: skip
