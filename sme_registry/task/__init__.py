"""From a spec to numbers and equations: the NumPy definition of every task."""

from sme_registry.task.certificate import certify
from sme_registry.task.draw import Layer as Layer
from sme_registry.task.episode import observe, step
from sme_registry.task.loading import load, materialize
from sme_registry.task.task import Task

__all__ = [
    "Task",
    "certify",
    "load",
    "materialize",
    "observe",
    "step",
]
