"""Environments: the only code that keeps state from one step to the next."""

from sme_registry.envs.single import SMEEnv
from sme_registry.envs.vector import SMEVectorEnv

__all__ = ["SMEEnv", "SMEVectorEnv"]
