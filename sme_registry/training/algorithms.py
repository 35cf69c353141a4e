"""`LEARNERS`: what the names in `uses` stand for, in `sme train` and in the cells of a study.

    PPO, TD3, …            an algorithm of Stable-Baselines3, in any case, or one of ours for tasks
                           with `safety`; the agents of a team share one model
    independent:PPO        the same with one model for each agent of a team
    jax:PPO, …             the same in JAX, with its environment in one program
    offline:bc, …          learns from a data set
    reference:linear, …    a reference policy, which learns nothing
    train:module:name      a function of any framework, `train(env, steps, seed) -> policy`
    an entry point         of the group `sme_registry.algorithms`, in an installed package
    module:name            imported, from this folder or installed

An entry point or `module:name` is either a class like those of Stable-Baselines3
(`sb3_contrib:TQC`), or a function that returns a model; see `models`. Of `train:…` see
`functions`.

Hyperparameters are JSON values. Importing this module does not import PyTorch.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.machinery
import importlib.metadata
import importlib.util
import inspect
import io
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sme_registry.datasets import documents
from sme_registry.envs.arguments import check_has_limits
from sme_registry.errors import OptionError, SpecError, UnknownNameError, did_you_mean
from sme_registry.evaluation.references import POLICIES
from sme_registry.io import choice, import_object, read_json, require_packages
from sme_registry.spec import SMESpec, StreamSpec, StudyAlgorithm
from sme_registry.spec.study import JAX, in_jax, parse_uses
from sme_registry.training.functions import load_function, path_of

ENTRY_POINTS = "sme_registry.algorithms"
AGENTS = ("sb3", "jax")  # whose implementation of an algorithm is trained
_TEAMS = 8
_MAX_REPLAY = 1_000_000  # SB3's default


@dataclass(frozen=True)
class Entry:
    """What a name in `uses` stands for; `place` is the module of a class that is ours or SB3's."""

    kind: str  # "sb3", also what others wrote for its environments; or a prefix without its colon
    name: str  # without the prefix
    place: str = ""
    needs_limits: bool = False

    @property
    def prefix(self) -> str:
        """Of the name in `uses`."""
        return "" if self.kind == "sb3" else f"{self.kind}:"

    def load(self, field: str = "uses") -> Any:
        """The class or function that makes a model."""
        if self.kind == "train":
            return load_function(self.name, field)[0]
        if self.kind not in ("sb3", "independent"):
            raise OptionError(
                f"{field}='{self.prefix}{self.name}': is no algorithm of Stable-Baselines3's kind. "
                "Use it in a study."
            )
        require_sb3()  # every model gets its `VecEnv`
        if self.place:
            # It imports the deprecated `gym` if that is installed, which prints a long notice.
            with contextlib.redirect_stderr(io.StringIO()), quiet():
                return getattr(importlib.import_module(self.place), self.name)
        if ":" in self.name:
            with quiet():
                algorithm = import_object(self.name, field, OptionError)
        else:
            algorithm = _entry_point(self.name, field)
        if not callable(algorithm):
            raise OptionError(
                f"{field}={self.name!r}: is of type {type(algorithm).__name__}: must be a class "
                "like those of Stable-Baselines3, or a function from an environment to a learner."
            )
        return algorithm

    def check_installed(self) -> None:
        """Check that what learns is installed here, where that can be told in little time."""
        if self.kind == "jax":
            importlib.import_module("sme_registry.jax")  # raises where JAX is missing
        elif self.kind == "train":
            self.load()
        elif self.kind in ("sb3", "independent"):
            require_sb3()
            algorithm = None if self.place and self.kind == "sb3" else self.load()
            if self.kind != "independent" or is_on_policy(algorithm):
                return
            raise OptionError(
                f"uses='{self.prefix}{self.name}': must be an on-policy algorithm, such as "
                "independent:PPO, because the models of a team learn from the same rollouts. Use "
                f"one model for all agents instead: {self.name}."
            )

    def check_task(self, document: SMESpec | StreamSpec) -> None:
        """Check that it can learn a task or live in a stream, beyond what a plan itself says."""
        if self.needs_limits:
            check_has_limits(self.name, document.specs[0])
        if self.kind == "jax":
            _check_in_jax(document)
        if self.kind == "train" and (isinstance(document, StreamSpec) or document.team):
            raise SpecError(
                f"train:{self.name}: is for a task of a single agent, and this is a "
                f"{'team' if document.specs[0].team else 'stream'}. Train an algorithm "
                "of Stable-Baselines3, such as PPO."
            )


_OF_SB3 = {
    "TD3": "off-policy, deterministic; the fastest learner on the default task",
    "SAC": "off-policy, entropy-regularised",
    "DDPG": "off-policy, deterministic; the predecessor of TD3",
    "PPO": "on-policy; steps ten times faster, but learns from many more",
    "A2C": "on-policy",
}
_OF_OURS = {
    "PPOLagrangian": "PPO with a limit on the mean cost of a step, for tasks with safety",
    "PPOProjection": "PPO whose actions are cut at the limits, which it knows, for the same tasks",
}
ALGORITHMS = _OF_SB3 | _OF_OURS
"""Names and descriptions of the algorithms that `sme train` knows by name."""

LEARNERS: dict[str, Entry] = {
    entry.prefix + entry.name: entry
    for entry in (
        *(Entry("sb3", name, "stable_baselines3") for name in _OF_SB3),
        *(Entry("sb3", name, "sme_registry.sb3", needs_limits=True) for name in _OF_OURS),
        *(Entry("jax", name) for name in ("PPO", "TD3", "SAC")),
        *(Entry("offline", name) for name in documents.ALGORITHMS),
        *(Entry("reference", name) for name in POLICIES),
    )
}


def find(uses: str, field: str = "uses") -> Entry:
    """The entry of a name, in any case. A name of no table may be an entry point: see `load`."""
    kind, name = parse_uses(uses)
    if kind == "train":
        return Entry(kind, name)
    if kind == "independent":
        return replace(find(name, field), kind=kind)
    same_kind = {known: entry for known, entry in LEARNERS.items() if entry.kind == kind}
    for known, entry in same_kind.items():
        if known.casefold() == uses.casefold():
            return entry
    if kind != "sb3":
        hint = " Other algorithms run without JAX." if kind == "jax" else ""
        raise UnknownNameError(
            f"{field}={uses!r}: must be one of {', '.join(same_kind)}.{hint}"
            f"{did_you_mean(name, [entry.name for entry in same_kind.values()])}"
        )
    return Entry("sb3", name)


def code_notice(uses: Iterable[str]) -> str:
    """Whose code runs to find these algorithms; empty where they name no modules that are here."""
    modules = dict.fromkeys(filter(None, map(_module_of, uses)))
    found = [module for module in modules if path_of(module)]
    return f"This plan runs the code of {', '.join(found)}." if found else ""


def _module_of(uses: str) -> str | None:
    """The module that a name in `uses` names."""
    kind, name = parse_uses(uses)
    kind, name = parse_uses(name) if kind == "independent" else (kind, name)
    return name.partition(":")[0] if kind in ("sb3", "train") and ":" in name else None


def _check_in_jax(document: SMESpec | StreamSpec) -> None:
    """Raise SpecError where JAX does not have a field, or agents in it cannot live in a stream."""
    from sme_registry.jax.lives import check_switches
    from sme_registry.jax.task import check_supported

    if isinstance(document, SMESpec):
        check_supported(document)
        return
    for index, phase in enumerate(document.phases):
        try:
            check_supported(phase.spec)
        except SpecError as error:
            raise SpecError(f"phases.{index}.spec: {error}") from None
    check_switches(document)


def default_algorithm(document: SMESpec | StreamSpec) -> str:
    """The algorithm used by default: TD3, and PPO for a team.

    Examples:
      >>> from sme_registry.training import default_algorithm
      >>> default_algorithm(sme_registry.load("Team4"))
      'PPO'
    """
    return "TD3" if document.specs[0].team is None else "PPO"


def default_num_envs(spec: SMESpec, algorithm: Any) -> int:
    """The default number of parallel environments: 8 for a team and an on-policy class, or 1."""
    return _TEAMS if spec.team is not None and is_on_policy(algorithm) else 1


def full_name(uses: str, agents: str | None = None) -> str:
    """The exact name of an algorithm in any case, also of `jax:…`; others' names unchanged.

    `agents` is whose implementation, "sb3" or "jax"; None for the one that the name says.

    Examples:
      >>> from sme_registry.training import full_name
      >>> full_name("ppo", agents="jax")
      'jax:PPO'
    """
    ours = in_jax(uses.casefold())
    plain = uses[len(JAX) :] if ours else uses
    if agents is not None:
        if choice("agents", agents, AGENTS) == "sb3" and ours:
            raise OptionError(
                f"agents='sb3': must be left out for {uses!r}, which is in JAX. Leave it out, or "
                f"train {plain!r}."
            )
        ours = agents == "jax"
    name = next((name for name in ALGORITHMS if name.casefold() == plain.casefold()), plain)
    return f"{JAX}{name}" if ours else name


def short_name(uses: str) -> str:
    """What figures and reports call an algorithm: `TQC` for `sb3_contrib:TQC`.

    Examples:
      >>> from sme_registry.training import short_name
      >>> short_name("sb3_contrib:TQC")
      'TQC'
    """
    return uses.rpartition(":")[2]


def folder_name(uses: str) -> str:
    """What default folders call an algorithm: its short name, and `jax-PPO` for `jax:PPO`.

    Examples:
      >>> from sme_registry.training import folder_name
      >>> folder_name("jax:PPO")
      'jax-PPO'
    """
    return f"{'jax-' * in_jax(uses)}{short_name(uses)}"


def require_sb3() -> None:
    """Check that Stable-Baselines3 and PyTorch are installed; imports neither."""
    require_packages(
        "training", {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}, "train"
    )


def _entry_point(name: str, field: str) -> Any:
    installed = {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    if name not in installed:
        others = [known for known in LEARNERS if known not in ALGORITHMS]
        known = [*ALGORITHMS, *sorted(installed), *others]
        raise UnknownNameError(
            f"{field}={name!r}: must be one of {', '.join(known)}; or module:Class or "
            f"module:function, such as sb3_contrib:TQC.{did_you_mean(name, known)}"
        )
    point = installed[name]
    try:
        return point.load()
    except Exception as error:
        raise OptionError(
            f"{field}={name!r}: the entry point {point.value!r} cannot be imported: "
            f"{type(error).__name__}: {error}. Repair or remove the package that provides it."
        ) from error


def is_on_policy(algorithm: Any) -> bool:
    """Whether this is an on-policy class of Stable-Baselines3, such as PPO."""
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    return isinstance(algorithm, type) and issubclass(algorithm, OnPolicyAlgorithm)


def is_sb3(algorithm: Any) -> bool:
    """Whether this is a subclass of Stable-Baselines3's base class, or an instance of one."""
    from stable_baselines3.common.base_class import BaseAlgorithm

    return issubclass(algorithm if isinstance(algorithm, type) else type(algorithm), BaseAlgorithm)


def replay_settings(algorithm: Any, transitions: int) -> dict[str, int]:
    """The size of an off-policy algorithm's replay buffer; empty for an on-policy algorithm."""
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    if not issubclass(algorithm, OffPolicyAlgorithm):
        return {}
    return {"buffer_size": min(_MAX_REPLAY, transitions)}


def silence(model: Any) -> None:
    """Disable the logger of an SB3 model; by default it creates a temporary folder."""
    from stable_baselines3.common.logger import Logger

    model.set_logger(Logger(None, []))


def quiet() -> contextlib.AbstractContextManager[Any]:
    """Hide warnings of libraries, which address their developers and not our users."""
    return warnings.catch_warnings(action="ignore")


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run PyTorch on one thread; the previous number is restored afterwards."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
        documents.check_algorithm(entry.name, own)
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
