"""`new_learner`: a learner for an environment, from the name of its algorithm (`algorithms`).

A function that is named as an algorithm returns a learner:

    def make(env: VecEnv, *, seed: int, **hyperparameters) -> Learner

so anything with `learn` and `predict` can be trained.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, Protocol

from sme_registry.errors import OptionError
from sme_registry.training.algorithms import (
    find_algorithm,
    is_sb3,
    replay_settings,
    silence,
)
from sme_registry.training.hyperparameters import policy_alias, refuse_unknown, resolved


class Learner(Protocol):
    """What is trained, such as a model of Stable-Baselines3."""

    def learn(self, total_timesteps: int) -> Any:
        """Learn from at least this many steps of the environment."""

    def predict(self, observation: Any, *, deterministic: bool) -> Any:
        """Actions `[B, A]` in the range of `env.action_space`, or a tuple that begins with them."""


def new_learner(
    uses: str,
    env: Any,
    *,
    seed: int,
    steps: int,
    hyperparameters: Mapping[str, Any],
    field: str = "uses",
) -> Learner:
    """Create a learner."""
    algorithm = find_algorithm(uses, field)
    refuse_unknown(algorithm, uses, hyperparameters)
    settings = resolved(hyperparameters)
    if isinstance(algorithm, type) and is_sb3(algorithm):
        settings = {**replay_settings(algorithm, steps + env.num_envs), **settings}
        try:
            policy = policy_alias(algorithm)
            learner = algorithm(policy, env, seed=seed, device="cpu", **settings)
        except (AssertionError, MemoryError, TypeError, ValueError) as error:
            raise OptionError(
                f"{field}={uses!r}: rejects the task or the hyperparameters "
                f"{sorted(hyperparameters)}: {error}. Change them, or create the learner in a "
                "function and give module:function."
            ) from error
    else:
        try:
            inspect.signature(algorithm).bind(env, seed=seed, **settings)
        except TypeError as error:
            raise OptionError(
                f"{field}={uses!r}: cannot be called with an environment, seed= and the "
                f"hyperparameters {sorted(settings)}: {error}. Give only those that it accepts."
            ) from None
        learner = algorithm(env, seed=seed, **settings)
    missing = [name for name in ("learn", "predict") if not hasattr(learner, name)]
    if missing:
        raise OptionError(
            f"{field}={uses!r}: returned a {type(learner).__name__}, which has no "
            f"{' and no '.join(missing)}. Return a learner like those of Stable-Baselines3."
        )
    if is_sb3(learner):
        silence(learner)
    return learner  # type: ignore[no-any-return]
