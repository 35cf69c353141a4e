"""How much memory a task would take, so that what cannot fit is refused before it is drawn."""

from __future__ import annotations

import os
from collections.abc import Iterator

from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.spec import SMESpec
from sme_registry.task.draw import agents, observed_channels

LIMIT_VARIABLE = "SME_MEMORY_LIMIT_GIB"
DEFAULT_LIMIT_GIB = 4.0
_WORKSPACE = 10  # of the largest matrix: raw bits, W's integers, normals, Q, R, LAPACK's copies


def parameter_bytes(spec: SMESpec) -> int:
    """The bytes of a task's arrays once it is drawn, float64."""
    return 8 * sum(count * out * (inputs + 1) for inputs, out, count in _shapes(spec))


def peak_bytes(spec: SMESpec) -> int:
    """An upper estimate of the bytes needed while a task is drawn."""
    largest = max(out * inputs for inputs, out, _ in _shapes(spec))
    return parameter_bytes(spec) + 8 * _WORKSPACE * largest


def limit_bytes() -> int:
    """The limit: 4 GiB, or what the environment variable SME_MEMORY_LIMIT_GIB says.

    Raises:
      OptionError: the variable is not a positive number.
    """
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


def refuse_above_limit(needed: int, what: str, remedy: str) -> None:
    """Raise where something would need more memory than the limit.

    Raises:
      ResourceLimitError: `needed` bytes are above the limit; says both.
    """
    limit = limit_bytes()
    if needed > limit:
        raise ResourceLimitError(
            f"{what} would need {needed / 2**30:,.2f} GiB of memory; the limit is "
            f"{limit / 2**30:g} GiB. {remedy} Where there is memory for it, set "
            f"{LIMIT_VARIABLE} above {needed / 2**30:,.2f}."
        )


def _shapes(spec: SMESpec) -> Iterator[tuple[int, int, int]]:
    """`(inputs, outputs, how many)` of every matrix of a task, without a list of its layers."""
    H, inner = spec.hidden_width, spec.complexity - 1
    yield spec.state_dim, spec.action_dim, 1
    for agent, observed in zip(agents(spec), observed_channels(spec), strict=True):
        if inner == 0:
            yield len(observed), agent.action_dim, 1
        else:
            yield len(observed), H, 1
            if inner > 1:
                yield H, H, inner - 1
            yield H, agent.action_dim, 1
