"""`Engine`: the step and the oracle of a task, by machine code where Numba is installed.

Without it, by NumPy. Both have the same functions with the same arguments, so an environment works
with either. States and distractors are bit-equal between them, oracle and rewards agree to 1e-12,
and what an agent sees through a mixing agrees to the rounding of float32.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from sme_registry.io import choice, is_installed, require_packages
from sme_registry.task import Task, step
from sme_registry.task.draw import Layer, counted
from sme_registry.task.task import (
    ACCUMULATED_REWARD,
    BUFFER_STATE,
    BUFFER_T,
    BUFFER_VALUES,
    NUMBERS,
    OWN_DISTRACTORS,
    OWN_DRAWN,
    OWN_KEY,
    REWARD,
    Array,
    Indices,
    Mask,
    Observation,
    own_rows,
)

Backend = Literal["numba", "numpy"]
BACKEND_VARIABLE = "SME_BACKEND"
SMALL = 8192  # numbers of a packed task that each buffer may hold a copy of: 64 KiB
_BLOCK = 1024  # states per block of the oracle: a layer of 512 KiB at the default width, in cache

_PATIENCE = 1.0  # seconds; loading what is already compiled takes a third of it
_NOTICE = (
    "sme_registry: Numba is preparing the environment's step. The first time on a machine, this "
    "takes some seconds; SME_BACKEND=numpy does without."
)

StepOne: TypeAlias = Callable[[Array, npt.NDArray[Any], Array, Observation], tuple[float, float]]
"""One step of a single agent's environment; see `kernels.step_one` without its packed task."""

StepMany: TypeAlias = Callable[
    [Array, Indices, Array, Array, Array, Array, Observation, Array, Array, Mask], bool
]
"""One step of `B` environments of n agents; see `kernels.step_many` without its packed task."""

Network: TypeAlias = Callable[[Array], Array]
"""From inputs channel by channel, `[in, B]`, to outputs, fresh `[out, B]`."""


@dataclass(frozen=True, eq=False)
class Engine:
    """A task's step and oracle, ready to call."""

    backend: Backend
    # The buffer of a single environment at t = 0, for its steps, and a view of its own entries.
    new_buffer: Callable[[], tuple[Array, Array]]
    step_one: Callable[[np.dtype[Any]], StepOne]  # for actions of float32 or float64
    step_many: Callable[[], StepMany]
    seen: Network  # what agents see, of states and distractors
    optimal_action: Callable[[Array], Array]  # π* `[B, A]` of states `[B, S]`, in blocks


def chosen_backend() -> Backend:
    """That of the environment variable SME_BACKEND; by default Numba where it is installed."""
    asked = os.environ.get(BACKEND_VARIABLE, "auto")
    choice(BACKEND_VARIABLE, asked, ("auto", "numba", "numpy"))
    if asked == "numba":
        purpose = f"{BACKEND_VARIABLE}='numba'"
        require_packages(purpose, {"numba": "Numba"}, "fast", otherwise="unset the variable")
    return "numba" if is_installed("numba") and asked != "numpy" else "numpy"


def engine(task: Task, backend: Backend | None = None) -> Engine:
    """The engine of a task. Cheap, as engines of one task share its packed numbers."""
    make = _numba_engine if (backend or chosen_backend()) == "numba" else _numpy_engine
    return make(task)


def network(
    layers: Sequence[Layer], *, uniform: bool = True, backend: Backend | None = None
) -> Network:
    """Layers y = Φ(W x + b) beside π*, such as limits and mixings; not `uniform`: y = W x + b.

    As in the step, sums run in an order that does not depend on the batch, so that a batch equals
    its singles bit for bit.
    """
    if not layers:
        return np.copy
    if (backend or chosen_backend()) == "numpy":
        return functools.partial(_network_with_numpy, tuple(layers), uniform)
    with compiling():
        from sme_registry.task import kernels
    packed = kernels.pack_layers(layers)
    run = machine_code(kernels.network, kernels.NETWORK)

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


@contextlib.contextmanager
def compiling() -> Iterator[None]:
    """Say on stderr that Numba compiles, if it takes long and a terminal or notebook shows it.

    Numba keeps what it compiled next to this package or in NUMBA_CACHE_DIR: once for each version.
    """
    timer = threading.Timer(_PATIENCE, _say_once)
    timer.daemon = True
    if sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules):
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


@functools.cache
def _say_once() -> None:
    print(_NOTICE, file=sys.stderr, flush=True)


def machine_code(function: Any, signature: Any) -> Callable[..., Any]:
    """The entry point of a kernel for arrays of these types, compiled where it is not yet.

    It skips Numba's dispatch on argument types, a tenth of a step's time, and requires arrays of
    exactly these types and dimensions.
    """
    if signature.args not in function.overloads:
        with compiling():
            function.compile(signature)
    entry: Callable[..., Any] = function.get_overload(signature)
    return entry


def _seen(task: Task, backend: Backend) -> Network:
    uniform = task.spec.mixing == "nonlinear"
    return network(task.mixing, uniform=uniform, backend=backend)


_packed: weakref.WeakKeyDictionary[Task, Array] = weakref.WeakKeyDictionary()


def _numba_engine(task: Task) -> Engine:
    with compiling():  # loads Numba: 0.3 s of CPU
        from sme_registry.task import kernels

    if task not in _packed:
        _packed[task] = kernels.pack(task)
    packed, parts = _packed[task], kernels.parts(task)
    is_small = packed.size <= SMALL
    prefix = packed if is_small else packed[:0]

    @functools.cache
    def step_one(dtype: np.dtype[Any]) -> StepOne:
        if is_small:
            entry = machine_code(kernels.step_packed, kernels.step_packed_of(parts, dtype))
            return functools.partial(entry, *parts)
        entry = machine_code(kernels.step_one, kernels.step_one_of(parts, dtype))
        return functools.partial(entry, *parts, packed)

    @functools.cache
    def step_many() -> StepMany:
        entry = machine_code(kernels.step_many, kernels.step_many_of(parts))
        return functools.partial(entry, *parts, packed)

    start, size = prefix.size, kernels.buffer_size(packed)

    def new_buffer() -> tuple[Array, Array]:
        buffer = np.concatenate([prefix, np.zeros(size)])
        return buffer, buffer[start : start + _entries(task)]

    def optimal_action(s: Array) -> Array:
        add_and_normal_cdf = machine_code(kernels.add_and_normal_cdf, kernels.ADD_AND_NORMAL_CDF)
        out = np.empty((len(s), task.spec.action_dim))
        for first in range(0, len(s), _BLOCK):
            block, channel = s[first : first + _BLOCK], 0
            for channels, layers in zip(task.observed, task.policies, strict=True):
                x = block if len(channels) == task.spec.state_dim else block[:, channels]
                for W, b in layers:
                    x = x @ W.T  # BLAS for the product, compiled code for Φ, which is the cost
                    add_and_normal_cdf(x, b)
                out[first : first + _BLOCK, channel : channel + x.shape[1]] = x
                channel += x.shape[1]
        return out

    seen = _seen(task, "numba")
    return Engine("numba", new_buffer, step_one, step_many, seen, optimal_action)


def _numpy_engine(task: Task) -> Engine:
    S, A, m = task.spec.state_dim, task.spec.action_dim, task.spec.distractors
    seen = _seen(task, "numpy")

    def new_buffer() -> tuple[Array, Array]:
        buffer = np.zeros(_entries(task))
        return buffer, buffer

    def step_one(
        buffer: Array, action: npt.NDArray[Any], actions: Array, observation: Observation
    ) -> tuple[float, float]:
        if action.size != A:
            return 0.0, -1.0
        s, own = buffer[BUFFER_STATE : BUFFER_STATE + S, None], buffer[BUFFER_STATE + S :, None]
        t = buffer[[BUFFER_T]].astype(np.int64)
        values, ends = np.zeros((len(NUMBERS), 1, 1)), np.empty((2, 1), dtype=bool)
        accumulated = buffer[[BUFFER_VALUES + ACCUMULATED_REWARD], None]
        if not step_many(
            s, t, accumulated, own, action.astype(np.float64)[None], s,
            observation[None], actions.reshape(-1, 1, A), values, ends,
        ):  # fmt: skip
            return 0.0, -1.0
        buffer[BUFFER_T] += 1.0
        buffer[BUFFER_VALUES:BUFFER_STATE] = values[:, 0, 0]
        return values[REWARD].item(), float(ends[0, 0] + 2 * ends[1, 0])

    def step_many(
        s: Array,
        t: Indices,
        accumulated: Array,
        own: Array,
        action: Array,
        moved: Array,
        observation: Observation,
        actions: Array,
        values: Array,
        ends: Mask,
    ) -> bool:
        if not np.isfinite(action).all():
            return False
        noise = own[OWN_DISTRACTORS + m + 1 :].T if task.spec.noise is not None else None
        result = step(task, np.ascontiguousarray(s.T), t, accumulated.T, action, noise)
        result.write(actions, values)
        accumulated[:] = result.accumulated_reward.T
        ends[:] = result.terminated, result.truncated
        t += 1
        moved[:] = result.state.T
        if m:
            d = own[OWN_DISTRACTORS:][:m]
            d[:] = _next_distractors(task, own, d.T, np.clip(action, 0.0, 1.0)).T
        observation[:, : S + m] = seen(np.concatenate([moved, own[OWN_DISTRACTORS:][:m]])).T
        observation[:, S + m] = t / task.spec.horizon
        waiting = np.minimum(result.accumulated_reward / task.spec.k, 1.0)
        observation[:, S + m + 1 :][:, : waiting.shape[1]] = waiting  # a stream appends its phase
        return True

    def optimal_action(s: Array) -> Array:
        blocks = [task.policy(s[first : first + _BLOCK]) for first in range(0, len(s), _BLOCK)]
        return np.concatenate(blocks) if blocks else np.empty((0, A))

    return Engine("numpy", new_buffer, lambda _: step_one, lambda: step_many, seen, optimal_action)


def _entries(task: Task) -> int:
    """The entries of a single environment that `task.task` names."""
    return BUFFER_STATE + task.spec.state_dim + own_rows(task.spec)


def _next_distractors(task: Task, own: Array, d: Array, action: Array) -> Array:
    if task.distractor_transition is None:
        return draw(own, task.spec.distractors)
    if task.spec.dynamics == "autonomous":
        action = draw(own, task.spec.action_dim)
    return task.distractor_step(d, action)


def _network_with_numpy(layers: Sequence[Layer], uniform: bool, x: Array) -> Array:
    rows = np.ascontiguousarray(x.T)[:, None, :]  # each environment a product of its own
    for W, b in layers:
        rows = rows @ W.T + b
        if uniform:
            rows = ndtr(rows)
    return np.ascontiguousarray(rows[:, 0, :].T)
