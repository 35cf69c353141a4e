"""`Lives`: which tasks the lanes of a program are on, after how many steps.

A lane lives through a stream (METHOD, section 7), or is on one task for ever. All lanes of a
program switch at the same steps, and what a program keeps of its lanes does not depend on their
tasks, so a switch only passes other `TaskParams` to the same compiled code. Phases of one layer
beside phases of several are compiled once each.

A switch happens at once. With `switch="episode"` that is right where every episode ends at the
switch, which `Lives` checks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from sme_registry.errors import OptionError, SpecError
from sme_registry.jax.task import Shape, TaskParams, stacked_params
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.task import Task, materialize_segments

Lane = SMESpec | StreamSpec
"""What a lane lives through: one task, or a stream of them."""


class Lives:
    """The tasks of all lanes, by the steps that each lane has taken: its lifetime.

    `separable` says whether rewards change no observation and end no episode: k = 1 and D = 0 in
    all tasks. `phases` is P, of which the agent observes the one-hot; 0 where it does not.
    """

    def __init__(self, lanes: Sequence[Lane], shape: Shape | None, device: Any) -> None:
        _check_alike(lanes)
        first = lanes[0]
        self._stream = first if isinstance(first, StreamSpec) else None
        self._times, self._segments = first.times, first.segments
        if self._stream is not None:
            check_switches(self._stream)
        self.phases = first.observed_phases
        self._at_once = first.switch == "step"
        drawn = {lane: materialize_segments(lane) for lane in lanes}
        segments = [*zip(*(drawn[lane] for lane in lanes), strict=True)]
        specs = {task.spec for tasks in segments for task in tasks}
        self.separable = all(spec.k == 1 and spec.D == 0 for spec in specs)
        shapes = _shapes(segments, shape)
        stacked = {
            tasks: jax.device_put(stacked_params(tasks, shapes[_is_deep(tasks)]), device)
            for tasks in dict.fromkeys(segments)
        }
        self._params = [self._in_phase(i, stacked[tasks]) for i, tasks in enumerate(segments)]

    def at(self, lifetime: int) -> TaskParams:
        """The tasks on which the next step is taken."""
        return self._params[self._times.segment_at(lifetime)]

    def until(self, lifetime: int, limit: int) -> int:
        """The step before which these tasks are left, at most `limit`."""
        return min(limit, self._times.next_switch(lifetime))

    def phase_after(self, lifetime: int) -> jax.Array:
        """The one-hot `[lanes, P]` in the last observation of an episode that ends there."""
        return self.at(lifetime if self._at_once else lifetime - 1).phase

    def visit_ends(self, after: int) -> Iterator[tuple[int, int]]:
        """See `StreamSpec.visit_ends`; without a stream there are none."""
        return iter(()) if self._stream is None else self._stream.visit_ends(after)

    @property
    def last_visit(self) -> tuple[int, int] | None:
        """The last visit, and the step after which its phase goes on; None without a stream."""
        if self._stream is None:
            return None
        return self._stream.visits - 1, self._stream.steps

    def _in_phase(self, segment: int, params: TaskParams) -> TaskParams:
        if not self.phases:
            return params
        shown = np.zeros((len(params.W), self.phases), np.float32)
        shown[:, self._segments[segment].phase] = 1.0
        return params._replace(phase=jax.device_put(shown, params.W.device))


def check_switches(stream: StreamSpec) -> None:
    """Raise SpecError unless every episode ends where a phase is left, or phases switch at once."""
    if stream.switch == "step" or len(stream.segments) * stream.cycles == 1:
        return
    otherwise = 'Use an algorithm of Stable-Baselines3, such as PPO, or choose switch="step".'
    for index, phase in enumerate(stream.phases):
        if phase.spec.D > 0:
            raise SpecError(
                f"phases.{index}.spec: D={phase.spec.D}: must be 0, since agents in JAX leave a "
                f"phase where all lanes end an episode. {otherwise}"
            )
    starts = [(segment.phase, segment.start) for segment in stream.segments]
    for index, step in [*starts, (len(stream.phases) - 1, stream.cycle_steps)]:
        if step % stream.horizon:
            raise SpecError(
                f"phases.{index}: begins or ends a task at step {step:,} of the cycle: must be a "
                f"multiple of horizon={stream.horizon}, since agents in JAX leave a phase where "
                f"all lanes end an episode. {otherwise}"
            )


def _check_alike(lanes: Sequence[Lane]) -> None:
    """Raise OptionError unless all lanes switch at the same steps, in the same way."""
    first, *others = (lane.switches for lane in lanes)
    for index, other in enumerate(others, 1):
        if other != first:
            raise OptionError(
                f"specs[{index}]: must switch at the same steps as specs[0]: streams of equal "
                "steps, drift.increments, cycles, switch and observes_phase, or tasks alone. Make "
                "two programs."
            )


def _is_deep(tasks: Sequence[Task]) -> bool:
    return tasks[0].spec.complexity > 1


def _shapes(segments: Sequence[Sequence[Task]], shape: Shape | None) -> dict[bool, Shape | None]:
    """To which tasks of several layers (True) and of one layer (False) are padded."""
    if len(segments) == 1:
        return {_is_deep(segments[0]): shape}
    if shape is not None:
        return {True: shape, False: shape._replace(complexity=1, hidden_width=0)}
    return {
        deep: Shape.covering(
            Shape.of(task.spec) for tasks in segments if _is_deep(tasks) is deep for task in tasks
        )
        for deep in {_is_deep(tasks) for tasks in segments}
    }
