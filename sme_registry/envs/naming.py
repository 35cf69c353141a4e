"""Ids of environments by the content of their spec."""

from __future__ import annotations

import copy
from enum import Enum

import gymnasium
from gymnasium.envs.registration import EnvSpec

from sme_registry.spec import SMESpec
from sme_registry.spec.catalogue import NAMESPACE
from sme_registry.task.streams import DYNAMICS_VERSION


def content_id(spec: SMESpec) -> str:
    """`SME/sha256-<first 12 hex of the digest>-v1`."""
    return f"{NAMESPACE}/{spec.content_name}-v{DYNAMICS_VERSION}"


def renamed_by_content(env_spec: EnvSpec | None, spec: SMESpec) -> EnvSpec | None:
    """Gymnasium's spec of an environment, as plain JSON; a derived task gets the id of its content.

    `SME/Default-v1` with `complexity=10` is another task, and must not be recorded under the name
    from which it was derived.

    Args:
      env_spec: from which Gymnasium made the environment.
      spec: the spec that is run.
    """
    if env_spec is None:
        return None
    fields = SMESpec.model_fields.keys()
    registered = gymnasium.registry.get(env_spec.id)
    task = env_spec.kwargs.get("spec")
    is_named = registered is None or registered.kwargs.get("spec") == task
    named = is_named and not fields & env_spec.kwargs.keys()

    plain = copy.deepcopy(env_spec)
    plain.kwargs = {
        key: value.value if isinstance(value, Enum) else value
        for key, value in plain.kwargs.items()
        if key not in fields
    }
    if not named or not isinstance(task, str | dict):
        plain.kwargs["spec"] = spec.to_dict()
    if not named:
        plain.id = content_id(spec)
        # EnvSpec derives these from the id only in its constructor.
        plain.name = plain.id.removeprefix(f"{NAMESPACE}/").rsplit("-v", 1)[0]
        plain.version = DYNAMICS_VERSION
    return plain
