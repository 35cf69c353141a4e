"""`Policy`: one policy as a checked function, from a callable, a model or a file."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from sme_registry.envs import arguments
from sme_registry.envs.types import Observation as Observations
from sme_registry.errors import ActionError, PolicyError
from sme_registry.evaluation.policies import sb3
from sme_registry.evaluation.policies.interface import Interface
from sme_registry.evaluation.policies.npz import OfflinePolicy
from sme_registry.evaluation.policies.onnx import load_onnx
from sme_registry.spec import ActionRange
from sme_registry.task.draw import Array


@dataclass(frozen=True)
class Policy:
    """A policy, ready to be called.

    Attributes:
      name: what reports call it.
      action_range: the range of what `act` returns, "unit" or "symmetric".
      act: observations float32 to actions; unchecked.
      action_dim: A, entries of an action.
      hint: a sentence about its interface, which error messages end with.
    """

    name: str
    action_range: ActionRange
    act: Callable[[Observations], Any]
    action_dim: int
    hint: str = ""

    def __call__(self, observations: Observations) -> Array:
        """Actions `[B, A]`, converted to the unit range but not clipped to it.

        Raises:
          PolicyError: it fails, or does not return `[B, A]` finite numbers.
        """
        try:
            returned = self.act(observations)
            shape = (len(observations), self.action_dim)
            a = arguments.to_unit(returned, shape, self.action_range == "symmetric")
            if not np.isfinite(a).all():
                raise arguments.not_finite_error()
            return a
        except ActionError as error:
            raise PolicyError(
                f"policy {self.name!r}: {error} It receives observations "
                f"[{len(observations)}, {observations.shape[1]}] and must return one action per "
                f"row.{self.hint and f' {self.hint}'}"
            ) from None
        except PolicyError:
            raise
        except Exception as error:
            raise PolicyError(
                f"policy {self.name!r} failed on observations of shape {observations.shape}: "
                f"{type(error).__name__}: {error}{self.hint and f'. {self.hint}'}"
            ) from error


def prepare(
    policy: Any, interface: Interface, *, action_range: str | None = None, name: str | None = None
) -> Policy:
    """A policy from a callable, a model or the path of a file.

    Args:
      policy: the policy.
      interface: what it must map from and to.
      action_range: as in `as_policy`.
      name: as in `as_policy`.

    Raises:
      PolicyError: it is none of these, cannot be loaded, or has another interface.
      MissingDependencyError: the library that loads the file is not installed.
    """
    if isinstance(policy, Policy):
        if policy.action_dim != interface.action_dim:
            raise PolicyError(
                f"policy {policy.name!r}: its actions have {policy.action_dim} entries: must be "
                f"{interface.action_dim} for {interface.description}. Prepare it for this task."
            )
        return replace(
            policy,
            name=name or policy.name,
            action_range=cast(ActionRange, action_range or policy.action_range),
        )
    if isinstance(policy, str | os.PathLike):
        name = Path(policy).stem if name is None else name
        policy = _load(Path(policy), interface)
    if hasattr(policy, "predict"):
        sb3.check_spaces(policy, interface)
        act, action_range = sb3.predictor(policy), action_range or sb3.action_range_of(policy)
    elif callable(policy):
        act, action_range = policy, action_range or "unit"
    else:
        raise PolicyError(
            f"policy={policy!r:.80}: must be {interface.alternatives}a callable from observations "
            f"[B, {interface.observation_dim}] to actions [B, {interface.action_dim}], a "
            "Stable-Baselines3 model, the path of a .zip, .onnx or .npz file, module:function, or "
            "the name of a reference policy."
        )
    return Policy(
        name or _name_of(policy),
        cast(ActionRange, action_range),
        act,
        interface.action_dim,
        interface.hint,
    )


def _load(path: Path, interface: Interface) -> Any:
    if path.suffix == ".onnx":
        return load_onnx(path, interface)
    if path.suffix == ".npz":
        policy = OfflinePolicy.load(path)
        if (policy.observation_dim, policy.action_dim) != interface[:2]:
            raise PolicyError(
                f"{path}: maps observations [B, {policy.observation_dim}] to actions "
                f"[B, {policy.action_dim}]: must be [B, {interface.observation_dim}] and "
                f"[B, {interface.action_dim}] for {interface.description}. "
                "Evaluate it on the task it was trained for."
            )
        return policy
    return sb3.load_sb3(path)


def _name_of(policy: Any) -> str:
    name = getattr(policy, "__name__", type(policy).__name__)
    return "policy" if name in ("<lambda>", "function") else str(name)
