"""Saved models of Stable-Baselines3 and of packages like it: the class of a .zip, and loading it.

A .zip is code: open only those whose author you trust.

A .zip does not name its algorithm, only the class of its policy. So `saved_sb3` adds the name to
what it saves. For other files it follows from the policy's class where only one algorithm has it;
where several do, from fields that only one of them has.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

from sme_registry.errors import MissingDependencyError, PolicyError, did_you_mean
from sme_registry.io import import_object, is_installed, require_packages

_FIELD = "sme_algorithm"  # of a .zip that `saved_sb3` wrote: module:class
_NAMES = ("PPO", "A2C", "SAC", "TD3", "DDPG")

# By the module of the policy's class. DDPG has TD3's policy and loads as TD3.
_ALGORITHMS = {
    "stable_baselines3.sac.policies": "stable_baselines3:SAC",
    "stable_baselines3.td3.policies": "stable_baselines3:TD3",
    "sb3_contrib.ars.policies": "sb3_contrib:ARS",
    "sb3_contrib.common.recurrent.policies": "sb3_contrib:RecurrentPPO",
    "sb3_contrib.crossq.policies": "sb3_contrib:CrossQ",
    "sb3_contrib.tqc.policies": "sb3_contrib:TQC",
    "sbx.crossq.policies": "sbx:CrossQ",
    "sbx.ppo.policies": "sbx:PPO",
    "sbx.sac.policies": "sbx:SAC",
    "sbx.td3.policies": "sbx:TD3",
    "sbx.tqc.policies": "sbx:TQC",
}
# For the policy of all actor-critics, by a field that the algorithm saves; the first match decides.
_ACTOR_CRITICS = {
    "clip_range": "stable_baselines3:PPO",
    "cg_max_steps": "sb3_contrib:TRPO",
    "gae_lambda": "stable_baselines3:A2C",
}
_ACTOR_CRITIC_POLICY = "stable_baselines3.common.policies"
_PACKAGES = {"sb3_contrib": "sb3-contrib", "sbx": "sbx-rl"}  # what `pip install` calls them


def load_sb3(path: str | os.PathLike[str], algorithm: str | None = None) -> Any:
    """Load a model that Stable-Baselines3 saved, on the CPU and without its environment.

    Args:
      path: the .zip. Loading it can run code of its author.
      algorithm: its class, "PPO", "A2C", "SAC", "TD3", "DDPG" or `module:Class`, such as
        "sb3_contrib:TQC". None reads it from the file, which works for files of `sme train` and of
        studies, and for the algorithms of stable-baselines3, sb3-contrib and sbx with their own
        policies (a DDPG loads as TD3, which acts equally).

    Examples:
      >>> from sme_registry.evaluation import load_sb3
      >>> type(load_sb3("runs/ppo/model.zip")).__name__
      'PPO'
    """
    path = Path(path)
    fields = _saved_fields(path)
    packages = {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}
    require_packages(f"loading {path}", packages, "train")
    name = _algorithm_of(path, fields) if algorithm is None else _full_name(algorithm)
    model_class = _import(name, path)
    try:
        # Otherwise the replay buffer is allocated at its full size, though acting never uses it.
        return model_class.load(path, device="cpu", custom_objects={"buffer_size": 1})
    except Exception as error:
        raise PolicyError(
            f"{path}: cannot be loaded as a model of {name}: {type(error).__name__}: {error}. If "
            "it is of another algorithm, give its class (`sme evaluate --algorithm`, in Python "
            "algorithm=). Otherwise save it again with the installed packages, or load it yourself "
            "and pass the model."
        ) from error


def saved_sb3(model: Any) -> bytes:
    """The .zip of a model, with the name of its class for `load_sb3`."""
    setattr(model, _FIELD, f"{type(model).__module__}:{type(model).__qualname__}")
    archive = io.BytesIO()
    model.save(archive)
    return archive.getvalue()


def _algorithm_of(path: Path, fields: dict[str, Any]) -> str:
    """The class of a saved model, `module:class`."""
    recorded = fields.get(_FIELD)
    if isinstance(recorded, str) and ":" in recorded:
        return recorded
    policy_class = fields.get("policy_class")
    module = policy_class.get("__module__") if isinstance(policy_class, dict) else None
    name = _ALGORITHMS.get(str(module))
    if module == _ACTOR_CRITIC_POLICY:
        name = next((each for mark, each in _ACTOR_CRITICS.items() if mark in fields), None)
    if name is None:
        policy = f" (its policy is of {module})" if module else ""
        raise PolicyError(
            f"{path}: does not tell its algorithm{policy}. Give the algorithm's class, such as PPO "
            "or sb3_contrib:TQC (`sme evaluate --algorithm`, in Python algorithm=), or load it "
            "yourself and pass the model."
        )
    return name


def _full_name(algorithm: str) -> str:
    """`module:class` of an algorithm that the user named."""
    if ":" in algorithm:
        return algorithm
    if algorithm.upper() not in _NAMES:
        raise PolicyError(
            f"algorithm={algorithm!r:.80}: must be one of {', '.join(_NAMES)}, or module:Class "
            f"such as sb3_contrib:TQC.{did_you_mean(algorithm, _NAMES)}"
        )
    return f"stable_baselines3:{algorithm.upper()}"


def _import(name: str, path: Path) -> Any:
    package = name.partition(":")[0].partition(".")[0]
    if package in _PACKAGES and not is_installed(package):
        raise MissingDependencyError(
            f"loading {path}: it is a model of {name}, and {_PACKAGES[package]} is not installed. "
            f"Run `pip install {_PACKAGES[package]}`."
        )
    if package == "stable_baselines3":
        import stable_baselines3

        return getattr(stable_baselines3, name.rpartition(":")[2])
    model_class = import_object(name, "algorithm", PolicyError)
    if not hasattr(model_class, "load"):
        raise PolicyError(
            f"algorithm={name!r}: must be a class with a method `load`, like those of "
            "Stable-Baselines3."
        )
    return model_class


def _saved_fields(path: Path) -> dict[str, Any]:
    """A saved model's fields by name. Reads JSON only and runs no code."""
    if not path.is_file():
        raise PolicyError(f"{path} does not exist. Give the path of a saved model (.zip).")
    try:
        with zipfile.ZipFile(path) as archive:
            fields = json.loads(archive.read("data"))
    except (OSError, zipfile.BadZipFile, KeyError, ValueError):
        fields = None
    if not isinstance(fields, dict):
        raise PolicyError(
            f"{path}: not a model that Stable-Baselines3 saved. Give the .zip that `model.save` "
            "wrote, or in Python a callable."
        )
    return fields
