"""From a spec to numbers and equations: the NumPy definition of every task."""

from sme_registry.task.draw import Layer
from sme_registry.task.loading import load, load_task, materialize
from sme_registry.task.task import Task, observe, step

__all__ = [
    "Layer",
    "Task",
    "load",
    "load_task",
    "materialize",
    "observe",
    "step",
]
