"""What the safe algorithms need of their environment: a task with limits, and its costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.envs.arguments import refuse_without_limits
from sme_registry.errors import OptionError
from sme_registry.spec import SMESpec


def spec_with_limits(algorithm: str, env: Any) -> SMESpec:
    """The spec of an environment's task, which must have `safety`."""
    try:
        spec: SMESpec = env.get_attr("sme_spec")[0]
    except AttributeError:
        raise OptionError(
            f"{algorithm}: the environment has no `sme_spec`. Use an environment of sme_registry."
        ) from None
    refuse_without_limits(algorithm, spec)
    return spec


def costs_in(infos: Sequence[dict[str, Any]]) -> npt.NDArray[np.float32]:
    """The cost of a step in each lane, `[lanes]`, from its infos."""
    try:
        return np.array([info["cost"] for info in infos], np.float32)
    except KeyError:
        raise OptionError(
            "the environment's infos have no 'cost'. Use an environment of sme_registry whose "
            "task has safety, with wrappers that keep its infos."
        ) from None
