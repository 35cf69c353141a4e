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
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.machinery
import importlib.metadata
import importlib.util
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sme_registry.datasets import record
from sme_registry.envs.arguments import check_has_limits
from sme_registry.errors import OptionError, SpecError, UnknownNameError, did_you_mean
from sme_registry.evaluation.references import POLICIES
from sme_registry.io import choice, import_object, require_packages
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.study import JAX, in_jax, parse_uses

ENTRY_POINTS = "sme_registry.algorithms"
AGENTS = ("sb3", "jax")  # whose implementation of an algorithm is trained
_TEAMS = 8
_MAX_REPLAY = 1_000_000  # SB3's default


@dataclass(frozen=True)
class Entry:
    """What a name in `uses` stands for; `place` is the module of a class that is ours or SB3's."""

    kind: str  # "sb3", also what others wrote for its environments; or a prefix without its colon
    name: str  # without the prefix
    about: str = ""
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
            if not self.place or self.kind == "independent":
                self._check_kind(self.load())

    def _check_kind(self, algorithm: Any) -> None:
        if self.kind == "independent" and not is_on_policy(algorithm):
            raise OptionError(
                f"uses='{self.prefix}{self.name}': must be an on-policy algorithm, such as "
                "independent:PPO, because the models of a team learn from the same rollouts. Use "
                f"one model for all agents instead: {self.name}."
            )

    def check_task(self, document: SMESpec | StreamSpec) -> None:
        """Check that it can learn a task or live in a stream, beyond what a plan itself says."""
        if self.needs_limits:
            spec = document if isinstance(document, SMESpec) else document.phases[0].spec
            check_has_limits(self.name, spec)
        if self.kind == "jax":
            _check_in_jax(document)


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
        *(Entry("sb3", name, text, "stable_baselines3") for name, text in _OF_SB3.items()),
        *(Entry("sb3", name, text, "sme_registry.sb3", True) for name, text in _OF_OURS.items()),
        *(Entry("jax", name) for name in ("PPO", "TD3", "SAC")),
        *(Entry("offline", name) for name in record.ALGORITHMS),
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
    found = [module for module in modules if _path_of(module)]
    return f"This plan runs the code of {', '.join(found)}." if found else ""


def _module_of(uses: str) -> str | None:
    """The module that a name in `uses` names."""
    kind, name = parse_uses(uses)
    kind, name = parse_uses(name) if kind == "independent" else (kind, name)
    return name.partition(":")[0] if kind in ("sb3", "train") and ":" in name else None


def source_of(uses: str, field: str = "uses") -> str | None:
    """The digest of the module's source of `train:module:function`, which is not imported."""
    kind, name = parse_uses(uses)
    return _source(name, field)[1] if kind == "train" else None


def load_function(name: str, field: str = "uses") -> tuple[Callable[..., Any], str]:
    """The function `module:function` of the source that is there now, and the source's digest.

    The source is run again where it has changed since, so what runs is what the digest says.
    """
    module_name, _, attribute = name.partition(":")
    with working_directory_importable():
        path, digest, source = _source(name, field)
        module = sys.modules.get(module_name)
        try:
            if module is None or _loaded.get(module_name) != digest:
                importlib.import_module(module_name.rpartition(".")[0] or "sys")
                spec = importlib.util.spec_from_file_location(module_name, path)
                module = module or importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
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


_loaded: dict[str, str] = {}  # the digest of the source that a module has run


def _source(name: str, field: str) -> tuple[str, str, bytes]:
    """The path, the digest and the bytes of a module's source. Imports nothing."""
    module = name.partition(":")[0]
    path = _path_of(module)
    if not path or not path.endswith(".py"):
        raise OptionError(
            f"{field}='train:{name}': there is no Python module {module!r}. It must be "
            "train:module:function, with the module in the working directory or installed."
        )
    source = Path(path).read_bytes()
    return path, f"sha256:{hashlib.sha256(source).hexdigest()}", source


def _path_of(module: str) -> str | None:
    """The file of a module or a package; None if there is none. Imports nothing."""
    places: Any = None
    found: Any = None
    with working_directory_importable():
        for end in (i for i, letter in enumerate(f"{module}.") if letter == "."):
            found = importlib.machinery.PathFinder.find_spec(module[:end], places)
            if found is None:
                return None
            places = found.submodule_search_locations
    path: str | None = found.origin
    return path


@contextlib.contextmanager
def working_directory_importable() -> Iterator[None]:
    """Modules in the working directory can be imported inside the block."""
    folder = os.getcwd()
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path.remove(folder)


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
    single = isinstance(document, StreamSpec) or document.team is None
    return "TD3" if single else "PPO"


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
