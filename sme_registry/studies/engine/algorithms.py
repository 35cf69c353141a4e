"""`uses`: the name of what a study's cell trains.

    PPO, TD3, …             an algorithm of Stable-Baselines3, in any case
    an entry point          of the group `sme_registry.algorithms`, in an installed package
    module:function         imported, from this folder or installed
    reference:constant, …   a policy that learns nothing

An entry point or `module:function` names either a class like those of Stable-Baselines3
(`sb3_contrib:TQC`), or a function that returns a learner:

    def make(env: VecEnv, *, seed: int, **hyperparameters) -> Learner

`env` is a `VecEnv` of one environment. The cell counts its steps and evaluates the learner through
`predict` whenever an evaluation is due, so a learner needs no callbacks.
"""

from __future__ import annotations

import importlib.metadata
import inspect
from collections.abc import Collection, Mapping
from typing import Any, Protocol

from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.evaluation.references import POLICIES
from sme_registry.io import import_object
from sme_registry.training import ALGORITHMS
from sme_registry.training.algorithms import (
    is_sb3,
    load_algorithm,
    replay_settings,
    require_sb3,
    silence,
)

ENTRY_POINTS = "sme_registry.algorithms"
REFERENCE = "reference:"
# Set by the cell; not hyperparameters.
_RESERVED = ("self", "policy", "env", "seed", "device", "verbose", "tensorboard_log")


class Learner(Protocol):
    """What a cell trains, such as a model of Stable-Baselines3."""

    def learn(self, total_timesteps: int) -> Any:
        """Learn from at least this many steps of the environment."""

    def predict(self, observation: Any, *, deterministic: bool) -> Any:
        """Actions `[B, A]` in the range of `env.action_space`, or a tuple that begins with them.

        Args:
          observation: `[B, S + 2]` float32.
          deterministic: always True.
        """


def reference_name(uses: str) -> str | None:
    """The policy that `reference:…` names, as `named_after` reads it."""
    return named_after(REFERENCE, uses, POLICIES)


def named_after(prefix: str, uses: str, known: Collection[str]) -> str | None:
    """The name after a prefix; None if `uses` does not begin with it.

    Raises:
      UnknownNameError: the name is unknown; the message lists the known ones.
    """
    if not uses.startswith(prefix):
        return None
    name = uses.removeprefix(prefix)
    if name not in known:
        raise UnknownNameError(
            f"uses={uses!r}: must be one of {', '.join(prefix + each for each in known)}."
            f"{did_you_mean(name, known)}"
        )
    return name


def find_algorithm(uses: str) -> Any:
    """The class or function that creates a learner, which is no reference.

    Raises:
      UnknownNameError: nothing has this name; the message suggests similar ones.
      OptionError: a module or entry point cannot be imported or called.
      MissingDependencyError: Stable-Baselines3 or PyTorch is not installed.
    """
    require_sb3()  # every learner gets their `VecEnv`
    if ":" in uses:
        algorithm = import_object(uses, "uses", OptionError)
    elif uses.casefold() in (known.casefold() for known in ALGORITHMS):
        return load_algorithm(uses)
    else:
        algorithm = _entry_point(uses)
    if not callable(algorithm):
        raise OptionError(
            f"uses={uses!r}: is of type {type(algorithm).__name__}: must be a class like those of "
            "Stable-Baselines3, or a function from an environment to a learner."
        )
    return algorithm


def new_learner(
    uses: str, env: Any, *, seed: int, steps: int, hyperparameters: Mapping[str, Any]
) -> Learner:
    """Create a learner.

    Args:
      uses: its name.
      env: the SB3 `VecEnv` of one environment in which it learns.
      seed: of its random numbers.
      steps: of training.
      hyperparameters: those that differ from its defaults. Lists become tuples, which JSON lacks
        (`"train_freq": [1, "episode"]`).

    Raises:
      UnknownNameError, OptionError, MissingDependencyError: see `find_algorithm`; or it does
        not accept the hyperparameters, or returns something that is not a learner.
    """
    algorithm = find_algorithm(uses)
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in hyperparameters.items()}
    if isinstance(algorithm, type) and is_sb3(algorithm):
        _refuse_unknown(uses, algorithm, settings)
        settings = {**replay_settings(algorithm, steps + env.num_envs), **settings}
        try:
            learner = algorithm("MlpPolicy", env, seed=seed, device="cpu", **settings)
        except (AssertionError, TypeError, ValueError) as error:
            raise OptionError(
                f"uses={uses!r}: rejects the task or the hyperparameters "
                f"{sorted(hyperparameters)}: {error}. Change them, or create the learner in a "
                "function and give module:function."
            ) from error
    else:
        try:
            inspect.signature(algorithm).bind(env, seed=seed, **settings)
        except TypeError as error:
            raise OptionError(
                f"uses={uses!r}: cannot be called with an environment, seed= and the "
                f"hyperparameters {sorted(settings)}: {error}. Give only those that it accepts."
            ) from None
        learner = algorithm(env, seed=seed, **settings)
    missing = [name for name in ("learn", "predict") if not hasattr(learner, name)]
    if missing:
        raise OptionError(
            f"uses={uses!r}: returned a {type(learner).__name__}, which has no "
            f"{' and no '.join(missing)}. Return a learner like those of Stable-Baselines3."
        )
    if is_sb3(learner):
        silence(learner)
    return learner  # type: ignore[no-any-return]


def _entry_point(name: str) -> Any:
    installed = {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    if name not in installed:
        known = [*ALGORITHMS, *sorted(installed), *(REFERENCE + policy for policy in POLICIES)]
        raise UnknownNameError(
            f"uses={name!r}: must be one of {', '.join(known)}; or module:function."
            f"{did_you_mean(name, known)}"
        )
    point = installed[name]
    try:
        return point.load()
    except Exception as error:
        raise OptionError(
            f"uses={name!r}: the entry point {point.value!r} cannot be imported: "
            f"{type(error).__name__}: {error}. Repair or remove the package that provides it."
        ) from error


def _refuse_unknown(uses: str, algorithm: type, settings: Mapping[str, Any]) -> None:
    parameters = inspect.signature(algorithm).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    known = [name for name in parameters if name not in _RESERVED and not name.startswith("_")]
    for name in settings:
        if name not in known:
            raise OptionError(
                f"hyperparameters={name!r}: {uses} has no such hyperparameter."
                f"{did_you_mean(name, known)} Known: {', '.join(known)}."
            )
