"""Names → environments: the catalogue in Gymnasium's registry, and `make` for any spec."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from sme_registry.errors import NameTakenError, OptionError
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.catalogue import (
    DYNAMICS_VERSION,
    NAMESPACE,
    STREAM,
    SYMMETRIC,
    as_document,
    content_id,
    registered,
    released,
    resolve,
    symmetric_name,
)
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.spec.stream import StreamLike

try:
    from pettingzoo.env_registry import registration as pettingzoo
except ImportError:  # before 1.27 it has no registry, and AgileRL requires 1.26
    pettingzoo = None

if TYPE_CHECKING:
    from pettingzoo import AECEnv

    from sme_registry.teams import SMETeamEnv

_ENTRY_POINTS: dict[str, Any] = {
    "entry_point": "sme_registry.envs:SMEEnv",
    "vector_entry_point": "sme_registry.envs:SMEVectorEnv",
}


def _register(env_id: str, kind: str, document: dict[str, Any] | str) -> None:
    """Register a document by an id; `kind` is "team", or its keyword, "spec" or "stream"."""
    if kind == "team":
        if pettingzoo is None:
            return
        kwargs = {"spec": document}
        pettingzoo.register("parallel", env_id, "sme_registry.teams:parallel_env", kwargs=kwargs)
        pettingzoo.register("aec", env_id, "sme_registry.teams:env", kwargs=kwargs)
        return
    kwargs = {kind: document}
    gymnasium.register(env_id, **_ENTRY_POINTS, kwargs=kwargs)
    if "/sha256-" not in env_id:
        symmetric = {**kwargs, "action_range": "symmetric"}
        gymnasium.register(symmetric_name(env_id), **_ENTRY_POINTS, kwargs=symmetric)


def _is_registered(env_id: str) -> bool:
    teams = {} if pettingzoo is None else pettingzoo.parallel_registry
    return env_id in gymnasium.registry or env_id in teams


def register_catalogue() -> None:
    """Register every task and stream of `specs/` by its name and by its content, unvalidated.

    Gymnasium's `register` scans its whole registry each time: keep this to the catalogue.
    """
    for kind, versioned_name, content_name in released():
        version = versioned_name.rsplit("-v", 1)[1]
        names = [versioned_name, f"{content_name}-v{version}"]
        if kind == "stream":
            names.append(f"{STREAM}{versioned_name}")
        for env_id in (f"{NAMESPACE}/{name}" for name in names):
            if not _is_registered(env_id):
                _register(env_id, kind, versioned_name)


def register(spec: SMESpec | StreamSpec, name: str) -> str:
    """Register a spec or a stream, or its fields, under a name, in this process; returns the id.

    Of letters, digits, '_' and '-'. A single agent's task and a stream can also be made by
    `SME/MyTaskSymmetric-v1`, with actions in [−1, 1]. NameTakenError where the id stands for
    another spec: a released id never changes its numbers.

    Examples:
      >>> sme_registry.register(sme_registry.SMESpec(k=3), "EveryThird")
      'SME/EveryThird-v1'
      >>> sme_registry.load("EveryThird").k
      3
    """
    document = as_document(spec)
    short = str(name).removeprefix(f"{NAMESPACE}/").removesuffix(f"-v{DYNAMICS_VERSION}")
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", short) or re.search(r"-v\d+$", short):
        raise OptionError(
            f"name={name!r}: must be 1 to 64 letters, digits, '_' and '-', with the version "
            f"-v{DYNAMICS_VERSION} or none."
        )
    if short.startswith("sha256-") and short != document.content_name:
        raise OptionError(
            f"name={name!r}: names the document of another digest. Leave out 'sha256-'."
        )
    if short.endswith(SYMMETRIC):
        raise OptionError(
            f"name={name!r}: must not end with {SYMMETRIC!r}, the ending of ids with actions in "
            f"[−1, 1]. Remove it: the id with that ending is registered as well."
        )
    env_id = f"{NAMESPACE}/{short}-v{DYNAMICS_VERSION}"
    if _is_registered(env_id):
        existing = resolve(env_id).document
        if existing == document:
            return env_id
        raise NameTakenError(
            f"{env_id!r} stands for another {existing.kind} ({existing.digest[:19]}…). "
            "Choose another name: a released id never changes its numbers."
        )
    registered[env_id] = document.named(env_id)
    kind = "team" if document.specs[0].team else document.kind
    _register(env_id, kind, document.to_dict())
    return env_id


def env_spec(spec: SpecLike | StreamLike, **kwargs: Any) -> EnvSpec:
    """Gymnasium's `EnvSpec` of any spec or stream, unregistered; its kwargs are plain JSON.

    `gymnasium.make` and `gymnasium.make_vec` take it in place of an id. Keywords are fields of the
    spec to override, which give the derived spec its own id, and arguments of the environment.

    Examples:
      >>> import gymnasium
      >>> derived = sme_registry.env_spec("Default", complexity=10)
      >>> gymnasium.make(derived).unwrapped.sme_spec.complexity
      10
    """
    from sme_registry.envs import SMEEnv, arguments
    from sme_registry.task import load

    document = load(spec)
    overrides = {name: kwargs.pop(name) for name in [*kwargs] if name in SMESpec.model_fields}
    arguments.check_overrides(SMEEnv, document, overrides)
    if overrides and isinstance(document, SMESpec):
        document = document.derive(**overrides)
    kwargs = {document.kind: document.to_dict(), **kwargs}
    return EnvSpec(id=content_id(document), **_ENTRY_POINTS, kwargs=kwargs)


def make(spec_or_id: SpecLike | StreamLike, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """`gymnasium.make` for an id, a digest, a path, a spec or a stream.

    Keywords are fields of the spec to override (`complexity=10`), `action_range`, `render_mode`,
    and other arguments of `gymnasium.make`. The environment has Gymnasium's default wrappers.

    Examples:
      >>> env = sme_registry.make("Default", horizon=20)
      >>> observation, info = env.reset(seed=0)
      >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
      >>> bool(0 <= info["regret"] <= 1)
      True
    """
    return gymnasium.make(registered_or_new(spec_or_id), **kwargs)


def make_vec(
    spec_or_id: SpecLike | StreamLike,
    num_envs: int = 1,
    **kwargs: Any,
) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """`gymnasium.make_vec` for an id, a digest, a path, a spec or a stream; a native batch.

    Keywords as for `make`, and `autoreset_mode`.

    Examples:
      >>> envs = sme_registry.make_vec("Default", 64)
      >>> observations, infos = envs.reset(seed=0)
      >>> observations.shape
      (64, 10)
    """
    return gymnasium.make_vec(registered_or_new(spec_or_id), num_envs=num_envs, **kwargs)


def registered_or_new(spec_or_id: SpecLike | StreamLike) -> EnvSpec:
    """The `EnvSpec` of an id as it is registered, which keeps the id's name; else `env_spec`."""
    if isinstance(spec_or_id, str):
        name = spec_or_id.removeprefix("sme_registry:")
        for env_id in (name, f"SME/{name}", f"SME/{name}-v1", f"{name}-v1"):
            if env_id in gymnasium.registry and env_id.startswith("SME/"):
                return gymnasium.registry[env_id]
    return env_spec(spec_or_id)


def make_parallel(spec_or_id: SpecLike, **kwargs: Any) -> SMETeamEnv:
    """The team of an id, a digest, a path or a spec as a PettingZoo parallel environment.

    A task without a team is a team of one, `agent_0`. Keywords are fields of the spec to override,
    `action_range` and `render_mode`.

    Examples:
      >>> team = sme_registry.make_parallel("Team4")
      >>> observations, infos = team.reset(seed=0)
      >>> team.agents
      ['agent_0', 'agent_1', 'agent_2', 'agent_3']
    """
    from sme_registry.teams import parallel_env

    return parallel_env(spec_or_id, **kwargs)


def make_aec(spec_or_id: SpecLike, **kwargs: Any) -> AECEnv[str, Any, Any]:
    """The same as a PettingZoo AEC environment: agents act in turn, the step is joint.

    Examples:
      >>> team = sme_registry.make_aec("Team4")
      >>> team.reset(seed=0)
      >>> team.agent_selection
      'agent_0'
    """
    from sme_registry.teams import env

    return env(spec_or_id, **kwargs)
