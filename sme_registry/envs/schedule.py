"""`Schedule`: which task is in force after how many environment steps; METHOD, section 7.

A task is a stream of one segment that is never over, so every environment runs a schedule.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from sme_registry.compiled.arrays import Indices, Observation
from sme_registry.envs import arguments
from sme_registry.spec import SMESpec, SpecLike, StreamLike, StreamSpec
from sme_registry.spec.catalogue import Resolved, resolve
from sme_registry.task import Task, materialize_segments


class Schedule:
    """The tasks of a spec or a stream, and when each of them is in force.

    Attributes:
      document: the spec or the stream.
      stream: the stream; None for a task.
      tasks: the task of each segment of a cycle; segments with equal specs share one.
      phases: the phase of each segment, `[segments]`.
      k: the k of each segment, `[segments]`.
      switches_within: whether a segment may end within an episode, rather than at the next reset.
    """

    def __init__(self, document: SMESpec | StreamSpec, tasks: Sequence[Task]) -> None:
        self.document, self.tasks = document, tuple(tasks)
        self.stream = document if isinstance(document, StreamSpec) else None
        self.phases = np.array([segment.phase for segment in document.segments])
        self.k = np.array([task.spec.k for task in tasks])
        self.switches_within = document.switch == "step"
        self._times = document.times

    @classmethod
    def of(cls, task: Task) -> Schedule:
        """The schedule of a task: one segment."""
        return cls(task.spec, [task])

    @classmethod
    def load(
        cls, environment: type, document: SpecLike | StreamLike, overrides: dict[str, Any]
    ) -> Schedule:
        """The schedule of an environment class that is called with a document and overrides.

        `stream=` among the overrides takes the place of the document, as in the `EnvSpec` of a
        stream. Others are fields of a spec; a stream has none to change.
        """
        overrides = dict(overrides)
        stream = overrides.pop("stream", None)
        resolved: Resolved[Any]
        resolved = resolve(document) if stream is None else resolve(stream, StreamSpec)
        arguments.check_overrides(environment, resolved.document, overrides)
        if overrides:
            resolved = Resolved(cast("SMESpec", resolved.document).derive(**overrides))
        tasks = materialize_segments(*resolved)
        arguments.single_agent(tasks[0])
        return cls(resolved.document, tasks)

    @property
    def reset_options(self) -> tuple[str, ...]:
        """The options of a reset of its environments."""
        if self.stream is not None:
            return "state", "lifetime"
        return ("state", "distractors") if self.tasks[0].spec.distractors else ("state",)

    def segment(self, lifetime: int) -> int:
        """The segment in force after so many environment steps; the last one at the end."""
        return self._times.segment_at(lifetime)

    def next_switch(self, lifetime: int) -> int:
        """The lifetime at which that segment is over; NEVER in the last one of the life."""
        return self._times.next_switch(lifetime)

    def shown(self, phase: int | Indices) -> Observation:
        """What an observation in a phase ends with, `[…, P]`: its one-hot, or (P = 0) nothing."""
        if not self.document.observed_phases:
            return np.empty((*np.shape(phase), 0), np.float32)
        one_hot: Observation = np.eye(self.document.observed_phases, dtype=np.float32)[phase]
        return one_hot
