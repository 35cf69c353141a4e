"""`TaskParams`: a drawn task as a pytree of arrays; several of one group, padded to equal shapes.

Everything but shapes is data, so one program serves all settings of k, T, r_min and D and all
draws. Padding is exact: padded columns of W and entries of b are 0, so padded states stay 0; padded
inner units have no weights into the next layer; padded inner layers are skipped; padded action
channels have rows of zeros in W, and `action_mask` is False there.

`S` state_dim, `A` action_dim, `L` complexity, `H` hidden_width, each of the padded shape.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from sme_registry.errors import OptionError, SpecError
from sme_registry.io import choice
from sme_registry.jax import pairs
from sme_registry.jax.pairs import Pair
from sme_registry.spec import SMESpec, SpecLike
from sme_registry.spec.validation_errors import short_repr
from sme_registry.task import Task, load_task
from sme_registry.task.draw import GRID_BITS

SUPPORTED_FIELDS = frozenset(
    (
        *("schema_version", "seed", "state_dim", "action_dim", "k", "r_min", "D"),
        *("complexity", "horizon", "hidden_width", "policy_init", "rotation"),
    )
)
"""Fields of a spec that these modules implement; any other must have its default."""

Host = npt.NDArray[Any]


class Shape(NamedTuple):
    """What decides which program a task belongs to.

    Attributes:
      state_dim, action_dim: S and A.
      complexity: L; a task of L = 1 and one of L > 1 never share a program.
      hidden_width: H; 0 where L = 1, which has no inner layer.
    """

    state_dim: int
    action_dim: int
    complexity: int
    hidden_width: int

    @classmethod
    def of(cls, spec: SMESpec) -> Shape:
        """The exact shape of a spec's task."""
        width = spec.hidden_width if spec.complexity > 1 else 0
        return cls(spec.state_dim, spec.action_dim, spec.complexity, width)

    @classmethod
    def covering(cls, shapes: Iterable[Shape]) -> Shape:
        """The smallest shape to which all of these can be padded.

        Raises:
          OptionError: there is none: no shape, or L = 1 beside L > 1.
        """
        shapes = list(shapes)
        if not shapes:
            raise OptionError("specs=[]: must have at least one spec.")
        covering = cls(*map(max, zip(*shapes, strict=True)))
        for shape in shapes:
            _check_covered(shape, covering)
        return covering


class Layer(NamedTuple):
    """Uniform layers y = Φ(W x + b): `W [out, in]`, `b [out]`; stacked layers have an axis more."""

    W: jax.Array
    b: jax.Array


class InnerLayers(NamedTuple):
    """The layers before the last, where L > 1.

    Attributes:
      first: S → H.
      stacked: the L − 2 layers H → H, `W [L − 2, H, H]` and `b [L − 2, H]`.
      active: `[L − 2]` bool, False for padding.
    """

    first: Layer
    stacked: Layer
    active: jax.Array


class TaskParams(NamedTuple):
    """A task; of several tasks, each array has a leading axis of lanes.

    Attributes:
      state_dim, action_dim: the task's own S and A, int32.
      k, horizon: int32.
      r_min, D: of the dtype of rewards.
      W: `[A, S]` transition matrix, float64; for states as pairs, uint32 in units of 2⁻²⁹.
      b: `[S]` transition offset, float64; for states as pairs, a pair.
      inner: the optimal policy's inner layers; None where L = 1.
      output: its last layer, of the dtype of the oracle.
      phase: `[P]` float32, the one-hot with which observations end in a stream that has
        `observes_phase`; elsewhere P = 0.
    """

    state_dim: jax.Array
    action_dim: jax.Array
    k: jax.Array
    horizon: jax.Array
    r_min: jax.Array
    D: jax.Array
    W: jax.Array
    b: jax.Array | Pair
    inner: InnerLayers | None
    output: Layer
    phase: jax.Array

    @property
    def max_steps_in_episode(self) -> jax.Array:
        """The horizon, by gymnax's name."""
        return self.horizon

    @property
    def action_mask(self) -> jax.Array:
        """`[A]` bool, False for padded channels; of one task."""
        return jnp.arange(self.W.shape[-2]) < self.action_dim

    @property
    def state_mask(self) -> jax.Array:
        """`[S]` bool, False for padded channels; of one task."""
        return jnp.arange(self.W.shape[-1]) < self.state_dim


def task_params(
    specs: SpecLike | Sequence[SpecLike],
    *,
    shape: Shape | None = None,
    dtype: Any = jnp.float64,
    states: str = "float64",
) -> TaskParams:
    """Draw tasks and put them on the default device.

    Args:
      specs: a task, or a sequence of tasks, one for each lane: specs, ids, digests or paths.
      shape: pad to this shape, a `Shape` or a tuple of its fields; None for the smallest that
        covers all tasks.
      dtype: of the oracle and of rewards, float64 or float32.
      states: "float64"; or "pairs" of uint32, with the same bits, for devices without float64.
        With `dtype=jnp.float32`, too, `env.reset` and `env.step` need no float64 at all.
        `pairs.from_float64` and `pairs.to_float64` convert states.

    Returns:
      One task, or lanes of tasks stacked along a leading axis.

    Raises:
      SpecError: a field that only NumPy implements, such as `team`; or see `load_task`.
      OptionError: no task, a task larger than `shape`, no shape, L = 1 beside L > 1, or another
        dtype or kind of states.
      UnknownNameError, ResourceLimitError, FingerprintMismatchError: see `load_task`.
    """
    single = isinstance(specs, SMESpec | dict | str | os.PathLike)
    listed: Any = [specs] if single else specs
    lanes = _lanes([load_task(spec) for spec in listed], shape, dtype, states)
    return cast(TaskParams, jax.tree.map(jnp.asarray, lanes[0])) if single else _stacked(lanes)


def stacked_params(tasks: Sequence[Task], shape: Shape | None = None) -> TaskParams:
    """Drawn tasks, one for each lane, in float64; see `task_params`."""
    return _stacked(_lanes(tasks, shape, np.float64, "float64"))


def _lanes(tasks: Sequence[Task], shape: Shape | None, dtype: Any, states: str) -> list[TaskParams]:
    """Tasks padded to one shape, with NumPy's arrays in place of JAX's."""
    as_pairs = choice("states", states, ("float64", "pairs")) == "pairs"
    dtype = np.dtype(dtype)
    if dtype not in (np.float64, np.float32):
        raise OptionError(f"dtype={dtype.name}: must be float64 or float32.")
    for task in tasks:
        check_supported(task.spec)
    smallest = Shape.covering(Shape.of(task.spec) for task in tasks)
    shape = smallest if shape is None else _checked_shape(shape)
    _check_covered(smallest, shape)
    return [_padded(task, shape, dtype, as_pairs) for task in tasks]


def _stacked(lanes: Sequence[TaskParams]) -> TaskParams:
    stacked = jax.tree.map(lambda *parts: jnp.asarray(np.stack(parts)), *lanes)
    return cast(TaskParams, stacked)


def check_supported(spec: SMESpec) -> None:
    """Raise SpecError if a field outside `SUPPORTED_FIELDS` has another value than its default."""
    for name, field in type(spec).model_fields.items():
        value = getattr(spec, name)
        if name not in SUPPORTED_FIELDS and value != field.get_default(call_default_factory=True):
            raise SpecError(
                f"{name}={short_repr(value)}: must be absent, since tasks in JAX have no {name}. "
                "Use the environments without JAX, and leave out --agents jax."
            )


def _checked_shape(shape: Any) -> Shape:
    numbers = isinstance(shape, tuple) and all(isinstance(extent, int) for extent in shape)
    if not numbers or len(shape) != len(Shape._fields):
        raise OptionError(
            f"shape={short_repr(shape)}: must be a Shape of {', '.join(Shape._fields)}, such as "
            "Shape(8, 4, 1, 0). Leave it out for the smallest that covers the tasks."
        )
    return Shape(*shape)


def _check_covered(shape: Shape, covering: Shape) -> None:
    if (shape.complexity == 1) != (covering.complexity == 1):
        raise OptionError(
            f"complexity={shape.complexity} padded to {covering.complexity}: must be 1 for all "
            "tasks of a program, or above 1 for all. Make two programs."
        )
    for name, own, largest in zip(Shape._fields, shape, covering, strict=True):
        if own > largest:
            raise OptionError(
                f"shape.{name}={largest}: must be at least {own}, the largest of the tasks."
            )


def _padded(task: Task, shape: Shape, dtype: np.dtype[Any], as_pairs: bool) -> TaskParams:
    """A task with NumPy's arrays in place of JAX's."""
    spec, (S, A, L, H) = task.spec, shape
    W, b = _pad(task.W, (A, S)), _pad(task.b, (S,))
    *inner, output = task.policies[0]
    fields: dict[str, Any] = {
        "state_dim": np.int32(spec.state_dim),
        "action_dim": np.int32(spec.action_dim),
        "k": np.int32(spec.k),
        "horizon": np.int32(spec.horizon),
        "r_min": dtype.type(spec.r_min),
        "D": dtype.type(spec.D),
        "W": (W * 2**GRID_BITS).astype(np.uint32) if as_pairs else W,
        "b": pairs.from_float64(b) if as_pairs else b,
        "inner": _inner_layers(inner, shape, dtype) if inner else None,
        "output": _layer(output, (A, H if L > 1 else S), dtype),
        "phase": np.zeros(0, np.float32),
    }
    return TaskParams(**fields)


def _inner_layers(layers: Sequence[Any], shape: Shape, dtype: np.dtype[Any]) -> InnerLayers:
    S, _, L, H = shape
    first, *others = layers
    W: Any = np.zeros((L - 2, H, H), dtype)
    b: Any = np.zeros((L - 2, H), dtype)
    active: Any = np.arange(L - 2) < len(others)
    for i, layer in enumerate(others):
        W[i], b[i] = _layer(layer, (H, H), dtype)
    return InnerLayers(_layer(first, (H, S), dtype), Layer(W, b), active)


def _layer(layer: Any, shape: tuple[int, int], dtype: np.dtype[Any]) -> Any:
    parts: Any = (_pad(part, shape[: part.ndim]).astype(dtype) for part in layer)
    return Layer(*parts)


def _pad(array: Host, shape: tuple[int, ...]) -> Host:
    return np.pad(array, [(0, to - size) for size, to in zip(array.shape, shape, strict=True)])
