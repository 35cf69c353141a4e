"""Hyperparameters: as text, as JSON values, their check against an algorithm, and those we set.

    nested_hyperparameters({"policy_kwargs.net_arch": [64, 64]})   # --set, by dotted names
    check_hyperparameters("PPO", {"n_stepz": 64})                  # OptionError: … 'n_steps'?

The same for `sme train` and for studies. Importing this module does not import PyTorch.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sme_registry.datasets import offline
from sme_registry.errors import OptionError, did_you_mean
from sme_registry.io import import_object, read_json
from sme_registry.spec import StudyAlgorithm
from sme_registry.training.algorithms import find, is_sb3

# Arguments of an algorithm's constructor that are not hyperparameters.
_RESERVED = ("self", "policy", "env", "seed", "device", "verbose", "tensorboard_log")
# Arguments of a policy's constructor that the algorithm passes.
_PASSED = ("self", "observation_space", "action_space", "lr_schedule")
OF_DATA_SET = ("nu", "transitions", "batch_size")  # of `offline:…`, and not the learner's
_ROLLOUT, _MIN_ROLLOUT = 2048, 16  # SB3's default for PPO in one environment; ours at least


def nested_hyperparameters(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Hyperparameters whose dotted names are resolved: `policy_kwargs.net_arch` is in a dict.

    Examples:
      >>> from sme_registry.training import nested_hyperparameters
      >>> nested_hyperparameters({"policy_kwargs.net_arch": [64, 64], "gamma": 0.9})
      {'policy_kwargs': {'net_arch': [64, 64]}, 'gamma': 0.9}
    """
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        *parents, last = name.split(".")
        block: Any = nested
        for parent in parents:
            block = block.setdefault(parent, {}) if isinstance(block, dict) else None
        if not all((*parents, last)) or not isinstance(block, dict) or last in block:
            raise OptionError(
                f"hyperparameters.{name}: is not a name, or is set twice. Use one name for each "
                "value, such as policy_kwargs.net_arch."
            )
        block[last] = dict(value) if isinstance(value, Mapping) else value  # the caller's stays
    return nested


def read_hyperparameters(path: Path) -> dict[str, Any]:
    """The hyperparameters in a JSON file: an object of names and values.

    Examples:
      >>> from pathlib import Path
      >>> from sme_registry.training import read_hyperparameters
      >>> _ = Path("ppo.json").write_text('{"n_steps": 256}')
      >>> read_hyperparameters(Path("ppo.json"))
      {'n_steps': 256}
    """
    values = read_json(path)
    if not isinstance(values, dict):
        raise OptionError(
            f"{path}: must be an object of hyperparameters, such as "
            '{"learning_rate": 0.0001, "policy_kwargs": {"net_arch": [64, 64]}}.'
        )
    return nested_hyperparameters(values)


def check_hyperparameters(
    uses: str,
    hyperparameters: Mapping[str, Any],
    field: str = "hyperparameters",
    others: Iterable[str] = (),
) -> None:
    """Check that an algorithm has hyperparameters of these names; values only in JAX and offline.

    The names are those of the constructor, or of the function, and in `policy_kwargs` those of the
    policy's constructor.

    Error messages call them `field`, and may suggest one of `others`, which the caller accepts.

    Examples:
      >>> from sme_registry.training import check_hyperparameters
      >>> check_hyperparameters("PPO", {"learning_rate": 1e-4})
      >>> check_hyperparameters("PPO", {"learning_rat": 1e-4})
      Traceback (most recent call last):
      ...
      sme_registry.errors.OptionError: hyperparameters.learning_rat: PPO has no such ...
    """
    if not hyperparameters:
        return
    entry = find(uses)
    if entry.kind == "reference":
        raise OptionError(
            f"hyperparameters={sorted(hyperparameters)}: {uses} has no hyperparameters. Leave them "
            "out."
        )
    if entry.kind == "offline":
        own = {name: hyperparameters[name] for name in hyperparameters if name not in OF_DATA_SET}
        offline.check_algorithm(entry.name, own)
    elif entry.kind == "train":
        names = _names(entry.load(field), ("env", "steps", "seed"))
        _refuse_names(field, uses, hyperparameters, names, others)
    elif entry.kind == "jax":
        from sme_registry.jax.run import settings_of

        if others:  # where Stable-Baselines3 is needed anyway
            refuse_unknown(find(entry.name).load(), entry.name, hyperparameters, field, others)
        settings_of(uses, hyperparameters, field)
    else:
        refuse_unknown(entry.load(), uses, hyperparameters, field, others)


def check_algorithm(algorithm: StudyAlgorithm) -> None:
    """Check that an algorithm of a plan has hyperparameters of these names."""
    field = f"algorithm {algorithm.name!r}: hyperparameters"
    check_hyperparameters(algorithm.uses, algorithm.hyperparameters, field)


def refuse_unknown(
    algorithm: Any,
    uses: str,
    hyperparameters: Mapping[str, Any],
    field: str = "hyperparameters",
    others: Iterable[str] = (),
) -> None:
    """Raise OptionError if an algorithm's class or function has no hyperparameter of a name."""
    if not isinstance(algorithm, type) or not is_sb3(algorithm):
        environment = next(iter(inspect.signature(algorithm).parameters), "env")
        names = _names(algorithm, (environment, "seed"))
        _refuse_names(field, uses, hyperparameters, names, others)
        return
    _refuse_names(field, uses, hyperparameters, _names(algorithm, _RESERVED), others)
    policy_kwargs = hyperparameters.get("policy_kwargs")
    if isinstance(policy_kwargs, Mapping):
        names = _names(_policy_class(algorithm), _PASSED)
        _refuse_names(f"{field}.policy_kwargs", f"{uses}'s policy", policy_kwargs, names)


def resolved(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """JSON values for a constructor: tuples for lists, and the classes named in `policy_kwargs`."""
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in hyperparameters.items()}
    policy_kwargs = values.get("policy_kwargs")
    if isinstance(policy_kwargs, Mapping):
        values["policy_kwargs"] = {
            name: import_object(value, f"hyperparameters.policy_kwargs.{name}", OptionError)
            if isinstance(value, str) and ":" in value
            else value
            for name, value in policy_kwargs.items()
        }
    return values


def policy_alias(algorithm: Any) -> str:
    """SB3's name of an algorithm's perceptron policy: "MlpPolicy", or "MlpLstmPolicy"."""
    aliases: list[str] = ["MlpPolicy", *algorithm.policy_aliases]
    return next(a for a in aliases if a in algorithm.policy_aliases and a.startswith("Mlp"))


def _policy_class(algorithm: Any) -> Any:
    return algorithm.policy_aliases[policy_alias(algorithm)]


def for_lanes(algorithm: Any, lanes: int, chosen: Iterable[str] = ()) -> dict[str, int]:
    """The changes to SB3's defaults that keep an algorithm the same in several lanes at once.

    A lane is an environment, or one agent of a team. SB3's `n_steps` counts the steps of each: PPO
    in 8 would collect 16,384 transitions for one update, so the rollout of 2,048 is divided. And
    TD3 in 8 would learn an eighth as often, so it gets one update for each transition.

    On Team4, r̃ was 0.77 after 16,384 steps of PPO with SB3's defaults, and 0.85 divided.
    """
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    if not isinstance(algorithm, type):
        return {}
    if issubclass(algorithm, OnPolicyAlgorithm) and "n_steps" not in chosen:
        default = parameters_of(algorithm)["n_steps"].default
        n_steps = min(default, max(_MIN_ROLLOUT, _ROLLOUT // lanes))
        return {} if n_steps == default else {"n_steps": n_steps}
    if issubclass(algorithm, OffPolicyAlgorithm) and lanes > 1:
        return {} if {"gradient_steps", "train_freq"} & set(chosen) else {"gradient_steps": -1}
    return {}


def parameters_of(function: Any) -> dict[str, inspect.Parameter]:
    """The parameters of a function, or of a class's constructor."""
    if not isinstance(function, type):
        return dict(inspect.signature(function).parameters)
    parameters: dict[str, inspect.Parameter] = {}
    for owner in function.__mro__:
        if "__init__" not in vars(owner):
            continue
        own = {each.name: each for each in inspect.signature(owner).parameters.values()}
        parameters = {**own, **parameters}
        if not any(each.kind is each.VAR_KEYWORD for each in own.values()):
            passed_on = inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL
            return {name: p for name, p in parameters.items() if p.kind not in passed_on}
    return parameters


def _names(function: Any, reserved: Iterable[str]) -> list[str] | None:
    """The names of a function's arguments that a user may set; None if it accepts any."""
    parameters = parameters_of(function)
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return None
    return [name for name in parameters if name not in reserved and not name.startswith("_")]


def _refuse_names(
    field: str,
    owner: str,
    names: Iterable[str],
    known: list[str] | None,
    others: Iterable[str] = (),
) -> None:
    for name in names:
        if known is not None and name not in known:
            raise OptionError(
                f"{field}.{name}: {owner} has no such hyperparameter."
                f"{did_you_mean(name, [*known, *others])} Known: {', '.join(known) or 'none'}."
            )
