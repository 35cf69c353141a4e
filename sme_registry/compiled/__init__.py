"""The step and the oracle of a task, fast: machine code where Numba is installed."""

from sme_registry.compiled.engine import Engine, chosen_backend, engine

__all__ = ["Engine", "chosen_backend", "engine"]
