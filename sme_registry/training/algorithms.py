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
(`sb3_contrib:TQC`), or a function that returns a model; see `models`. Of `train:…` see `learn`.

Hyperparameters are JSON values. Importing this module does not import PyTorch.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import importlib.util
import inspect
import io
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from sme_registry.datasets import documents
from sme_registry.envs.arguments import check_has_limits
from sme_registry.errors import OptionError, SpecError, UnknownNameError, did_you_mean
from sme_registry.evaluation.references import POLICIES
from sme_registry.io import choice, import_object, read_json, require_packages
from sme_registry.io.system import module_file, working_directory_importable
from sme_registry.spec import SMESpec, StreamSpec, StudyAlgorithm
from sme_registry.spec.study import JAX, in_jax, parse_uses

ENTRY_POINTS = "sme_registry.algorithms"
AGENTS = "sb3", "jax"  # whose implementation of an algorithm is trained
# Arguments of an algorithm's constructor that are not hyperparameters.
_RESERVED = ("self", "policy", "env", "seed", "device", "verbose", "tensorboard_log")
# Arguments of a policy's constructor that the algorithm passes.
_PASSED = ("self", "observation_space", "action_space", "lr_schedule")
_OF_DATA_SET = ("nu", "transitions", "batch_size")  # of `offline:…`, and not the learner's


@dataclass(frozen=True)
class Entry:
    """What a name in `uses` stands for; `place` is the module of a class that is ours or SB3's."""

    kind: str  # "sb3", also what others wrote for its environments; or a prefix without its colon
    name: str  # without the prefix
    place: str = ""
    needs_limits: bool = False

    @property
    def uses(self) -> str:
        return self.name if self.kind == "sb3" else f"{self.kind}:{self.name}"

    def load(self, field: str = "uses") -> Any:
        if self.kind == "train":
            return load_function(self.name, field)[0]
        if self.kind not in ("sb3", "independent"):
            raise OptionError(
                f"{field}={self.uses!r}: is no algorithm of Stable-Baselines3's kind. Use it in a "
                "study."
            )
        require_sb3()  # every model gets its `VecEnv`
        if self.place:
            # It imports the deprecated `gym` if that is installed, which prints a long notice.
            with contextlib.redirect_stderr(io.StringIO()), quiet():
                return import_object(f"{self.place}:{self.name}", field, OptionError)
        with quiet():
            if ":" not in self.name:
                return _entry_point(self.name, field)
            algorithm = import_object(self.name, field, OptionError)
        if not callable(algorithm):
            raise OptionError(
                f"{field}={self.name!r}: is of type {type(algorithm).__name__}: must be a class "
                "like those of Stable-Baselines3, or a function from an environment to a learner."
            )
        return algorithm

    def check_installed(self) -> None:
        """Check that what learns is installed here, where that can be told in little time."""
        if self.kind == "jax":
            jax_package()
        elif self.kind == "sb3" and self.place:
            require_sb3()
        elif self.kind in ("sb3", "train"):
            self.load()
        elif self.kind == "independent" and not is_on_policy(self.load()):
            raise OptionError(
                f"uses={self.uses!r}: must be an on-policy algorithm, such as independent:PPO, "
                "because the models of a team learn from the same rollouts. Use one model for all "
                f"agents instead: {self.name}."
            )

    def check_task(self, document: SMESpec | StreamSpec) -> None:
        """Check that it can learn a task or live in a stream, beyond what a plan itself says."""
        if self.needs_limits:
            check_has_limits(self.name, document.specs[0])
        if self.kind == "jax":
            jax_package().task.check_supported(document)
        if self.kind == "train" and (isinstance(document, StreamSpec) or document.team):
            raise SpecError(
                f"{self.uses}: is for a task of a single agent, and this is a "
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
    entry.uses: entry
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


def default_algorithm(document: SMESpec | StreamSpec) -> str:
    """The algorithm used by default: TD3, and PPO for a team."""
    return "TD3" if document.specs[0].team is None else "PPO"


def full_name(uses: str, agents: str | None = None) -> str:
    """The exact name of an algorithm in any case, of `agents`: "sb3", "jax", or as it says."""
    if agents is not None and choice("agents", agents, AGENTS) == "sb3" and in_jax(uses):
        raise OptionError(
            f"agents='sb3': must be left out for {uses!r}, which is in JAX. Leave it out, or train "
            f"{parse_uses(uses)[1]!r}."
        )
    return find(f"{JAX}{parse_uses(uses)[1]}" if agents == "jax" else uses, "algorithm").uses


def short_name(uses: str) -> str:
    """What figures and reports call an algorithm: `TQC` for `sb3_contrib:TQC`."""
    return uses.rpartition(":")[2]


def folder_name(uses: str) -> str:
    """What default folders call an algorithm: its short name, and `jax-PPO` for `jax:PPO`."""
    return f"{'jax-' * in_jax(uses)}{short_name(uses)}"


def code_notice(uses: Iterable[str]) -> str:
    """Whose code runs to find these algorithms; empty where they name no modules that are here."""
    names = (parse_uses(name.removeprefix("independent:")) for name in uses)
    named = [name for kind, name in names if kind in ("sb3", "train") and ":" in name]
    modules = dict.fromkeys(name.partition(":")[0] for name in named)
    here = [module for module in modules if module_file(module)]
    return f"This plan runs the code of {', '.join(here)}." if here else ""


def _entry_point(name: str, field: str) -> Any:
    installed = {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    if name not in installed:
        known = [*LEARNERS, *sorted(installed)]
        raise UnknownNameError(
            f"{field}={name!r}: must be one of {', '.join(known)}; or module:Class or "
            f"module:function, such as sb3_contrib:TQC.{did_you_mean(name, known)}"
        )
    return import_object(installed[name].value, f"{field}={name!r}: entry point", OptionError)


_loaded: dict[str, str] = {}  # the digest of the source that a module has run


def source_of(uses: str, field: str = "uses") -> str | None:
    """The digest of the source of `train:module:name`, which is not imported; None of any other."""
    kind, name = parse_uses(uses)
    return _source(name, field)[1] if kind == "train" else None


def load_function(name: str, field: str = "uses") -> tuple[Callable[..., Any], str]:
    """The function `module:function` of the present source, and the source's digest.

    The source is run again where it has changed, so what runs is what the digest says.
    """
    module_name, _, attribute = name.partition(":")
    with working_directory_importable():
        path, digest, source = _source(name, field)
        module = sys.modules.get(module_name)
        try:
            if module is None or _loaded.get(module_name) != digest:
                if module is None:
                    spec: Any = importlib.util.find_spec(module_name)
                    module = importlib.util.module_from_spec(spec)
                sys.modules[module_name] = module
                exec(compile(source, path, "exec"), vars(module))
                _loaded[module_name] = digest
        except Exception as error:
            sys.modules.pop(module_name, None)
            raise OptionError(
                f"{field}='train:{name}': {module_name} cannot be imported: "
                f"{type(error).__name__}: {error}. Correct it."
            ) from error
    function = getattr(module, attribute, None)
    if not callable(function):
        functions = [known for known, value in vars(module).items() if callable(value)]
        raise OptionError(
            f"{field}='train:{name}': {path} has no function {attribute!r}."
            f"{did_you_mean(attribute, functions)} Define {attribute}(env, steps, seed), which "
            "returns a policy."
        )
    return function, digest


def _source(name: str, field: str) -> tuple[str, str, bytes]:
    """The path, the digest and the bytes of a module's source, which is not imported."""
    module = name.partition(":")[0]
    path = module_file(module)
    if not path or not path.endswith(".py"):
        raise OptionError(
            f"{field}='train:{name}': there is no Python module {module!r}. It must be "
            "train:module:function, with the module in the working directory or installed."
        )
    source = Path(path).read_bytes()
    return path, f"sha256:{hashlib.sha256(source).hexdigest()}", source


def require_sb3() -> None:
    """Check that Stable-Baselines3 and PyTorch are installed; imports neither."""
    require_packages(
        "training", {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}, "train"
    )


def jax_package() -> ModuleType:
    """Our package of agents in JAX, with its modules; raises where JAX is missing."""
    import sme_registry.jax.run

    return sme_registry.jax


def is_on_policy(algorithm: Any) -> bool:
    """Whether this is an on-policy class of Stable-Baselines3, such as PPO."""
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    return isinstance(algorithm, type) and issubclass(algorithm, OnPolicyAlgorithm)


def is_sb3(algorithm: Any) -> bool:
    """Whether this is a class of Stable-Baselines3's kind, or a model of one."""
    from stable_baselines3.common.base_class import BaseAlgorithm

    return issubclass(algorithm if isinstance(algorithm, type) else type(algorithm), BaseAlgorithm)


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


def default_num_envs(spec: SMESpec, algorithm: Any) -> int:
    return 8 if spec.team is not None and is_on_policy(algorithm) else 1


def nested_hyperparameters(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Hyperparameters whose dotted names are resolved: `policy_kwargs.net_arch` is in a dict."""
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

    Names are those of the constructor or function, and in `policy_kwargs` those of the policy's
    constructor. Messages call them `field`, and may suggest one of `others`, which the caller has.
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
        of_learner = {n: v for n, v in hyperparameters.items() if n not in _OF_DATA_SET}
        documents.check_algorithm(entry.name, of_learner)
    elif entry.kind == "jax":
        if others:  # where Stable-Baselines3 is needed anyway
            check_names(find(entry.name).load(), entry.name, hyperparameters, field, others)
        jax_package().run.settings_of(uses, hyperparameters, field)
    else:
        check_names(entry.load(field), uses, hyperparameters, field, others)


def check_algorithm(algorithm: StudyAlgorithm) -> None:
    field = f"algorithm {algorithm.name!r}: hyperparameters"
    check_hyperparameters(algorithm.uses, algorithm.hyperparameters, field)


def check_names(
    algorithm: Any,
    uses: str,
    hyperparameters: Mapping[str, Any],
    field: str = "hyperparameters",
    others: Iterable[str] = (),
) -> None:
    """Raise OptionError if an algorithm's class or function has no hyperparameter of a name."""
    of_train = parse_uses(uses)[0] == "train"
    of_sb3 = not of_train and isinstance(algorithm, type) and is_sb3(algorithm)
    first = next(iter(inspect.signature(algorithm).parameters), "env")
    passed = (first, "seed", "steps") if of_train else (first, "seed")
    _check_names(field, uses, hyperparameters, algorithm, _RESERVED if of_sb3 else passed, others)
    in_policy = hyperparameters.get("policy_kwargs")
    if of_sb3 and isinstance(in_policy, Mapping):
        policy: Any = cast(Any, algorithm).policy_aliases[policy_alias(algorithm)]
        _check_names(f"{field}.policy_kwargs", f"{uses}'s policy", in_policy, policy, _PASSED)


def _check_names(
    field: str,
    owner: str,
    names: Iterable[str],
    function: Any,
    reserved: Iterable[str],
    others: Iterable[str] = (),
) -> None:
    parameters = parameters_of(function)
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    known = [name for name in parameters if name not in reserved and not name.startswith("_")]
    for name in names:
        if name not in known:
            raise OptionError(
                f"{field}.{name}: {owner} has no such hyperparameter."
                f"{did_you_mean(name, [*known, *others])} Known: {', '.join(known) or 'none'}."
            )


def policy_alias(algorithm: Any) -> str:
    """SB3's name of an algorithm's perceptron policy: "MlpPolicy", or "MlpLstmPolicy"."""
    aliases: list[str] = ["MlpPolicy", *algorithm.policy_aliases]
    return next(a for a in aliases if a in algorithm.policy_aliases and a.startswith("Mlp"))


def parameters_of(function: Any) -> dict[str, inspect.Parameter]:
    """The parameters of a function, or of a class's constructor and those that it passes on to."""
    if not isinstance(function, type):
        return dict(inspect.signature(function).parameters)
    parameters: dict[str, inspect.Parameter] = {}
    for owner in function.__mro__:
        if "__init__" not in vars(owner):
            continue
        own = inspect.signature(owner).parameters
        parameters = {**own, **parameters}
        if not any(each.kind is each.VAR_KEYWORD for each in own.values()):
            passed_on = inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL
            return {name: p for name, p in parameters.items() if p.kind not in passed_on}
    return parameters
