"""How long a study will take: from a table of costs, and from finished cells once there are some.

A cell takes, in seconds of one core, with P its steps (times the agents of a team), E its
evaluations, T the horizon, N the states of its evaluation in and out of distribution, L the layers
of the optimal policy:

    start + P · step + E · T · batch step + N · (state + layer · (L − 1))

A life in a stream takes the last term for each of its tasks at the end.
In JAX it is a lane of a program of ten on a CPU, and a batch step takes more for each layer, too.
Once cells have finished, the sum after `start` is multiplied by the median ratio of their measured
to their estimated seconds, over cells of the same algorithm and setting, or else of the same
algorithm.
"""

from __future__ import annotations

import heapq
import statistics
from collections import defaultdict
from collections.abc import Hashable, Iterable, Sequence
from typing import NamedTuple

from sme_registry.spec import Cell, SMESpec
from sme_registry.spec.study import INDEPENDENT, REFERENCE, in_jax
from sme_registry.studies.engine.result import CellResult

# Seconds of one training step with default hyperparameters: on a fast core, and the slowest
# measured. Other algorithms may be as fast as PPO or as slow as SAC.
SECONDS_PER_STEP = {
    "PPO": (0.0006, 0.0013),
    "A2C": (0.0006, 0.0013),
    "TD3": (0.012, 0.021),
    "DDPG": (0.012, 0.021),
    "SAC": (0.013, 0.024),
    "jax:PPO": (0.00002, 0.00006),
    "jax:TD3": (0.006, 0.014),
    "jax:SAC": (0.005, 0.013),
    "offline:bc": (0.0015, 0.0030),
    "offline:iql": (0.006, 0.0110),
}
_UNKNOWN = (SECONDS_PER_STEP["PPO"][0], SECONDS_PER_STEP["SAC"][1])
_BATCH_STEP = (0.00006, 0.0005)  # one step of all episodes of an evaluation, which run as a batch
_STATE = (1.5e-6, 3e-6)
_LAYER = (1e-6, 3e-6)  # of π*, which is evaluated in every state
_START = (1.5, 4.0)  # a process and its imports
_START_IN_JAX = (0.4, 2.0)  # a tenth of them, and of compiling
_BATCH_STEP_IN_JAX = (5e-7, 2e-6)
_BATCH_LAYER_IN_JAX = (3.6e-6, 1.2e-5)


class Span(NamedTuple):
    """Bounds in seconds; equal if they come from finished cells."""

    low: float
    high: float


class Estimator:
    """Estimates the seconds of cells; improves as cells finish."""

    def __init__(self, finished: Iterable[CellResult] = ()) -> None:
        self._ratios: dict[Hashable, list[float]] = defaultdict(list)
        for result in finished:
            self.observe(result)

    def observe(self, result: CellResult, seconds: float | None = None) -> None:
        """Learn from a finished cell, and from its wall time in seconds if that was measured."""
        expected = _work(result.cell).low
        if expected > 0 and result.timing.total > 0:
            took = max(result.timing.total, (seconds or 0.0) - _start(result.cell).low)
            ratio = took / expected
            self._ratios[result.cell.uses].append(ratio)
            self._ratios[result.cell.uses, _setting(result.cell)].append(ratio)

    def knows(self, cell: Cell) -> bool:
        """Whether a cell of the same algorithm has finished."""
        return bool(self._ratios.get(cell.uses))

    def seconds(self, cell: Cell) -> Span:
        """Estimate the cell on one core."""
        work = _work(cell)
        ratios = self._ratios.get((cell.uses, _setting(cell))) or self._ratios.get(cell.uses)
        start = _start(cell)
        if ratios:
            seconds = start.low + work.low * statistics.median(ratios)
            return Span(seconds, seconds)
        return Span(start.low + work.low, start.high + work.high)


def makespan(seconds: Sequence[float], workers: int) -> float:
    """Seconds to the end of jobs that are started in order, each by the first free worker."""
    free = [0.0] * min(workers, len(seconds))
    for job in seconds:
        heapq.heapreplace(free, free[0] + job)
    return max(free, default=0.0)


def _work(cell: Cell) -> Span:
    """A cell's seconds by the table, without its start."""
    uses = cell.uses.removeprefix(INDEPENDENT)
    transitions = 0 if uses.startswith(REFERENCE) else cell.steps * _agents(cell.spec)
    states = cell.protocol.states_per_region * len(cell.protocol.edges)
    step = SECONDS_PER_STEP.get(uses, _UNKNOWN)

    inner = [spec.complexity - 1 for spec in cell.specs]
    layers = sum(inner) / len(inner)

    def bound(i: int) -> float:
        training = transitions * step[i]
        batch_step = _BATCH_STEP[i]
        if in_jax(cell.uses):
            batch_step = _BATCH_STEP_IN_JAX[i] + _BATCH_LAYER_IN_JAX[i] * layers
        curve = cell.evaluations * cell.spec.horizon * batch_step
        return training + curve + states * len(inner) * (_STATE[i] + _LAYER[i] * layers)

    return Span(bound(0), bound(1))


def _start(cell: Cell) -> Span:
    return Span(*(_START_IN_JAX if in_jax(cell.uses) else _START))


def _agents(spec: SMESpec) -> int:
    """How many transitions a step gives."""
    return 1 if spec.team is None else len(spec.team.agents)


def _setting(cell: Cell) -> Hashable:
    return tuple(spec.model_copy(update={"seed": 0}) for spec in cell.specs)
