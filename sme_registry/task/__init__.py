"""From a spec to numbers and equations: the NumPy definition of every task."""

from sme_registry.task.draw import Layer
from sme_registry.task.step import Step, observe, step
from sme_registry.task.task import Task, materialize

__all__ = ["Layer", "Step", "Task", "materialize", "observe", "step"]
