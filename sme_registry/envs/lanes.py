"""`Lane`: one environment of a batch, with the attributes that users of vectors ask each for."""

from __future__ import annotations

from typing import Any

from sme_registry.envs.types import Array
from sme_registry.spec import SMESpec
from sme_registry.task import Task


class Lane:
    """One environment of a batch: attributes that all lanes share, and its own.

    Args:
      owner: the batched environment.
      index: the row of the batch.
      **shared: attributes with the same value in each lane, such as `action_space`.
    """

    def __init__(self, owner: Any, index: int, **shared: Any) -> None:
        self._owner, self._index = owner, index
        vars(self).update(shared)

    @property
    def state(self) -> Array:
        """The present state s, `[S]` float64 in [0, 1] (a copy)."""
        state: Array = self._owner._batch.state[self._index]
        return state

    @property
    def distractors(self) -> Array:
        """The present distractors, `[m]` float64 in [0, 1] (a copy)."""
        distractors: Array = self._owner._batch.distractors[self._index]
        return distractors

    @property
    def task(self) -> Task:
        """The task that the lane runs; of a stream the one in force."""
        task: Task = self._owner._batch.task_of(self._index)
        return task

    @property
    def sme_spec(self) -> SMESpec:
        """Its spec."""
        return self.task.spec

    @property
    def unwrapped(self) -> Lane:
        """Itself, as environments without a wrapper have it."""
        return self
