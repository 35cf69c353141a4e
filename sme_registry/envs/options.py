"""What may be passed to `reset`: seeds, and `options`."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError, SpecError, StateError, did_you_mean
from sme_registry.spec.document import plain_number
from sme_registry.task import Task


def refuse_unknown(options: dict[str, Any] | None, known: tuple[str, ...]) -> None:
    """Raise on an option that is not known.

    Raises:
      OptionError: names the option and the nearest known one.
    """
    for name in options or {}:
        if name not in known:
            raise OptionError(
                f"options={{{name!r}: …}}: unknown option.{did_you_mean(str(name), known)} "
                f"Known: {', '.join(known)}."
            )


def initial_states(state: Any, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """States to begin at, as float64 of `shape`, each entry in [0, 1].

    Raises:
      StateError: not numbers, of another shape, or outside the cube.
    """
    try:
        array = np.asarray(state, dtype=np.float64)
    except (TypeError, ValueError):
        raise StateError(f"state={state!r:.80}: must be an array of shape {shape}.") from None
    if array.shape != shape:
        raise StateError(f"state of shape {array.shape}: must be of shape {shape}.")
    outside = ~((array >= 0.0) & (array <= 1.0))
    if outside.any():
        raise StateError(
            f"state: entry {array[outside][0]!r:.30} lies outside [0, 1]. An episode begins inside "
            "the cube; to ask the task about states outside it, use env.unwrapped.task."
        )
    return array


def checked_seed(seed: Any) -> int | None:
    """A seed of an environment's generator: None, or an integer of at least 0.

    Raises:
      OptionError: neither.
    """
    if seed is None:
        return None
    seed = plain_number(seed)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise OptionError(f"seed={seed!r:.60}: must be an integer of at least 0, or None.")
    return seed


def single_agent(task: Task) -> Task:
    """The task, which must be one agent's.

    Raises:
      SpecError: it is a team's; says how to make that.
    """
    if len(task.policies) > 1:
        raise SpecError(
            f"team: this task is for {len(task.policies)} agents and Gymnasium's environments are "
            "for one. Use sme_registry.make_parallel or sme_registry.make_aec."
        )
    return task
