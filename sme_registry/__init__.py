"""Synthetic Monitoring Environments: control tasks whose optimal policy is known exactly.

    import gymnasium, sme_registry
    env = gymnasium.make("SME/Default-v1")            # exact regret in info, at every step

Importing this package registers the catalogue. Its submodules, such as `sme_registry.datasets`, and
everything else that is slow to import are loaded on first use.
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
    from sme_registry import datasets as datasets
    from sme_registry import diagnosis as diagnosis
    from sme_registry import envs as envs
    from sme_registry import errors as errors
    from sme_registry import evaluation as evaluation
    from sme_registry import export as export
    from sme_registry import plots as plots
    from sme_registry import sb3 as sb3
    from sme_registry import seasons as seasons
    from sme_registry import spec as spec
    from sme_registry import statistics as statistics
    from sme_registry import studies as studies
    from sme_registry import task as task
    from sme_registry import teams as teams
    from sme_registry import testing as testing
    from sme_registry import training as training
    from sme_registry import wrappers as wrappers
    from sme_registry.datasets import make_dataset, train_offline
    from sme_registry.evaluation import EvaluationReport, evaluate
    from sme_registry.export import export_onnx
    from sme_registry.spec import EvaluationProtocol, SMESpec, StreamSpec
    from sme_registry.task import Task, materialize

__all__ = [
    "EvaluationProtocol",
    "EvaluationReport",
    "SMEError",
    "SMESpec",
    "StreamSpec",
    "Task",
    "env_spec",
    "evaluate",
    "export_onnx",
    "load",
    "make",
    "make_aec",
    "make_dataset",
    "make_parallel",
    "make_vec",
    "materialize",
    "register",
    "save",
    "train_offline",
]

_LAZY = {
    "EvaluationProtocol": "sme_registry.spec",
    "EvaluationReport": "sme_registry.evaluation",
    "SMESpec": "sme_registry.spec",
    "StreamSpec": "sme_registry.spec",
    "Task": "sme_registry.task",
    "evaluate": "sme_registry.evaluation",
    "export_onnx": "sme_registry.export",
    "make_dataset": "sme_registry.datasets",
    "materialize": "sme_registry.task",
    "train_offline": "sme_registry.datasets",
}

# Not in `__all__`: a star import would load all of them, and with them optional dependencies.
_SUBMODULES = (
    "datasets",
    "diagnosis",
    "envs",
    "errors",
    "evaluation",
    "export",
    "plots",
    "sb3",
    "seasons",
    "spec",
    "statistics",
    "studies",
    "task",
    "teams",
    "testing",
    "training",
    "wrappers",
)


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    if name in _SUBMODULES:
        return importlib.import_module(f"sme_registry.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_SUBMODULES})


register_catalogue()
