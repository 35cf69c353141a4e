"""`uses`: the name of what `sme train` and the cells of a study train. Imported only when needed.

    PPO, TD3, …        an algorithm of Stable-Baselines3, in any case
    PPOLagrangian, …   one of ours for tasks with `safety` (`WITH_LIMITS`), in any case
    jax:PPO, …         the same in JAX, with its environment in one program (`sme_registry.jax`)
    an entry point     of the group `sme_registry.algorithms`, in an installed package
    module:name        imported, from this folder or installed

An entry point or `module:name` is either a class like those of Stable-Baselines3
(`sb3_contrib:TQC`), or a function that returns a learner; see `learners`.

Also the settings they share here: one thread, no messages, a replay buffer of the size needed.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import io
import warnings
from collections.abc import Collection, Iterable, Iterator
from typing import Any

from sme_registry.envs.arguments import refuse_without_limits
from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.io import choice, import_object, require_packages
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.study import INDEPENDENT, JAX, in_jax

# Names of classes in `stable_baselines3` and, for tasks with `safety`, in `sme_registry.sb3`.
ALGORITHMS = {
    "TD3": "off-policy, deterministic; the fastest learner on the default task",
    "SAC": "off-policy, entropy-regularised",
    "DDPG": "off-policy, deterministic; the predecessor of TD3",
    "PPO": "on-policy; steps ten times faster, but learns from many more",
    "A2C": "on-policy",
    "PPOLagrangian": "PPO with a limit on the mean cost of a step, for tasks with safety",
    "PPOProjection": "PPO whose actions are cut at the limits, which it knows, for the same tasks",
}
WITH_LIMITS = ("PPOLagrangian", "PPOProjection")
ENTRY_POINTS = "sme_registry.algorithms"
_TEAMS = 8
_MAX_REPLAY = 1_000_000  # SB3's default


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


def is_on_policy(algorithm: Any) -> bool:
    """Whether this is an on-policy class of Stable-Baselines3, such as PPO."""
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    return isinstance(algorithm, type) and issubclass(algorithm, OnPolicyAlgorithm)


def check_limits(uses: str, document: SMESpec | StreamSpec) -> None:
    """Raise OptionError if an algorithm of `WITH_LIMITS` is to train on a task without `safety`."""
    spec = document if isinstance(document, SMESpec) else document.phases[0].spec
    for name in WITH_LIMITS:
        if uses.removeprefix(INDEPENDENT).casefold() == name.casefold():
            refuse_without_limits(name, spec)


AGENTS = ("sb3", "jax")
"""Whose implementation of an algorithm is trained: Stable-Baselines3's, or ours in JAX."""


def full_name(uses: str, agents: str | None = None) -> str:
    """The exact name of an algorithm in any case, also of `jax:…`; others' names unchanged.

    Args:
      uses: the name.
      agents: whose implementation, one of `AGENTS`; None for the one that the name says.

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


def known_algorithm(name: str, algorithms: Collection[str] = tuple(ALGORITHMS)) -> str:
    """The exact name of an algorithm, whose case does not matter.

    Examples:
      >>> from sme_registry.training import known_algorithm
      >>> known_algorithm("td3")
      'TD3'
    """
    for known in algorithms:
        if known.casefold() == str(name).casefold():
            return known
    raise UnknownNameError(
        f"algorithm={name!r}: must be one of {', '.join(algorithms)}."
        f"{did_you_mean(str(name), algorithms)}"
    )


def require_sb3() -> None:
    """Check that Stable-Baselines3 and PyTorch are installed; imports neither."""
    require_packages(
        "training", {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}, "train"
    )


def load_algorithm(name: str) -> Any:
    """The class of an algorithm of `ALGORITHMS`; see `require_sb3`."""
    # It imports the deprecated `gym` if that is installed, which prints a long notice.
    with contextlib.redirect_stderr(io.StringIO()), quiet():
        name = known_algorithm(name)
        module = "sme_registry.sb3" if name in WITH_LIMITS else "stable_baselines3"
        return getattr(importlib.import_module(module), name)


def find_algorithm(uses: str, field: str = "uses", others: Iterable[str] = ()) -> Any:
    """The class or function that `uses` names."""
    require_sb3()  # every learner gets their `VecEnv`
    if ":" in uses:
        with quiet():
            algorithm = import_object(uses, field, OptionError)
    elif uses.casefold() in (known.casefold() for known in ALGORITHMS):
        return load_algorithm(uses)
    else:
        algorithm = _entry_point(uses, field, others)
    if not callable(algorithm):
        raise OptionError(
            f"{field}={uses!r}: is of type {type(algorithm).__name__}: must be a class like those "
            "of Stable-Baselines3, or a function from an environment to a learner."
        )
    return algorithm


def _entry_point(name: str, field: str, others: Iterable[str]) -> Any:
    installed = {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    if name not in installed:
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
