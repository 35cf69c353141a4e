"""Environments: the only code that keeps state from one step to the next."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sme_registry.envs.single import SMEEnv

if TYPE_CHECKING:
    from sme_registry.envs.vector import SMEVectorEnv

__all__ = ["SMEEnv", "SMEVectorEnv"]


def __getattr__(name: str) -> Any:
    # Only on request: a single environment also works with versions of Gymnasium without vectors.
    if name == "SMEVectorEnv":
        from sme_registry.envs.vector import SMEVectorEnv

        return SMEVectorEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
