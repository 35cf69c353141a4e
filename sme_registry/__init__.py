"""Synthetic Monitoring Environments: control tasks whose optimal policy is known exactly.

    import gymnasium, sme_registry
    env = gymnasium.make("SME/Default-v1")            # exact regret in info, at every step

Importing this package registers the catalogue. What costs time to import is loaded on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from sme_registry.errors import SMEError
from sme_registry.registration import (
    env_spec,
    load,
    make,
    make_aec,
    make_parallel,
    make_vec,
    register,
    register_catalogue,
    save,
)
from sme_registry.version import __version__ as __version__

if TYPE_CHECKING:
    from sme_registry.envs.team import env, parallel_env
    from sme_registry.evaluation.evaluate import evaluate
    from sme_registry.evaluation.report import EvaluationReport
    from sme_registry.spec import EvaluationProtocol, SMESpec
    from sme_registry.task import Task, materialize

__all__ = [
    "EvaluationProtocol",
    "EvaluationReport",
    "SMEError",
    "SMESpec",
    "Task",
    "env",
    "env_spec",
    "evaluate",
    "load",
    "make",
    "make_aec",
    "make_parallel",
    "make_vec",
    "materialize",
    "parallel_env",
    "register",
    "save",
]

_LAZY = {
    "EvaluationProtocol": "sme_registry.spec",
    "EvaluationReport": "sme_registry.evaluation",
    "SMESpec": "sme_registry.spec",
    "Task": "sme_registry.task",
    "env": "sme_registry.envs.team",
    "evaluate": "sme_registry.evaluation",
    "materialize": "sme_registry.task",
    "parallel_env": "sme_registry.envs.team",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_catalogue()
