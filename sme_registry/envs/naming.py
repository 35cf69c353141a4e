"""How environments go by the content of their spec."""

from __future__ import annotations

import copy

from gymnasium.envs.registration import EnvSpec

from sme_registry.spec import SMESpec
from sme_registry.spec.catalogue import NAMESPACE
from sme_registry.task.streams import DYNAMICS_VERSION


def content_id(spec: SMESpec) -> str:
    """`SME/sha256-<first 12 hex of the digest>-v1`."""
    return f"{NAMESPACE}/{spec.content_name}-v{DYNAMICS_VERSION}"


def renamed_by_content(env_spec: EnvSpec | None, spec: SMESpec) -> EnvSpec | None:
    """Gymnasium's spec of an environment; one with overridden fields takes its content's id.

    Whoever makes `SME/Default-v1` with `complexity=10` has another task, and it must not be
    recorded under the name it was derived from.
    """
    if env_spec is None or not SMESpec.model_fields.keys() & env_spec.kwargs.keys():
        return env_spec
    derived = copy.deepcopy(env_spec)
    kept = {k: v for k, v in env_spec.kwargs.items() if k not in SMESpec.model_fields}
    derived.kwargs = {**kept, "spec": spec.plain()}
    derived.id = content_id(spec)
    # EnvSpec splits the id into these once, when it is made.
    derived.name = derived.id.removeprefix(f"{NAMESPACE}/").rsplit("-v", 1)[0]
    derived.version = DYNAMICS_VERSION
    return derived
