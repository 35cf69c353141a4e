"""`Engine`: the step and the oracle of a task, by machine code where Numba is installed.

Without it, by NumPy. Both have the same functions with the same arguments, so an environment works
with either. States and distractors are bit-equal between them, oracle and rewards agree to 1e-12,
and what an agent sees through a mixing agrees to the rounding of float32.
"""

from __future__ import annotations

import functools
import os
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from sme_registry.compiled.arrays import (
    ACCUMULATED_REWARD,
    COST,
    HAS_MORE,
    LANE_STATE,
    LANE_T,
    LANE_VALUES,
    MORE_COST,
    MORE_OWN,
    MORE_SAFE_REGRET,
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
    REGRET,
    REWARD,
    ROWS_WITH_SAFETY,
    SAFE_REGRET,
    SIMILARITY,
    STEP_REWARD,
)
from sme_registry.compiled.notice import compiling
from sme_registry.io import choice, is_installed, require_packages
from sme_registry.task import Task, observe, step
from sme_registry.task.draw import Array, Layer, counted
from sme_registry.task.task import through

Backend = Literal["numba", "numpy"]
BACKEND_VARIABLE = "SME_BACKEND"
SMALL = 8192  # numbers of a packed task that each buffer may hold a copy of: 64 KiB
_ROWS = 1024  # states per block of the oracle: a layer of 512 KiB at the default width, in cache

Observation: TypeAlias = npt.NDArray[np.float32]
Mask: TypeAlias = npt.NDArray[np.bool_]

StepOne: TypeAlias = Callable[[Array, npt.NDArray[Any], Array, Observation], tuple[float, float]]
"""One step of one single agent's environment; see `kernels.step_lane` without its packed task.

From a buffer and an action to the reward and the end; it writes the buffer, `optimal` `[A]` (with
`safety` `[3A]`) and the observation.
"""

StepMany: TypeAlias = Callable[
    [Array, npt.NDArray[np.int64], Array, Array, Array, Observation, Array, Array, Mask], bool
]
"""One step of `B` environments of n agents; see `kernels.step_many` without its packed task."""

AddMany: TypeAlias = Callable[[Array, Array, Array, Array, Array, Array, Observation, Array], None]
"""What `safety` and `observation` add to it; see `safety_observation.add_many`."""

Network: TypeAlias = Callable[[Array], Array]
"""From inputs channel by channel, `[in, B]`, to outputs, fresh `[out, B]`."""


@dataclass(frozen=True, eq=False)
class Engine:
    """A task's step and oracle, ready to call.

    Attributes:
      backend: "numba" or "numpy".
      new_buffer: makes the buffer of a single environment at t = 0, to pass to its steps, and two
        views of it: the entries of `compiled.arrays` `[LANE_STATE + S]`, and those behind them
        `[MORE_OWN + 2 + m]`, none without `safety` and `observation`.
      step_float32: one step of one environment, for float32 actions.
      step_float64: the same for float64 actions.
      step_many: one step of a batch.
      add_many: the rest of it; None without `safety` and `observation`.
      seen: what agents see, `[S + m, B]`, of states and distractors `[S + m, B]`.
      optimal_action: π* of `[B, S]` states, any number of them, in blocks.
    """

    backend: Backend
    new_buffer: Callable[[], tuple[Array, Array, Array]]
    step_float32: StepOne
    step_float64: StepOne
    step_many: StepMany
    add_many: AddMany | None
    seen: Network
    optimal_action: Callable[[Array], Array]


def chosen_backend() -> Backend:
    """The back-end of the environment variable SME_BACKEND; by default Numba where it is installed.

    Raises OptionError where the variable names none, MissingDependencyError without Numba.
    """
    asked = os.environ.get(BACKEND_VARIABLE, "auto")
    choice(BACKEND_VARIABLE, asked, ("auto", "numba", "numpy"))
    if asked == "numba":
        purpose = f"{BACKEND_VARIABLE}='numba'"
        require_packages(purpose, {"numba": "Numba"}, "fast", otherwise="unset the variable")
    return "numba" if is_installed("numba") and asked != "numpy" else "numpy"


_packed: weakref.WeakKeyDictionary[Task, tuple[Array, Array]] = weakref.WeakKeyDictionary()


def engine(task: Task, backend: Backend | None = None) -> Engine:
    """The engine of a task; cheap, as engines of one task share its packed numbers.

    `backend` is "numba" or "numpy"; None takes `chosen_backend()`.
    """
    make = _numba_engine if (backend or chosen_backend()) == "numba" else _numpy_engine
    return make(task)


def network(
    layers: Sequence[Layer], *, uniform: bool = True, backend: Backend | None = None
) -> Network:
    """Layers y = Φ(W x + b) beside π*, such as limits and mixings; not `uniform`: y = W x + b.

    As in the step, sums run in an order that does not depend on the batch, so that a batch equals
    its singles bit for bit.
    """
    if (backend or chosen_backend()) == "numpy":
        return functools.partial(_network_with_numpy, tuple(layers), uniform)
    with compiling():
        from sme_registry.compiled import kernels
    packed = kernels.pack_layers(layers)
    run = kernels.network.get_overload(kernels.NETWORK)

    def compiled(x: Array) -> Array:
        out = np.empty((len(layers[-1].b), x.shape[1]))
        if out.size:  # the compiled loop goes by blocks, of which there must be one
            run(packed, np.ascontiguousarray(x), uniform, out)  # another layout would be misread
        return out

    return compiled


def draw(own: Array, count: int) -> Array:
    """The next random numbers `[B, count]` in (0, 1) of distractors; `own` `[…, B]` counts them."""
    key, drawn = own[[OWN_KEY, OWN_DRAWN]].astype(np.uint64)
    own[OWN_DRAWN] += count
    return counted(key, drawn + np.uint64(1), count)


def _has_more(task: Task) -> bool:
    return task.spec.safety is not None or task.spec.observation is not None


def _more_numbers(task: Task) -> int:
    return MORE_OWN + OWN_DISTRACTORS + task.spec.distractors if _has_more(task) else 0


def _seen(task: Task, backend: Backend) -> Network:
    if not task.mixing:
        return np.copy
    uniform = task.spec.mixing == "nonlinear"
    return network(task.mixing, uniform=uniform, backend=backend)


def _numba_engine(task: Task) -> Engine:
    with compiling():  # where nothing is cached yet; else it loads Numba: 0.3 s of CPU
        from sme_registry.compiled import kernels

        if _has_more(task):
            from sme_registry.compiled import safety_observation

    if task not in _packed:
        more = safety_observation.pack(task) if _has_more(task) else np.empty(0)
        _packed[task] = kernels.pack(task), more
    plain, more = _packed[task]
    one, one_packed = kernels.step_lane, kernels.step_packed_lane
    room, add_many = 0, None
    if _has_more(task):
        one, one_packed = safety_observation.step_lane, safety_observation.step_packed_lane
        room = safety_observation.more_size(more)
        add_entry = safety_observation.add_many.get_overload(safety_observation.ADD_MANY)
        add_many = functools.partial(add_entry, more)

    # The entry points skip Numba's dispatch on argument types, a tenth of a step's time. They
    # require arrays of exactly these types and dimensions.
    packed = np.concatenate([plain, more])
    steps: list[StepOne]
    if packed.size <= SMALL:
        prefix = packed
        signatures = kernels.PACKED_LANE_FLOAT32, kernels.PACKED_LANE_FLOAT64
        steps = [one_packed.get_overload(types) for types in signatures]
    else:
        prefix = packed[:0]
        signatures = kernels.LANE_FLOAT32, kernels.LANE_FLOAT64
        steps = [functools.partial(one.get_overload(types), packed) for types in signatures]
    behind = prefix.size + kernels.lane_size(plain)

    def new_buffer() -> tuple[Array, Array, Array]:
        buffer = np.zeros(behind + room)
        buffer[: prefix.size] = prefix
        lane = buffer[prefix.size : prefix.size + LANE_STATE + task.spec.state_dim]
        return buffer, lane, buffer[behind : behind + _more_numbers(task)]

    def optimal_action(s: Array) -> Array:
        out = np.empty((len(s), task.spec.action_dim))
        for first in range(0, len(s), _ROWS):
            block, channel = s[first : first + _ROWS], 0
            for channels, layers in zip(task.observed, task.policies, strict=True):
                x = block if len(channels) == task.spec.state_dim else block[:, channels]
                for W, b in layers:
                    x = x @ W.T  # BLAS for the product, compiled code for Φ, which is the cost
                    kernels.add_and_normal_cdf(x, b)
                out[first : first + _ROWS, channel : channel + x.shape[1]] = x
                channel += x.shape[1]
        return out

    many = functools.partial(kernels.step_many.get_overload(kernels.STEP_MANY), plain)
    seen = _seen(task, "numba")
    return Engine("numba", new_buffer, steps[0], steps[1], many, add_many, seen, optimal_action)


def _numpy_engine(task: Task) -> Engine:
    S, A = task.spec.state_dim, task.spec.action_dim
    seen = _seen(task, "numpy")
    add_many = _add_with_numpy(task, seen) if _has_more(task) else None

    def new_buffer() -> tuple[Array, Array, Array]:
        buffer = np.zeros(LANE_STATE + S + _more_numbers(task))
        return buffer, buffer[: LANE_STATE + S], buffer[LANE_STATE + S :]

    def step_one(
        buffer: Array, action: npt.NDArray[Any], optimal: Array, observation: Observation
    ) -> tuple[float, float]:
        lane, more = buffer[: LANE_STATE + S], buffer[LANE_STATE + S :]
        before, after = lane[LANE_STATE:, None].copy(), np.empty((S, 1))
        values, ends = np.zeros((ROWS_WITH_SAFETY, 1, 1)), np.empty((2, 1), dtype=bool)
        t = lane[[LANE_T]].astype(np.int64)
        accumulated = lane[[LANE_VALUES + ACCUMULATED_REWARD], None]
        actions = action.astype(np.float64)[None]
        if action.size != A or not step_many(
            before, t, accumulated, actions, after,
            observation[None], optimal[None, :A], values, ends,
        ):  # fmt: skip
            return 0.0, -1.0
        lane[LANE_T] += 1.0
        lane[LANE_VALUES:LANE_STATE] = values[: LANE_STATE - LANE_VALUES, 0, 0]
        lane[LANE_STATE:] = after[:, 0]
        end = float(ends[0, 0] + 2 * ends[1, 0])
        if add_many is None:
            return values[REWARD].item(), end
        limits = optimal[A:].reshape(-1, 1, A)
        own, observations = more[MORE_OWN:, None], observation[None]
        add_many(own, before, after, actions, optimal[None, :A], values, observations, limits)
        more[[MORE_COST, MORE_SAFE_REGRET]] = values[[COST, SAFE_REGRET], 0, 0]
        return values[REWARD].item(), end + HAS_MORE

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
        result = step(task, np.ascontiguousarray(s.T), t, accumulated.T, action)
        moved[:] = result.state.T
        observed = observe(task.spec, result.state, t + 1, result.accumulated_reward)
        observation[:, : observed.shape[1]] = observed  # a stream may append its phase
        optimal[:] = result.optimal_action
        values[SIMILARITY] = result.similarity.T
        values[STEP_REWARD] = result.step_reward.T
        values[REGRET] = 1.0 - result.step_reward.T
        values[REWARD] = result.reward.T
        values[ACCUMULATED_REWARD] = accumulated[:] = result.accumulated_reward.T
        ends[:] = result.terminated, result.truncated
        t += 1
        return True

    def optimal_action(s: Array) -> Array:
        blocks = [task.policy(s[first : first + _ROWS]) for first in range(0, len(s), _ROWS)]
        return np.concatenate(blocks) if blocks else np.empty((0, A))

    return Engine(
        "numpy", new_buffer, step_one, step_one, step_many, add_many, seen, optimal_action
    )


def _add_with_numpy(task: Task, seen: Network) -> AddMany:
    S, m = task.spec.state_dim, task.spec.distractors
    limiting = network(task.limiting, backend="numpy") if task.limiting else None

    def add_many(
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
            limits[0] = task.limit_of(limiting(before).T)
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

    return add_many


def _next_distractors(task: Task, own: Array, action: Array) -> Array:
    """The next distractors of each environment, `[B, m]`."""
    if task.distractor_transition is None:
        return draw(own, task.spec.distractors)
    if task.spec.dynamics == "autonomous":
        action = draw(own, task.spec.action_dim)
    return task.distractor_step(own[OWN_DISTRACTORS:].T, action)


def _network_with_numpy(layers: Sequence[Layer], uniform: bool, x: Array) -> Array:
    rows = np.ascontiguousarray(x.T)[:, None, :]  # each environment a product of its own
    if uniform:
        rows = through(layers, rows)
    else:
        for W, b in layers:
            rows = rows @ W.T + b
    return np.ascontiguousarray(rows[:, 0, :].T)
