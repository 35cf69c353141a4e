"""`Extension`: what `safety` and `observation` add to a step, after `Engine`'s part of it.

By machine code where Numba is installed, else by NumPy. Distractors and observed states agree
between both as states and π* do: the former bit for bit, a mixing to the rounding of float32.
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sme_registry.compiled.engine import Backend, Observation, chosen_backend
from sme_registry.compiled.network import network
from sme_registry.compiled.notice import compiling
from sme_registry.compiled.values import (
    COST,
    LANE_STATE,
    LANE_VALUES,
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
    ROOM_COST,
    ROOM_SAFE_REGRET,
    ROOM_STATE,
    ROWS_WITH_SAFETY,
    SAFE_REGRET,
    STEP_REWARD,
)
from sme_registry.task import Task
from sme_registry.task.draw import Array
from sme_registry.task.streams import counted

ExtendLane: TypeAlias = Callable[
    [Array, Array, Array, npt.NDArray[Any], Array, Observation, Array], None
]
"""The rest of one lane's step; see `extension_kernels.extend_lane` without its packed extension."""

ExtendMany: TypeAlias = Callable[
    [Array, Array, Array, Array, Array, Array, Observation, Array], None
]
"""The rest of a step of `B` lanes; see `extension_kernels.extend_many` likewise."""


@dataclass(frozen=True, eq=False)
class Extension:
    """What a task's `safety` and `observation` add to a step, ready to call.

    Attributes:
      new_room: makes what a single lane needs besides its own numbers.
      extend_float32: the rest of one lane's step, for float32 actions.
      extend_float64: the same for float64 actions.
      extend_many: the rest of a batch's step.
      seen: what agents see, `[S + m, B]`, of states and distractors `[S + m, B]`.
    """

    new_room: Callable[[], Array]
    extend_float32: ExtendLane
    extend_float64: ExtendLane
    extend_many: ExtendMany
    seen: Callable[[Array], Array]


_packed: weakref.WeakKeyDictionary[Task, Array] = weakref.WeakKeyDictionary()


def extension(task: Task, backend: Backend | None = None) -> Extension:
    """The extension of a task with `safety` or `observation`.

    Args:
      task: the task.
      backend: "numba" or "numpy"; None takes `chosen_backend()`.

    Raises:
      OptionError, MissingDependencyError: see `chosen_backend`.
    """
    backend = backend or chosen_backend()
    seen = _seen(task, backend)
    if backend == "numpy":
        return _numpy_extension(task, seen)
    with compiling():
        from sme_registry.compiled import extension_kernels as kernels

    if task not in _packed:
        _packed[task] = kernels.pack_extension(task)
    packed = _packed[task]
    float32, float64 = (
        functools.partial(kernels.extend_lane.get_overload(types), packed)
        for types in (kernels.EXTEND_LANE_FLOAT32, kernels.EXTEND_LANE_FLOAT64)
    )
    many = functools.partial(kernels.extend_many.get_overload(kernels.EXTEND_MANY), packed)
    size = kernels.room_size(packed)
    return Extension(functools.partial(np.zeros, size), float32, float64, many, seen)


def _seen(task: Task, backend: Backend) -> Callable[[Array], Array]:
    if not task.mixing:
        return np.copy
    assert task.spec.observation is not None
    uniform = task.spec.observation.mixing == "nonlinear"
    return network(task.mixing, uniform=uniform, backend=backend)


def _numpy_extension(task: Task, seen: Callable[[Array], Array]) -> Extension:
    S, m = task.spec.state_dim, task.spec.distractors
    limiting = network(task.limiting, backend="numpy") if task.limiting else None

    def extend_lane(
        own: Array,
        room: Array,
        lane: Array,
        action: npt.NDArray[Any],
        optimal: Array,
        observation: Observation,
        limits: Array,
    ) -> None:
        before, after = room[ROOM_STATE:, None], lane[LANE_STATE:, None]
        values = np.empty((ROWS_WITH_SAFETY, 1, 1))
        values[STEP_REWARD] = lane[LANE_VALUES + STEP_REWARD]
        extend_many(
            own[:, None], before, after, action.astype(np.float64)[None], optimal[None], values,
            observation[None], limits[:, None],
        )  # fmt: skip
        room[[ROOM_COST, ROOM_SAFE_REGRET]] = values[[COST, SAFE_REGRET], 0, 0]
        before[:] = after

    def extend_many(
        own: Array,
        before: Array,
        after: Array,
        action: Array,
        optimal: Array,
        values: Array,
        observation: Observation,
        limits: Array,
    ) -> None:
        action = np.clip(action, 0.0, 1.0)
        if limiting is not None:
            assert task.spec.safety is not None
            limits[0] = 1.0 - 2.0 * task.spec.safety.tightness * limiting(before).T
            limits[1] = np.minimum(optimal, limits[0])
            values[COST, 0] = task.cost_of(action, limits[0])
            safe_reward = task.reward_of(task.similarity_of(limits[1], optimal))
            values[SAFE_REGRET, 0] = safe_reward - values[STEP_REWARD, 0]
        if task.spec.observation is None:
            return
        observation[:, S + m :] = observation[:, S : S + 2].copy()
        if m:
            own[OWN_DISTRACTORS:] = moved(own, action).T
        observation[:, : S + m] = seen(np.concatenate([after, own[OWN_DISTRACTORS:]])).T

    def moved(own: Array, action: Array) -> Array:
        if task.distractor_transition is None:
            return draw(own, m)
        assert task.spec.observation is not None
        if task.spec.observation.dynamics == "autonomous":
            action = draw(own, task.spec.action_dim)
        return task.distractor_step(own[OWN_DISTRACTORS:].T, action)

    return Extension(
        functools.partial(np.zeros, ROOM_STATE + S), extend_lane, extend_lane, extend_many, seen
    )


def draw(own: Array, count: int) -> Array:
    """The next random numbers of each lane, `[B, count]` in (0, 1); `own` `[…, B]` counts them."""
    key, drawn = own[[OWN_KEY, OWN_DRAWN]].astype(np.uint64)
    own[OWN_DRAWN] += count
    return counted(key, drawn + np.uint64(1), count)
