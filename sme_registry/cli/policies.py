"""The policies that `sme evaluate` takes: a model's .zip, `module:function`, or a reference."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.compiled import engine
from sme_registry.errors import PolicyError, SMEError, UnknownNameError, did_you_mean
from sme_registry.spec import SMESpec
from sme_registry.task import materialize
from sme_registry.task.draw import Array

Observations = npt.NDArray[np.float32]
Act = Callable[[Observations], Any]
Joint = Callable[[Array], Array]  # states [B, S] to joint actions [B, A]


def find_policy(name: str, spec: SMESpec) -> Any:
    """What `evaluate` takes as a policy.

    Args:
      name: a path ending in .zip, `module:function` (looked for in this folder, too), or the name
        of a reference policy.
      spec: the task it is for.

    Raises:
      UnknownNameError: none of these.
      PolicyError: the module or its function is not there, or fails when it is imported.
    """
    if name in REFERENCES:
        return _reference(name, spec)
    if name.endswith(".zip") or (os.sep in name and os.path.exists(name)):
        return name
    if ":" in name:
        return _imported(name)
    raise UnknownNameError(
        f"policy={name!r}: must be a model's .zip, a module:function, or one of "
        f"{', '.join(REFERENCES)}.{did_you_mean(name, REFERENCES)}"
    )


def _imported(name: str) -> Any:
    module_name, _, attribute = name.partition(":")
    sys.path.insert(0, os.getcwd())
    try:
        found = getattr(importlib.import_module(module_name), attribute)
    except SMEError:
        raise
    except Exception as error:
        raise PolicyError(
            f"policy={name!r}: cannot be imported: {type(error).__name__}: {error}. It must be "
            "module:function, the module in this folder or installed."
        ) from error
    finally:
        sys.path.remove(os.getcwd())
    if not callable(found):
        raise PolicyError(
            f"policy={name!r}: is a {type(found).__name__}: must be a function from observations "
            f"to actions."
        )
    return found


def _optimal(spec: SMESpec) -> Joint:
    return engine(materialize(spec)).optimal_action


def _constant(spec: SMESpec) -> Joint:
    return lambda s: np.full((len(s), spec.action_dim), 0.5)


def _random(spec: SMESpec) -> Joint:
    generator = np.random.default_rng(0)
    return lambda s: generator.random((len(s), spec.action_dim))


def _linear(spec: SMESpec) -> Joint:
    from sme_registry.evaluation import references

    task = materialize(spec)
    s = np.random.default_rng(0).random((references.fit_states(spec), spec.state_dim))
    agents = zip(task.observed, task.owned, strict=True)
    fitted = references.fit(s, engine(task).optimal_action(s), agents)
    return lambda s: (s - 0.5) @ fitted.slope + fitted.intercept


REFERENCES: dict[str, Callable[[SMESpec], Joint]] = {
    "optimal": _optimal,
    "constant": _constant,
    "random": _random,
    "linear": _linear,
}


def _reference(name: str, spec: SMESpec) -> Act | dict[str, Act]:
    """A reference policy of a single agent, or one for each agent of a team."""
    joint, S = REFERENCES[name](spec), spec.state_dim
    if spec.team is None:
        return lambda observations: joint(observations[:, :S].astype(np.float64))
    task = materialize(spec)

    def of(observed: tuple[int, ...], own: slice) -> Act:
        def act(observations: Observations) -> Array:
            # What the agent does not observe has no part in its own channels of the joint action.
            s = np.zeros((len(observations), S))
            s[:, observed] = observations[:, : len(observed)]
            return joint(s)[:, own]

        return act

    agents = zip(task.names, task.observed, task.owned, strict=True)
    return {agent: of(observed, own) for agent, observed, own in agents}
