"""The memory that a task needs, so that one too large is refused before it is drawn."""

from __future__ import annotations

import os
from collections.abc import Iterator

from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.spec import SMESpec
from sme_registry.task.draw import agents

LIMIT_VARIABLE = "SME_MEMORY_LIMIT_GIB"
DEFAULT_LIMIT_GIB = 4.0
_WORKSPACE = 10  # of the largest matrix: raw bits, W's integers, normals, Q, R, LAPACK's copies


def parameter_bytes(spec: SMESpec) -> int:
    """The bytes of a task's arrays once it is drawn, float64."""
    return 8 * sum(count * out * (inputs + 1) for inputs, out, count in _shapes(spec))


def peak_bytes(spec: SMESpec) -> int:
    """An upper estimate of the bytes needed while a task is drawn."""
    largest = max(out * inputs for inputs, out, count in _shapes(spec) if count)
    if spec.rotation:
        largest = max(largest, max(_observed(spec)) ** 2)
    return parameter_bytes(spec) + 8 * _WORKSPACE * largest


def limit_bytes() -> int:
    """The limit: 4 GiB, or the value of the environment variable SME_MEMORY_LIMIT_GIB."""
    text = os.environ.get(LIMIT_VARIABLE)
    if text is None:
        return int(DEFAULT_LIMIT_GIB * 2**30)
    try:
        limit = float(text)
        if 0 < limit < 2**40:
            return int(limit * 2**30)
    except ValueError:
        pass
    raise OptionError(f"{LIMIT_VARIABLE}={text!r}: must be a positive number of GiB, such as 16.")


def check_limit(needed: int, what: str, remedy: str) -> None:
    """Raise ResourceLimitError, with both sizes, if `needed` bytes exceed the limit."""
    limit = limit_bytes()
    if needed > limit:
        raise ResourceLimitError(
            f"{what} would need {_gib(needed)} GiB of memory; the limit is {_gib(limit)} GiB. "
            f"{remedy} If the machine has the memory, set {LIMIT_VARIABLE} above {_gib(needed)}."
        )


def _gib(count: int) -> str:
    gib = count / 2**30
    return f"{gib:.1f}" if gib >= 10 else f"{gib:.3g}"


def _shapes(spec: SMESpec) -> Iterator[tuple[int, int, int]]:
    """`(inputs, outputs, how many)` of every matrix of a task, without a list of its layers."""
    yield spec.action_dim, spec.state_dim, 1  # W and b of the transition
    for agent, observed in zip(agents(spec), _observed(spec), strict=True):
        yield from _of_network(spec, observed, agent.action_dim)
    if spec.safety is not None:
        yield from _of_network(spec, spec.state_dim, spec.action_dim)
    if spec.observation is not None:
        yield spec.action_dim, spec.distractors, int(spec.observation.dynamics != "noise")
        mixed = spec.state_dim + spec.distractors
        depth = spec.observation.mixing_depth or int(spec.observation.mixing != "none")
        yield mixed, mixed, depth


def _of_network(spec: SMESpec, inputs: int, outputs: int) -> Iterator[tuple[int, int, int]]:
    """The same of a network of the spec's complexity and width."""
    H, inner = spec.hidden_width, spec.complexity - 1
    if inner == 0:
        yield inputs, outputs, 1
        return
    yield inputs, H, 1
    if inner > 1:
        yield H, H, inner - 1
    yield H, outputs, 1


def _observed(spec: SMESpec) -> list[int]:
    """How many state channels each agent observes."""
    return [
        spec.state_dim if agent.observes == "all" else len(agent.observes) for agent in agents(spec)
    ]
