"""The step and the oracle of a task, fast: machine code where Numba is installed."""

from sme_registry.compiled.engine import Engine, chosen_backend, engine
from sme_registry.compiled.extension import Extension, extension

__all__ = ["Engine", "Extension", "chosen_backend", "engine", "extension"]
