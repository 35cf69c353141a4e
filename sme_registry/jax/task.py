"""`TaskParams`: a drawn task as a pytree of arrays; several of one group, padded to equal shapes.

Everything but shapes is data, so one program serves all settings of k, T, r_min and D and all
draws. Padding is exact: padded columns of W and entries of b are 0, so padded states stay 0; padded
inner units have no weights into the next layer; padded inner layers are skipped; padded action
channels have rows of zeros in W, and `action_mask` is False there.

The networks of `safety` and the mixing of an `observation` are padded alike. What these two fields
change of the program itself is a `Form`, which all lanes share.

`S` state_dim, `A` action_dim, `L` complexity, `H` hidden_width, each of the padded shape; `m`
distractors, which are not padded.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
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
from sme_registry.spec.document import short_repr
from sme_registry.task import Task, load_task
from sme_registry.task.draw import GRID_BITS

SUPPORTED_FIELDS = frozenset(
    (
        *("schema_version", "seed", "state_dim", "action_dim", "k", "r_min", "D"),
        *("complexity", "horizon", "hidden_width", "policy_init", "rotation"),
        *("safety", "observation"),
    )
)
"""Fields of a spec that these modules implement; any other must have its default."""

Host = npt.NDArray[Any]


class Shape(NamedTuple):
    """What decides which program a task belongs to: S, A, L and H, which is 0 where L = 1."""

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
        """The smallest shape to which all of these can be padded."""
        shapes = list(shapes)
        if not shapes:
            raise OptionError("specs=[]: must have at least one spec.")
        covering = cls(*map(max, zip(*shapes, strict=True)))
        for shape in shapes:
            _check_covered(shape, covering)
        return covering


@jax.tree_util.register_static
@dataclass(frozen=True)
class Form:
    """What `safety` and `observation` change of a program; all its lanes have the same.

    m distractors move by `dynamics`, "noise", "autonomous" or "driven"; `mixing_depth` is None
    unless the mixing is nonlinear.
    """

    safety: bool = False
    distractors: int = 0
    dynamics: str | None = None
    mixing: str = "none"
    mixing_depth: int | None = None

    @classmethod
    def of(cls, spec: SMESpec) -> Form:
        """The form of a spec's task."""
        safety, seen = spec.safety is not None, spec.observation
        if seen is None:
            return cls(safety)
        return cls(safety, seen.distractors, seen.dynamics, seen.mixing, seen.mixing_depth)


class Layer(NamedTuple):
    """Uniform layers y = Φ(W x + b): `W [out, in]`, `b [out]`; stacked layers have an axis more."""

    W: jax.Array
    b: jax.Array


class InnerLayers(NamedTuple):
    """The layers before the last: S → H, and L − 2 of H → H, not `active` where padded."""

    first: Layer
    stacked: Layer
    active: jax.Array


class Limits(NamedTuple):
    """What limits the action channels of a task with `safety`: τ, and the layers of v."""

    tightness: jax.Array
    inner: InnerLayers | None
    output: Layer


class Observing(NamedTuple):
    """What the agent of a task with `observation` sees in place of the state.

    `W [A, m]` and `b [m]` move the distractors and are None where no action does; `mixing` has the
    layers from state and distractors to what the agent sees, `W [layers, S + m, S + m]`.
    """

    W: jax.Array | None
    b: jax.Array | Pair | None
    mixing: Layer | None


class TaskParams(NamedTuple):
    """A task; of several tasks, each array has a leading axis of lanes.

    `W [A, S]` and `b [S]` are float64 (uint32 and a pair, for states as pairs); r_min, D and the
    layers have the dtype of rewards. `inner` is None where L = 1, `limits` without `safety`, and
    `observing` without `observation`. `phase` is the one-hot `[P]` with which observations end in a
    stream that has `observes_phase`; elsewhere P = 0.
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
    limits: Limits | None = None
    observing: Observing | None = None
    form: Form = Form()

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
    """Draw tasks and put them on the default device: one, or lanes along a leading axis.

    Args:
      specs: a task, or a sequence of tasks, one for each lane: specs, ids, digests or paths.
      shape: pad to this shape; None for the smallest that covers all tasks.
      dtype: of the oracle and of rewards, float64 or float32.
      states: "float64"; or "pairs" of uint32, with the same bits, for devices without float64.
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
    _check_forms([Form.of(task.spec) for task in tasks])
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


def _check_forms(forms: Sequence[Form]) -> None:
    for index, form in enumerate(forms):
        if form != forms[0]:
            raise OptionError(
                f"specs[{index}]: must have safety and observation like specs[0]: both with limits "
                "or both without, and equal distractors, dynamics, mixing and mixing_depth. Make "
                "two programs."
            )


def _padded(task: Task, shape: Shape, dtype: np.dtype[Any], as_pairs: bool) -> TaskParams:
    """A task with NumPy's arrays in place of JAX's."""
    spec, (S, A, *_) = task.spec, shape
    W, b = _transition(task.W, task.b, (A, S), as_pairs)
    inner, output = _network(task.policies[0], shape, dtype)
    fields: dict[str, Any] = {
        "state_dim": np.int32(spec.state_dim),
        "action_dim": np.int32(spec.action_dim),
        "k": np.int32(spec.k),
        "horizon": np.int32(spec.horizon),
        "r_min": dtype.type(spec.r_min),
        "D": dtype.type(spec.D),
        "W": W,
        "b": b,
        "inner": inner,
        "output": output,
        "phase": np.zeros(0, np.float32),
        "form": Form.of(spec),
    }
    if spec.safety is not None:
        tightness: Any = dtype.type(spec.safety.tightness)
        fields["limits"] = Limits(tightness, *_network(task.limiting, shape, dtype))
    if spec.observation is not None:
        fields["observing"] = _observing(task, shape, dtype, as_pairs)
    return TaskParams(**fields)


def _transition(W: Host, b: Host, shape: tuple[int, int], as_pairs: bool) -> tuple[Any, Any]:
    """W and b of a transition, padded to `shape` `[A, S]`."""
    W, b = _pad(W, shape), _pad(b, shape[1:])
    if as_pairs:
        return (W * 2**GRID_BITS).astype(np.uint32), pairs.from_float64(b)
    return W, b


def _network(
    layers: Sequence[Any], shape: Shape, dtype: np.dtype[Any]
) -> tuple[InnerLayers | None, Layer]:
    """The inner layers and the last one of a network from S to A."""
    S, A, L, H = shape
    *inner, output = layers
    padded: Layer = _layer(output, (A, H if L > 1 else S), dtype)
    return _inner_layers(inner, shape, dtype) if inner else None, padded


def _observing(task: Task, shape: Shape, dtype: np.dtype[Any], as_pairs: bool) -> Observing:
    S, A, *_ = shape
    m = task.spec.distractors
    W, b, mixing = None, None, None
    if task.distractor_transition is not None:
        W, b = _transition(*task.distractor_transition, (A, m), as_pairs)
    if task.mixing:
        kept = np.r_[: task.spec.state_dim, S : S + m]
        mixing_W: Any = np.zeros((len(task.mixing), S + m, S + m), dtype)
        mixing_b: Any = np.zeros((len(task.mixing), S + m), dtype)
        for i, layer in enumerate(task.mixing):
            mixing_W[i][np.ix_(kept, kept)], mixing_b[i, kept] = layer
        mixing = Layer(mixing_W, mixing_b)
    return Observing(W, b, mixing)


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
