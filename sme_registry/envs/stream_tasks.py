"""`StreamTasks`: a stream and the drawn task of each of its pieces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sme_registry.envs.types import Lanes, Observation
from sme_registry.spec import StreamSpec
from sme_registry.spec.stream import Schedule
from sme_registry.task import Task


@dataclass(frozen=True, eq=False)
class StreamTasks:
    """A stream's tasks, and when each of them is in force.

    Attributes:
      stream: the stream.
      tasks: the task of each piece of a cycle; pieces with equal specs share one.
    """

    stream: StreamSpec
    tasks: tuple[Task, ...]

    @cached_property
    def schedule(self) -> Schedule:
        """Which piece is in force when."""
        return self.stream.schedule

    @cached_property
    def phases(self) -> Lanes:
        """The phase of each piece, `[pieces]`."""
        return np.array([piece.phase for piece in self.stream.pieces])

    @cached_property
    def k(self) -> Lanes:
        """k of each piece, `[pieces]`."""
        return np.array([task.spec.k for task in self.tasks])

    def shown(self, phase: int | Sequence[int] | Lanes) -> Observation:
        """What an observation in a phase ends with, `[…, P]`: its one-hot, or (P = 0) nothing."""
        count = len(self.stream.phases)
        one_hot = np.eye(count, dtype=np.float32)[phase]
        return one_hot if self.stream.observes_phase else one_hot[..., :0]
