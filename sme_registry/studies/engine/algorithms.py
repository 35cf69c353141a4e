"""`uses`: what is trained in a study's cell, found by name.

    PPO, TD3, …             of Stable-Baselines3, in any case
    an entry point          of the group `sme_registry.algorithms`, of an installed package
    module:function         imported; the module is looked for in this folder, too
    reference:constant, …   a policy that learns nothing

What an entry point or `module:function` names is either a class of Stable-Baselines3's kind, as it
is (`sb3_contrib:TQC`), or a function that makes a learner:

    def make(env: VecEnv, *, seed: int, **hyperparameters) -> Learner

`env` is a `VecEnv` of one environment, whose every step counts: the cell evaluates the learner
after as many of them as are due, by its `predict`. So a learner has nothing to call back.
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
    refuse_without_dependencies,
    replay_settings,
    silence,
)

ENTRY_POINTS = "sme_registry.algorithms"
REFERENCE = "reference:"
# The cell's own business, and no hyperparameters.
_RESERVED = ("self", "policy", "env", "seed", "device", "verbose", "tensorboard_log")


class Learner(Protocol):
    """What a cell trains; a model of Stable-Baselines3 is one."""

    def learn(self, total_timesteps: int) -> Any:
        """Step the environment at least this often, and learn from it."""

    def predict(self, observation: Any, *, deterministic: bool) -> Any:
        """Actions `[B, A]` in the range of `env.action_space`, or a tuple that begins with them.

        Args:
          observation: `[B, S + 2]` float32.
          deterministic: always True.
        """


def reference_name(uses: str) -> str | None:
    """Which policy a `reference:…` names; None for what learns.

    Raises:
      UnknownNameError: no such reference.
    """
    return named_after(REFERENCE, uses, POLICIES)


def named_after(prefix: str, uses: str, known: Collection[str]) -> str | None:
    """The name that follows a prefix; None where `uses` does not begin with it.

    Raises:
      UnknownNameError: the name is not known; says which are, and what is near.
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
    """The class or function that makes a learner.

    Args:
      uses: a name of one of the kinds above, other than a reference.

    Raises:
      UnknownNameError: nothing has this name; says what is near.
      OptionError: a module or entry point cannot be imported, or is nothing that makes a learner.
      MissingDependencyError: Stable-Baselines3 or PyTorch is not installed.
    """
    refuse_without_dependencies()  # whose `VecEnv` every learner is given
    if ":" in uses:
        found = import_object(uses, "uses", OptionError)
    elif uses.casefold() in (known.casefold() for known in ALGORITHMS):
        return load_algorithm(uses)
    else:
        found = _entry_point(uses)
    if not callable(found):
        raise OptionError(
            f"uses={uses!r}: is a {type(found).__name__}: must be a class of Stable-Baselines3's "
            "kind, or a function from an environment to a learner."
        )
    return found


def new_learner(
    uses: str, env: Any, *, seed: int, steps: int, hyperparameters: Mapping[str, Any]
) -> Learner:
    """A learner, ready to be trained.

    Args:
      uses: its name.
      env: the SB3 `VecEnv`, of one environment, that it is to learn in.
      seed: of all that it draws.
      steps: of training that it will be given.
      hyperparameters: where they differ from its defaults. Lists become tuples, which JSON has not
        (`"train_freq": [1, "episode"]`).

    Raises:
      UnknownNameError, OptionError, MissingDependencyError: see `find_algorithm`; or it takes
        other hyperparameters, or makes something that is no learner.
    """
    found = find_algorithm(uses)
    settings = {k: tuple(v) if isinstance(v, list) else v for k, v in hyperparameters.items()}
    if isinstance(found, type) and is_sb3(found):
        _refuse_unknown(uses, found, settings)
        settings = {**replay_settings(found, steps + env.num_envs), **settings}
        try:
            learner = found("MlpPolicy", env, seed=seed, device="cpu", **settings)
        except (AssertionError, TypeError, ValueError) as error:
            raise OptionError(
                f"uses={uses!r}: refuses the task or its hyperparameters {sorted(hyperparameters)}:"
                f" {error}. Change them; or make the learner in a function, as module:function."
            ) from error
    else:
        try:
            inspect.signature(found).bind(env, seed=seed, **settings)
        except TypeError as error:
            raise OptionError(
                f"uses={uses!r}: cannot be called with an environment, seed= and the "
                f"hyperparameters {sorted(settings)}: {error}. Give those that it takes."
            ) from None
        learner = found(env, seed=seed, **settings)
    missing = [name for name in ("learn", "predict") if not hasattr(learner, name)]
    if missing:
        raise OptionError(
            f"uses={uses!r}: made a {type(learner).__name__}, which has no "
            f"{' and no '.join(missing)}. Have it return a learner, as Stable-Baselines3's are."
        )
    if is_sb3(learner):
        silence(learner)
    made: Learner = learner
    return made


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
            f"{type(error).__name__}: {error}. Repair or remove the package that brings it."
        ) from error


def _refuse_unknown(uses: str, algorithm: type, settings: Mapping[str, Any]) -> None:
    parameters = inspect.signature(algorithm).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    known = [name for name in parameters if name not in _RESERVED and not name.startswith("_")]
    for name in settings:
        if name not in known:
            raise OptionError(
                f"hyperparameters={name!r}: {uses} has none of this name."
                f"{did_you_mean(name, known)} Known: {', '.join(known)}."
            )
