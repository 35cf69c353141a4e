"""`Extension`: what `safety` and `observation` add to a step.

A single lane has a whole step of its own, since a second call would cost as much as the first. A
batch goes on where the engine's step ends.

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

from sme_registry.compiled.engine import (
    SMALL,
    Backend,
    Observation,
    StepLane,
    chosen_backend,
    engine,
)
from sme_registry.compiled.network import network
from sme_registry.compiled.notice import compiling
from sme_registry.compiled.values import (
    COST,
    EXTENDED,
    EXTRA_COST,
    EXTRA_OWN,
    EXTRA_SAFE_REGRET,
    LANE_STATE,
    LANE_VALUES,
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
    ROWS_WITH_SAFETY,
    SAFE_REGRET,
    STEP_REWARD,
)
from sme_registry.task import Task
from sme_registry.task.draw import Array
from sme_registry.task.streams import counted

ExtendMany: TypeAlias = Callable[
    [Array, Array, Array, Array, Array, Array, Observation, Array], None
]
"""The rest of a step of `B` lanes; see `extension_kernels.extend_many` without its packed array."""


@dataclass(frozen=True, eq=False)
class Extension:
    """What a task's `safety` and `observation` add to a step, ready to call.

    Attributes:
      new_lane: makes a buffer for a single lane, to pass to its steps; the view of it that is the
        plain lane, `[LANE_STATE + S]`; and that of `values.EXTRA_OWN`, `[4 + m]`.
      step_float32: one whole step of one lane, for float32 actions; see
        `extension_kernels.step_extended_lane` without its packed arrays.
      step_float64: the same for float64 actions.
      extend_many: the rest of a batch's step, after the engine's.
      seen: what agents see, `[S + m, B]`, of states and distractors `[S + m, B]`.
    """

    new_lane: Callable[[], tuple[Array, Array, Array]]
    step_float32: StepLane
    step_float64: StepLane
    extend_many: ExtendMany
    seen: Callable[[Array], Array]


_packed: weakref.WeakKeyDictionary[Task, tuple[Array, Array]] = weakref.WeakKeyDictionary()


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
        from sme_registry.compiled import extension_kernels, kernels

    if task not in _packed:
        _packed[task] = kernels.pack(task), extension_kernels.pack_extension(task)
    plain, packed = _packed[task]
    both = np.concatenate([plain, packed])
    steps: list[StepLane]
    if both.size <= SMALL:  # as the engine's
        prefix = both
        signatures = kernels.PACKED_LANE_FLOAT32, kernels.PACKED_LANE_FLOAT64
        packed_entry = extension_kernels.step_packed_extended_lane
        steps = [packed_entry.get_overload(types) for types in signatures]
    else:
        prefix = both[:0]
        signatures = kernels.LANE_FLOAT32, kernels.LANE_FLOAT64
        entry = extension_kernels.step_extended_lane
        steps = [functools.partial(entry.get_overload(types), both) for types in signatures]
    begin, S = prefix.size + kernels.lane_size(plain), task.spec.state_dim

    def new_lane() -> tuple[Array, Array, Array]:
        buffer = np.zeros(begin + extension_kernels.extra_size(packed))
        buffer[: prefix.size] = prefix
        lane = buffer[prefix.size : prefix.size + LANE_STATE + S]
        return buffer, lane, buffer[begin : begin + _extra_numbers(task)]

    types = extension_kernels.EXTEND_MANY
    many = functools.partial(extension_kernels.extend_many.get_overload(types), packed)
    return Extension(new_lane, steps[0], steps[1], many, seen)


def _extra_numbers(task: Task) -> int:
    return EXTRA_OWN + OWN_DISTRACTORS + task.spec.distractors


def _seen(task: Task, backend: Backend) -> Callable[[Array], Array]:
    if not task.mixing:
        return np.copy
    assert task.spec.observation is not None
    uniform = task.spec.observation.mixing == "nonlinear"
    return network(task.mixing, uniform=uniform, backend=backend)


def _numpy_extension(task: Task, seen: Callable[[Array], Array]) -> Extension:
    S, A, m = task.spec.state_dim, task.spec.action_dim, task.spec.distractors
    limiting = network(task.limiting, backend="numpy") if task.limiting else None
    plain = engine(task, "numpy")

    def new_lane() -> tuple[Array, Array, Array]:
        buffer = np.zeros(LANE_STATE + S + _extra_numbers(task))
        return buffer, buffer[: LANE_STATE + S], buffer[LANE_STATE + S :]

    def step_one(
        buffer: Array, action: npt.NDArray[Any], optimal: Array, observation: Observation
    ) -> tuple[float, float]:
        lane, extra = buffer[: LANE_STATE + S], buffer[LANE_STATE + S :]
        before = lane[LANE_STATE:, None].copy()
        reward, end = plain.step_float64(lane, action, optimal[:A], observation)
        if end < 0.0:
            return reward, end
        values = np.zeros((ROWS_WITH_SAFETY, 1, 1))
        values[STEP_REWARD] = lane[LANE_VALUES + STEP_REWARD]
        extend_many(
            extra[EXTRA_OWN:, None], before, lane[LANE_STATE:, None],
            action.astype(np.float64)[None], optimal[None, :A], values, observation[None],
            optimal[A:].reshape(-1, 1, A),
        )  # fmt: skip
        extra[[EXTRA_COST, EXTRA_SAFE_REGRET]] = values[[COST, SAFE_REGRET], 0, 0]
        return reward, end + EXTENDED

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
            safe_reward = task.safe_reward_of(optimal, limits[0])
            values[SAFE_REGRET, 0] = safe_reward - values[STEP_REWARD, 0]
        if task.spec.observation is None:
            return
        observation[:, S + m :] = observation[:, S : S + 2].copy()
        if m:
            own[OWN_DISTRACTORS:] = _next_distractors(task, own, action).T
        observation[:, : S + m] = seen(np.concatenate([after, own[OWN_DISTRACTORS:]])).T

    return Extension(new_lane, step_one, step_one, extend_many, seen)


def _next_distractors(task: Task, own: Array, action: Array) -> Array:
    """The next distractors of each lane, `[B, m]`."""
    if task.distractor_transition is None:
        return draw(own, task.spec.distractors)
    assert task.spec.observation is not None
    if task.spec.observation.dynamics == "autonomous":
        action = draw(own, task.spec.action_dim)
    return task.distractor_step(own[OWN_DISTRACTORS:].T, action)


def draw(own: Array, count: int) -> Array:
    """The next random numbers of each lane, `[B, count]` in (0, 1); `own` `[…, B]` counts them."""
    key, drawn = own[[OWN_KEY, OWN_DRAWN]].astype(np.uint64)
    own[OWN_DRAWN] += count
    return counted(key, drawn + np.uint64(1), count)
