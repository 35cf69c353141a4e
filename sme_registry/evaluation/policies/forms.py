"""`as_policy`: a policy in any form that Python or the command line accepts."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from sme_registry.errors import PolicyError, UnknownNameError, did_you_mean
from sme_registry.evaluation.policies.interface import Interface
from sme_registry.evaluation.policies.policy import Policy, prepare
from sme_registry.evaluation.policies.team import TeamPolicy, separate_policies, shared_policy
from sme_registry.evaluation.references import POLICIES, reference_policy
from sme_registry.io import choice, import_object
from sme_registry.spec import ACTION_RANGES, SMESpec

_SUFFIXES = (".zip", ".onnx", ".npz")


def as_policy(
    policy: Any, spec: SMESpec, *, action_range: str | None = None, name: str | None = None
) -> Policy | TeamPolicy:
    """Prepare a policy for a task.

    Args:
      policy: one of
        a callable from observations `[B, S + 2]` float32 to actions `[B, A]`;
        a Stable-Baselines3 model, or the path of its .zip (loading it can run code of its author);
        the path of an .onnx file, or of the .npz of an offline policy;
        `module:function`, imported from the working directory or an installed package;
        the name of a reference policy, one of `references.POLICIES`;
        for a team, a dict from each agent's name to its own policy, from the agent's observations
        `[B, |O_i| + 2]` to its actions `[B, a_i]`; or one of the above that all agents share,
        from shared observations `[B, S + 2 + n]` (`envs.shared`) to `[B, max a_i]`, of which the
        agent's first a_i entries count.
        A policy that this function returned is accepted as well; that of a team keeps its range.
      spec: the task it is for.
      action_range: "unit" for actions in [0, 1] or "symmetric" for [−1, 1]; None takes an SB3
        model's own action space, and "unit" for any other policy.
      name: what reports call it; None takes its name, or that of its file, algorithm or function.

    Raises:
      UnknownNameError: a text that is neither a path, nor `module:function`, nor a reference.
      PolicyError: it is none of these, cannot be loaded, or has another interface than the task;
        or an agent of a team has none or is unknown.
      OptionError: `action_range` is neither "unit" nor "symmetric".
      MissingDependencyError: the library that loads it is not installed.
    """
    if action_range is not None:
        choice("action_range", action_range, ACTION_RANGES)
    if isinstance(policy, str):
        policy, name = _named(policy, spec), name or _display_name(policy)
    options = {"action_range": action_range, "name": name}
    if isinstance(policy, TeamPolicy):
        policy.check_team(spec)
        return policy if name is None else replace(policy, name=name)
    if spec.team is None:
        S, A = spec.state_dim, spec.action_dim
        return prepare(policy, Interface(S + 2, A, f"state_dim={S}, action_dim={A}"), **options)
    if isinstance(policy, Mapping):
        return separate_policies(
            {agent: _of_agent(member, agent, spec) for agent, member in policy.items()},
            spec,
            **options,
        )
    return shared_policy(policy, spec, **options)


def _named(text: str, spec: SMESpec) -> Any:
    """The policy that a text names; a path stays one."""
    if text in POLICIES:
        return reference_policy(text, spec)
    if text.endswith(_SUFFIXES) or os.path.isfile(text):
        return Path(text)
    if os.path.isdir(text):
        raise PolicyError(f"policy={text!r}: is a folder. Give the policy's file in it.")
    if ":" not in text:
        raise UnknownNameError(
            f"policy={text!r}: must be the path of a .zip, .onnx or .npz file, module:function, or "
            f"one of {', '.join(POLICIES)}.{did_you_mean(text, POLICIES)}"
        )
    function = import_object(text, "policy", PolicyError)
    if not callable(function):
        raise PolicyError(
            f"policy={text!r}: is a {type(function).__name__}: must be a function from "
            "observations to actions."
        )
    return function


def _of_agent(policy: Any, agent: Any, spec: SMESpec) -> Any:
    """An agent's policy; of a reference policy's name the agent's part."""
    if isinstance(policy, str):
        policy = _named(policy, spec)
    return policy.get(agent) if isinstance(policy, Mapping) else policy


def _display_name(text: str) -> str:
    is_path = text not in POLICIES and (text.endswith(_SUFFIXES) or ":" not in text)
    return Path(text).stem if is_path else text
