"""Steps of a batch inside one compiled program, compared with gymnax's Pendulum."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks import jax_stepping
from benchmarks.jax_stepping import LANES
from sme_registry import SMESpec

ROOT = Path(__file__).resolve().parents[1]
PYTHON = ROOT / "build" / "framework-gymnax" / "bin" / "python"


@pytest.fixture
def pendulum() -> Iterator[Callable[[int], None]]:
    """Steps of gymnax's Pendulum, in gymnax's own process."""
    if not PYTHON.exists():
        pytest.skip("gymnax is not installed. Run `make framework-gymnax`.")
    command = [PYTHON, "-m", jax_stepping.__name__]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None

        def work(steps: int) -> None:
            print(steps, file=process.stdin, flush=True)
            assert process.stdout.readline() == "\n"

        yield work
        process.stdin.close()


@pytest.mark.parametrize(
    ("D", "title", "target"),
    [(0.0, f"batch of {LANES} in lax.scan", 0.9), (0.25, "the same, starts in each step", 0)],
)
def test_a_batch_in_a_scan(
    compare: Any, pendulum: Callable[[int], None], D: float, title: str, target: float
) -> None:
    from sme_registry.jax import env
    from sme_registry.jax.task import task_params

    ours = jax_stepping.stepping(env, task_params(SMESpec(D=D)), 4)
    compare(title, "batch", ours, 1000, {"gymnax's Pendulum-v1": (pendulum, 1000, target)})
