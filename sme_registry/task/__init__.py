"""From a spec to numbers and equations: the NumPy definition of every task."""

from sme_registry.task.draw import Layer
from sme_registry.task.loading import (
    load,
    load_task,
    materialize,
    materialize_segments,
    materialize_together,
)
from sme_registry.task.task import Step, Task, observe, step

__all__ = [
    "Layer",
    "Step",
    "Task",
    "load",
    "load_task",
    "materialize",
    "materialize_segments",
    "materialize_together",
    "observe",
    "step",
]
