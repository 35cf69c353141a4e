"""`Engine`: the step of a task, by machine code where Numba is installed, else by NumPy.

It is the step of METHOD's section 1; what `safety` and `observation` add follows in `extension`.
Both have the same functions with the same arguments, so an environment works with either. States
are bit-equal between them; oracle and rewards agree to 1e-12.
"""

from __future__ import annotations

import functools
import os
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from sme_registry.compiled.notice import compiling
from sme_registry.compiled.values import (
    ACCUMULATED_REWARD,
    LANE_STATE,
    LANE_T,
    LANE_VALUES,
    REGRET,
    REWARD,
    SIMILARITY,
    STEP_REWARD,
)
from sme_registry.io import choice, is_installed, require_packages
from sme_registry.task import Task, observe, step
from sme_registry.task.draw import Array

Backend = Literal["numba", "numpy"]
BACKEND_VARIABLE = "SME_BACKEND"
SMALL = 8192  # numbers of a packed task that each lane may hold a copy of: 64 KiB
_ROWS = (
    1024  # states per block of the oracle: a layer of 512 KiB, at the default width, stays in cache
)

Observation: TypeAlias = npt.NDArray[np.float32]
Mask: TypeAlias = npt.NDArray[np.bool_]


StepLane: TypeAlias = Callable[
    [Array, npt.NDArray[Any], Array, Observation],
    tuple[float, float],
]
"""One step of one lane of a single agent; see `kernels.step_lane` without its packed task.

From a lane's buffer and an action to the reward and the end; it writes the buffer, `optimal` `[A]`
and the observation `[S + 2]`.
"""

StepMany: TypeAlias = Callable[
    [Array, npt.NDArray[np.int64], Array, Array, Array, Observation, Array, Array, Mask], bool
]
"""One step of `B` lanes of a team of n agents; see `kernels.step_many` without its packed task."""


@dataclass(frozen=True, eq=False)
class Engine:
    """A task's step and oracle, ready to call.

    Attributes:
      backend: "numba" or "numpy".
      new_lane: makes a buffer for a single lane at t = 0, to pass to its steps, and the view of
        that buffer that holds the entries of `compiled.values`, `[LANE_STATE + S]`.
      step_float32: one step of one lane, for float32 actions.
      step_float64: the same for float64 actions.
      step_many: one step of a batch of lanes.
      optimal_action: π* of `[B, S]` states, any number of them, in blocks.
    """

    backend: Backend
    new_lane: Callable[[], tuple[Array, Array]]
    step_float32: StepLane
    step_float64: StepLane
    step_many: StepMany
    optimal_action: Callable[[Array], Array]


def chosen_backend() -> Backend:
    """The back-end of the environment variable SME_BACKEND; by default Numba where it is installed.

    Raises:
      OptionError: the variable names no back-end.
      MissingDependencyError: it asks for Numba, which is not installed.
    """
    asked = os.environ.get(BACKEND_VARIABLE, "auto")
    choice(BACKEND_VARIABLE, asked, ("auto", "numba", "numpy"))
    if asked == "numba":
        purpose = f"{BACKEND_VARIABLE}='numba'"
        require_packages(purpose, {"numba": "Numba"}, "fast", otherwise="unset the variable")
    return "numba" if is_installed("numba") and asked != "numpy" else "numpy"


_packed: weakref.WeakKeyDictionary[Task, Array] = weakref.WeakKeyDictionary()


def engine(task: Task, backend: Backend | None = None) -> Engine:
    """The engine of a task. Cheap: engines of one task share its packed numbers.

    Args:
      task: the task.
      backend: "numba" or "numpy"; None takes `chosen_backend()`.

    Raises:
      OptionError, MissingDependencyError: see `chosen_backend`.
    """
    make = _numba_engine if (backend or chosen_backend()) == "numba" else _numpy_engine
    return make(task)


def _numba_engine(task: Task) -> Engine:
    with compiling():  # where nothing is cached yet; else it loads Numba: 0.3 s of CPU
        from sme_registry.compiled import kernels

    if task not in _packed:
        _packed[task] = kernels.pack(task)

    def optimal_action(s: Array) -> Array:
        out = np.empty((len(s), task.spec.action_dim))
        for first in range(0, len(s), _ROWS):
            block, done = s[first : first + _ROWS], 0
            for channels, layers in zip(task.observed, task.policies, strict=True):
                x = block if len(channels) == task.spec.state_dim else block[:, channels]
                for W, b in layers:
                    x = x @ W.T  # BLAS for the product, compiled code for Φ, which is the cost
                    kernels.add_and_normal_cdf(x, b)
                out[first : first + _ROWS, done : done + x.shape[1]] = x
                done += x.shape[1]
        return out

    # The entry points skip Numba's dispatch on argument types, a tenth of a step's time. They
    # require arrays of exactly these types and dimensions.
    packed = _packed[task]
    steps: list[StepLane]
    if packed.size <= SMALL:
        prefix = packed
        signatures = kernels.PACKED_LANE_FLOAT32, kernels.PACKED_LANE_FLOAT64
        steps = [kernels.step_packed_lane.get_overload(types) for types in signatures]
    else:
        prefix = packed[:0]
        signatures = kernels.LANE_FLOAT32, kernels.LANE_FLOAT64
        entries = [kernels.step_lane.get_overload(types) for types in signatures]
        steps = [functools.partial(entry, packed) for entry in entries]

    def new_lane() -> tuple[Array, Array]:
        buffer = np.concatenate([prefix, np.zeros(kernels.lane_size(packed))])
        return buffer, buffer[prefix.size : prefix.size + LANE_STATE + task.spec.state_dim]

    step_many = functools.partial(kernels.step_many.get_overload(kernels.STEP_MANY), packed)
    return Engine("numba", new_lane, steps[0], steps[1], step_many, optimal_action)


def _numpy_engine(task: Task) -> Engine:
    S = task.spec.state_dim

    def new_lane() -> tuple[Array, Array]:
        lane = np.zeros(LANE_STATE + S)
        return lane, lane

    def step_one(
        lane: Array,
        action: npt.NDArray[Any],
        optimal: Array,
        observation: Observation,
    ) -> tuple[float, float]:
        values, ends = lane[LANE_VALUES:LANE_STATE, None, None], np.empty((2, 1), dtype=bool)
        s, moved = lane[LANE_STATE:, None], np.empty((S, 1))
        t, accumulated = lane[[LANE_T]].astype(np.int64), values[ACCUMULATED_REWARD]
        if action.size != task.spec.action_dim or not step_many(
            s, t, accumulated, action.astype(np.float64)[None], moved,
            observation[None], optimal[None], values, ends,
        ):  # fmt: skip
            return 0.0, -1.0
        lane[LANE_T] += 1.0
        lane[LANE_STATE:] = moved[:, 0]
        return values[REWARD].item(), float(ends[0, 0] + 2 * ends[1, 0])

    def step_many(
        s: Array,
        t: npt.NDArray[np.int64],
        accumulated: Array,
        action: Array,
        moved: Array,
        observation: Observation,
        optimal: Array,
        values: Array,
        ends: Mask,
    ) -> bool:
        if not np.isfinite(action).all():
            return False
        done = step(task, np.ascontiguousarray(s.T), t, accumulated.T, action)
        moved[:] = done.state.T
        observed = observe(task.spec, done.state, t + 1, done.accumulated_reward)
        observation[:, : observed.shape[1]] = observed  # a stream may append its phase
        optimal[:] = done.optimal_action
        values[SIMILARITY] = done.similarity.T
        values[STEP_REWARD] = done.step_reward.T
        values[REGRET] = 1.0 - done.step_reward.T
        values[REWARD] = done.reward.T
        values[ACCUMULATED_REWARD] = accumulated[:] = done.accumulated_reward.T
        ends[:] = done.terminated, done.truncated
        t += 1
        return True

    def optimal_action(s: Array) -> Array:
        blocks = [task.policy(s[first : first + _ROWS]) for first in range(0, len(s), _ROWS)]
        return np.concatenate(blocks) if blocks else np.empty((0, task.spec.action_dim))

    return Engine("numpy", new_lane, step_one, step_one, step_many, optimal_action)
