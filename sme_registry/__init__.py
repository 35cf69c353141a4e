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
    make,
    make_aec,
    make_parallel,
    make_vec,
    register,
    register_catalogue,
)
from sme_registry.version import __version__ as __version__

if TYPE_CHECKING:
    from sme_registry import datasets as datasets
    from sme_registry import diagnosis as diagnosis
    from sme_registry import envs as envs
    from sme_registry import errors as errors
    from sme_registry import evaluation as evaluation
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
    from sme_registry.diagnosis import diagnose
    from sme_registry.evaluation import EvaluationReport, StreamReport, evaluate
    from sme_registry.evaluation.rollouts import values
    from sme_registry.export import export_onnx
    from sme_registry.profiles.document import Profile
    from sme_registry.profiles.run import profile
    from sme_registry.spec import EvaluationProtocol, SMESpec, StreamSpec
    from sme_registry.studies import compare, run_study
    from sme_registry.studies import load as load_study
    from sme_registry.task import Task, load, materialize
    from sme_registry.task.loading import save
    from sme_registry.training import train

__all__ = [
    "EvaluationProtocol",
    "EvaluationReport",
    "Profile",
    "SMEError",
    "SMESpec",
    "StreamReport",
    "StreamSpec",
    "Task",
    "compare",
    "diagnose",
    "env_spec",
    "evaluate",
    "export_onnx",
    "load",
    "load_study",
    "make",
    "make_aec",
    "make_dataset",
    "make_parallel",
    "make_vec",
    "materialize",
    "profile",
    "register",
    "run_study",
    "save",
    "train",
    "train_offline",
    "values",
]

_LAZY = {
    "EvaluationProtocol": "sme_registry.spec.EvaluationProtocol",
    "EvaluationReport": "sme_registry.evaluation.EvaluationReport",
    "Profile": "sme_registry.profiles.document.Profile",
    "SMESpec": "sme_registry.spec.SMESpec",
    "StreamReport": "sme_registry.evaluation.StreamReport",
    "StreamSpec": "sme_registry.spec.StreamSpec",
    "Task": "sme_registry.task.Task",
    "compare": "sme_registry.studies.compare",
    "diagnose": "sme_registry.diagnosis.diagnose",
    "evaluate": "sme_registry.evaluation.evaluate",
    "export_onnx": "sme_registry.export.export_onnx",
    "load": "sme_registry.task.load",
    "load_study": "sme_registry.studies.load",
    "make_dataset": "sme_registry.datasets.make_dataset",
    "materialize": "sme_registry.task.materialize",
    "profile": "sme_registry.profiles.run.profile",
    "run_study": "sme_registry.studies.run_study",
    "save": "sme_registry.task.loading.save",
    "train": "sme_registry.training.train",
    "train_offline": "sme_registry.datasets.train_offline",
    "values": "sme_registry.evaluation.rollouts.values",
}

# Not in `__all__`: a star import would load all of them, and with them optional dependencies.
_SUBMODULES = (
    "datasets",
    "diagnosis",
    "envs",
    "errors",
    "evaluation",
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
        module, _, attribute = _LAZY[name].rpartition(".")
        return getattr(importlib.import_module(module), attribute)
    if name in _SUBMODULES:
        return importlib.import_module(f"sme_registry.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_SUBMODULES})


register_catalogue()
