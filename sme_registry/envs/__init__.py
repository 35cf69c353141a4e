"""Environments: the only code that keeps state from one step to the next."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from sme_registry.envs.single import SMEEnv
from sme_registry.envs.stream import SMEStreamEnv

if TYPE_CHECKING:
    from sme_registry.envs.stream_vector import SMEStreamVectorEnv
    from sme_registry.envs.vector import SMEVectorEnv

__all__ = ["SMEEnv", "SMEStreamEnv", "SMEStreamVectorEnv", "SMEVectorEnv"]

# Only on request: a single environment also works with versions of Gymnasium without these vectors.
_VECTORS = {"SMEStreamVectorEnv": "stream_vector", "SMEVectorEnv": "vector"}


def __getattr__(name: str) -> Any:
    if name in _VECTORS:
        module = importlib.import_module(f"sme_registry.envs.{_VECTORS[name]}")
        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
