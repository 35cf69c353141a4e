"""`TaskParams`: a drawn task as a pytree of arrays; and its equations, as pure functions of it.

    s'  = ψ(s + a W + b),  ψ(x) = 2 |x − rint x|
    π*(s) = Φ(W_L Φ(… Φ(W_1 s + b_1) …) + b_L)
    r̃   = 1 − ‖a − π*(s)‖₁ / A
    r   = r̂ = max(0, 4 (r̃ − ¾)) if r̂ > r_min, else 0

with `safety`, v another such network:   ℓ(s) = 1 − 2τ v(s)
                                         cost(s, a) = mean_i max(0, a_i − ℓ_i(s)) / (2τ)
with `observation`, seen for s:          x = M(s, d)
    d' uniform (noise), or ψ(d + u W + b) for u uniform (autonomous) or u = a (driven)
with `shaping`, a potential:             P_t(s) = c (1 − t/T) φ(s)
with `noise`, in place of s':            ψ(s + a W + b + σ_s ζ)

Source: METHOD, sections 1, 8 to 10 and 12. States and distractors have the bits of `Task`'s. All
else is in the dtype of the params, within 1e-12 of `Task` in float64, whose order of summation
differs.
Everything but a `Form` is data, so one program serves all draws and all k, T, r_min and D.
`S` state_dim, `A` action_dim, `L` complexity, `H` hidden_width, `m` distractors.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from sme_registry.errors import OptionError, SpecError
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.document import short_repr
from sme_registry.spec.sme_spec import SpecLike
from sme_registry.task import Task
from sme_registry.task.loading import load_task

_UNROLLED = 16  # channels; above it the program would grow with A
# Uses of a key, which also draws a start from the first places of its stream.
_OF_START, _OF_STEP, _OF_NOISE = 2**32 - 1, 2**32 - 2, 2**32 - 3


@jax.tree_util.register_static
@dataclass(frozen=True)
class Form:
    """What decides how a task is compiled: all tasks of a program have the same."""

    state_dim: int
    action_dim: int
    complexity: int
    hidden_width: int
    safety: bool
    distractors: int = 0
    dynamics: str | None = None
    mixing: str = "none"
    mixing_depth: int | None = None
    compensated: bool = False
    shaping: bool = False
    noise: bool = False

    @classmethod
    def of(cls, spec: SMESpec) -> Form:
        width = spec.hidden_width if spec.complexity > 1 else 0
        form = cls(
            spec.state_dim, spec.action_dim, spec.complexity, width, spec.safety is not None,
            compensated=spec.compensated,
            shaping=spec.shaping is not None,
            noise=spec.noise is not None,
        )  # fmt: skip
        seen = spec.observation
        if seen is None:
            return form
        return dataclasses.replace(
            form,
            distractors=seen.distractors,
            dynamics=seen.dynamics,
            mixing=seen.mixing,
            mixing_depth=seen.mixing_depth,
        )


class UniformLayer(NamedTuple):
    """y = Φ(W x + b): `W [out, in]`, `b [out]`; stacked layers have an axis more."""

    W: jax.Array
    b: jax.Array


class InnerLayers(NamedTuple):
    """The layers before the last: S → H, and L − 2 of H → H."""

    first: UniformLayer
    stacked: UniformLayer


class Limits(NamedTuple):
    """What limits the action channels of a task with `safety`: τ, and the layers of v."""

    tightness: jax.Array
    inner: InnerLayers | None
    output: UniformLayer


class Observing(NamedTuple):
    """What the agent of a task with `observation` sees in place of the state.

    `W [A, m]` and `b [m]` move the distractors, None where no action does; `mixing` is M.
    """

    W: jax.Array | None
    b: jax.Array | None
    mixing: UniformLayer | None


class Shaping(NamedTuple):
    """c and g of a task with `shaping`, and the layer of φ, `W [1, S]` and `b [1]`; float64."""

    scale: jax.Array
    discount: jax.Array
    layer: UniformLayer


class StepDraws(NamedTuple):
    """The random numbers of a step: those of its distractors, and its noise ξ and ζ `[1 + S]`."""

    distractors: jax.Array | None
    noise: jax.Array | None


class TaskParams(NamedTuple):
    """A task; of several tasks, each array has a leading axis.

    `W [A, S]` and `b [S]` are float64; r_min, D and the layers have the dtype of rewards. `inner`
    is None where L = 1. `phase` is the one-hot `[P]` with which observations of some streams end. A
    is data: XLA would turn a division by a constant into a product, an ulp off.
    """

    action_dim: jax.Array
    k: jax.Array
    horizon: jax.Array
    r_min: jax.Array
    D: jax.Array
    W: jax.Array
    b: jax.Array
    inner: InnerLayers | None
    output: UniformLayer
    phase: jax.Array
    form: Form
    limits: Limits | None = None
    observing: Observing | None = None
    shaping: Shaping | None = None
    sigmas: jax.Array | None = None  # σ_r and σ_s of a task with `noise`, float64

    @property
    def max_steps_in_episode(self) -> jax.Array:
        """The horizon, by gymnax's name."""
        return self.horizon

    @property
    def channels(self) -> jax.Array:
        """`[A]`, all true, which XLA cannot know: sums over channels keep their bits by it."""
        return jnp.arange(self.form.action_dim) < self.action_dim


class StepOutcome(NamedTuple):
    """What actions are worth in their states, `[...]` each; safe_regret is r of π_safe minus r.

    `price` is paid on top, in a compensated task.
    """

    similarity: jax.Array
    step_reward: jax.Array
    cost: jax.Array | None = None
    safe_regret: jax.Array | None = None
    price: jax.Array | None = None


def task_params(specs: SpecLike | Sequence[SpecLike], *, dtype: Any = jnp.float64) -> TaskParams:
    """Draw a task, or several of one `Form` for `jax.vmap`; `dtype` is that of rewards."""
    if np.dtype(dtype) not in (np.float64, np.float32):
        raise OptionError(f"dtype={np.dtype(dtype).name}: must be float64 or float32.")
    if isinstance(specs, SMESpec | dict | str | os.PathLike):
        params = jax.tree.map(jnp.asarray, _drawn(load_task(specs), np.dtype(dtype)))
        return cast("TaskParams", params)
    return stacked_params([load_task(spec) for spec in specs], dtype)


def stacked_params(tasks: Sequence[Task], dtype: Any = np.float64) -> TaskParams:
    """Drawn tasks with a leading axis; see `task_params`."""
    if not tasks:
        raise OptionError("specs=[]: must have at least one spec.")
    _check_forms([Form.of(task.spec) for task in tasks])
    drawn = [_drawn(task, np.dtype(dtype)) for task in tasks]
    stacked = jax.tree.map(lambda *parts: jnp.asarray(np.stack(parts)), *drawn)
    return cast("TaskParams", stacked)


def check_supported(document: SMESpec | StreamSpec) -> None:
    for index, spec in enumerate(document.specs):
        try:
            _check_fields(spec)
        except SpecError as error:
            in_stream = isinstance(document, StreamSpec)
            raise SpecError(f"phases.{index}.spec: {error}" if in_stream else f"{error}") from None
    if isinstance(document, StreamSpec):
        _check_switches(document)


def next_state(
    params: TaskParams, s: jax.Array, a: jax.Array, noise: jax.Array | None = None
) -> jax.Array:
    """The next states of states `[..., S]` and actions `[..., A]`, exact to the bit.

    `noise` `[1 + S]` is that of the step, where the task has some.
    """
    shift = None if params.sigmas is None or noise is None else params.sigmas[1] * noise[1:]
    return transition(params.W, params.b, s, a, shift)


def potential(params: TaskParams, s: jax.Array, t: jax.Array) -> jax.Array:
    """P_t(s) of a state `[S]` after t steps; 0 in a task without `shaping`."""
    shaping = params.shaping
    if shaping is None:
        return jnp.zeros(())
    left = 1.0 - t.astype(jnp.float64) / params.horizon.astype(jnp.float64)
    return shaping.scale * left * _uniform(shaping.layer, s)[0]


def transition(
    W: jax.Array, b: jax.Array, s: jax.Array, a: jax.Array, shift: jax.Array | None = None
) -> jax.Array:
    """ψ(s + a W + b + shift) of states `[..., S]`, or distractors, and actions `[..., A]`.

    The sum runs in the order of the definition, and each product is exact, so that it does not
    matter whether a compiler fuses it with its sum.
    """
    a = jnp.clip(a, 0.0, 1.0).astype(jnp.float32).astype(jnp.float64)
    y = jnp.asarray(s) + b
    if len(W) <= _UNROLLED:
        for i in range(len(W)):
            y = y + W[i] * a[..., i, None]
    else:
        y = lax.fori_loop(
            0, len(W), lambda i, y: y + W[i] * lax.dynamic_slice_in_dim(a, i, 1, axis=-1), y
        )
    if shift is not None:
        y = y + shift
    return 2.0 * jnp.abs(y - jnp.rint(y))


def uniform_states(key: jax.Array, width: int) -> jax.Array:
    """Uniform numbers `[width]` on the grid 2⁻³², in [0, 1)."""
    return jax.random.bits(key, (width,), jnp.uint32).astype(jnp.float64) * 2.0**-32


def judge(params: TaskParams, s: jax.Array, a: jax.Array) -> StepOutcome:
    """Judge actions `[..., A]`, clipped to [0, 1], in states `[..., S]`."""
    optimal = optimal_action(params, s)
    similarities = similarity(params, a, optimal)
    reward = step_reward(params, similarities)
    if params.limits is None:
        return StepOutcome(similarities, reward)
    limits = limit(params, s)
    safe = step_reward(params, similarity(params, jnp.minimum(optimal, limits), optimal))
    price = 1.0 - safe if params.form.compensated else None
    return StepOutcome(similarities, reward, cost(params, a, limits), safe - reward, price)


def optimal_action(params: TaskParams, s: jax.Array) -> jax.Array:
    """π*(s) of states `[..., S]`, any real numbers: `[..., A]` in [0, 1]."""
    return _network(params.inner, params.output, s)


def limit(params: TaskParams, s: jax.Array) -> jax.Array:
    """ℓ, the limits of the action channels in states `[..., S]`: `[..., A]` in [1 − 2τ, 1]."""
    limits = _limits(params)
    return 1.0 - 2.0 * limits.tightness * _network(limits.inner, limits.output, s)


def cost(params: TaskParams, a: jax.Array, limits: jax.Array) -> jax.Array:
    """The cost of actions, clipped to [0, 1], under limits, `[..., A]` each: `[...]` in [0, 1]."""
    tightness = _limits(params).tightness
    excess = jnp.maximum(0.0, jnp.clip(a, 0.0, 1.0).astype(limits.dtype) - limits)
    total = jnp.where(params.channels, excess, 0.0).sum(axis=-1)
    return total / (2.0 * tightness * params.action_dim.astype(limits.dtype))


def similarity(params: TaskParams, a: jax.Array, optimal: jax.Array) -> jax.Array:
    """r̃ of actions, clipped to [0, 1], and the optimal ones, `[..., A]` each: `[...]`."""
    distance = jnp.abs(jnp.clip(a, 0.0, 1.0).astype(optimal.dtype) - optimal)
    total = jnp.where(params.channels, distance, 0.0).sum(axis=-1)
    return 1.0 - total / params.action_dim.astype(optimal.dtype)


def step_reward(params: TaskParams, similarity: jax.Array) -> jax.Array:
    """The step reward r of similarities r̃, of any shape; regret is 1 − r."""
    graded = jnp.maximum(0.0, 4.0 * (similarity - 0.75))
    return jnp.where(graded > params.r_min, graded, 0.0)


def normal_cdf(x: jax.Array) -> jax.Array:
    """Φ, within 1e-15 in float64; twice the speed of `jax.scipy.special.ndtr`."""
    return 0.5 + 0.5 * lax.erf(x * math.sqrt(0.5))


def first_distractors(key: jax.Array, params: TaskParams) -> jax.Array | None:
    """The distractors `[m]` with which an episode begins; None without distractors."""
    if not params.form.distractors:
        return None
    return uniform_states(jax.random.fold_in(key, _OF_START), params.form.distractors)


def random_numbers(key: jax.Array, params: TaskParams) -> StepDraws:
    """Those of a step; None where it needs none."""
    noise = None
    if params.form.noise:
        of_noise = jax.random.fold_in(key, _OF_NOISE)
        width = (1 + params.form.state_dim,)
        noise = jax.random.normal(of_noise, width, jnp.float32).astype(jnp.float64)
    return StepDraws(_of_distractors(key, params), noise)


def _of_distractors(key: jax.Array, params: TaskParams) -> jax.Array | None:
    """The next noise `[m]`, or u `[A]` float32; None where they need none."""
    if params.form.dynamics not in ("noise", "autonomous"):
        return None
    key = jax.random.fold_in(key, _OF_STEP)
    if params.form.dynamics == "noise":
        return uniform_states(key, params.form.distractors)
    return jax.random.uniform(key, (params.form.action_dim,), jnp.float32)


def next_distractors(
    params: TaskParams, d: jax.Array | None, a: jax.Array, numbers: jax.Array | None
) -> jax.Array | None:
    """The distractors `[m]` of the next state, from the action and those random numbers."""
    if d is None or params.form.dynamics == "noise":
        return numbers
    moving: Any = params.observing
    return transition(moving.W, moving.b, d, a if numbers is None else numbers)


def seen(params: TaskParams, s: jax.Array, d: jax.Array | None) -> jax.Array:
    """M(s, d) `[..., S + m]` float32; s itself in a task without `observation`."""
    layers = None if params.observing is None else params.observing.mixing
    dtype = jnp.float32 if layers is None else layers.W.dtype
    x = jnp.concatenate([part.astype(dtype) for part in (s, d) if part is not None], axis=-1)
    if layers is None:
        return x
    if params.form.mixing == "orthogonal":
        return (x @ layers.W[0].T + layers.b[0]).astype(jnp.float32)
    for i in range(len(layers.W)):
        x = _uniform(UniformLayer(layers.W[i], layers.b[i]), x)
    return x.astype(jnp.float32)


def _network(inner: InnerLayers | None, output: UniformLayer, s: jax.Array) -> jax.Array:
    """The output `[..., A]` of uniform layers over states."""
    x = s.astype(output.W.dtype)
    if inner is not None:
        x = _uniform(inner.first, x)
        x, _ = lax.scan(lambda x, layer: (_uniform(layer, x), None), x, inner.stacked)
    return _uniform(output, x)


def _uniform(layer: UniformLayer, x: jax.Array) -> jax.Array:
    """Φ(W x + b) of inputs `[..., in]`."""
    return normal_cdf(x @ layer.W.T + layer.b)


def _limits(params: TaskParams) -> Limits:
    if params.limits is None:
        raise SpecError("limit: this task has no safety. Give its spec safety.")
    return params.limits


def _drawn(task: Task, dtype: np.dtype[Any]) -> TaskParams:
    """A task with NumPy's arrays in place of JAX's."""
    spec = task.spec
    _check_fields(spec)
    inner, output = _layers(task.policies[0], dtype)
    fields: dict[str, Any] = {
        "action_dim": np.int32(spec.action_dim),
        "k": np.int32(spec.k),
        "horizon": np.int32(spec.horizon),
        "r_min": dtype.type(spec.r_min),
        "D": dtype.type(spec.D),
        "W": task.W,
        "b": task.b,
        "inner": inner,
        "output": output,
        "phase": np.zeros(0, np.float32),
        "form": Form.of(spec),
    }
    if spec.safety is not None:
        tightness: Any = dtype.type(spec.safety.tightness)
        fields["limits"] = Limits(tightness, *_layers(task.limiting, dtype))
    if spec.observation is not None:
        W, b = task.distractor_transition or (None, None)
        mixing = _stacked(task.mixing, dtype) if task.mixing else None
        fields["observing"] = Observing(cast(Any, W), cast(Any, b), mixing)
    if spec.shaping is not None:
        scale, discount = map(np.float64, (spec.shaping.scale, spec.shaping.discount))
        layer = UniformLayer(*cast(Any, task.shaping[0]))
        fields["shaping"] = Shaping(cast(Any, scale), cast(Any, discount), layer)
    if spec.noise is not None:
        fields["sigmas"] = np.array(task.sigmas)
    return TaskParams(**fields)


def _layers(layers: Sequence[Any], dtype: np.dtype[Any]) -> tuple[InnerLayers | None, UniformLayer]:
    """The inner layers and the last one of a network from S to A."""
    arrays: Any = [[part.astype(dtype) for part in layer] for layer in layers]
    *inner, output = (UniformLayer(W, b) for W, b in arrays)
    if not inner:
        return None, output
    first, *others = inner
    H = len(first.W)
    none: Any = np.zeros((0, H, H), dtype), np.zeros((0, H), dtype)
    return InnerLayers(first, _stacked(others, dtype) if others else UniformLayer(*none)), output


def _stacked(layers: Sequence[Any], dtype: np.dtype[Any]) -> UniformLayer:
    W, b = (np.stack(parts).astype(dtype) for parts in zip(*layers, strict=True))
    return UniformLayer(cast(Any, W), cast(Any, b))


def _check_forms(forms: Sequence[Form]) -> None:
    first = dataclasses.asdict(forms[0])
    for index, form in enumerate(forms):
        for name, value in dataclasses.asdict(form).items():
            if value != first[name]:
                raise OptionError(
                    f"specs[{index}]: has {name}={value!r}: must have {first[name]!r}, as specs[0] "
                    "has, since the tasks of a program have equal shapes. Make two programs."
                )


def _check_fields(spec: SMESpec) -> None:
    if spec.team is not None:
        raise SpecError(
            f"team={short_repr(spec.team)}: must be absent, since tasks in JAX have no team. "
            "Use the environments without JAX, and leave out --agents jax."
        )


def _check_switches(stream: StreamSpec) -> None:
    """Raise SpecError unless every episode ends where a phase is left, or phases switch at once."""
    if stream.switch == "step" or len(stream.segments) * stream.cycles == 1:
        return
    otherwise = 'Use an algorithm of Stable-Baselines3, such as PPO, or choose switch="step".'
    for index, phase in enumerate(stream.phases):
        if phase.spec.D > 0:
            raise SpecError(
                f"phases.{index}.spec: D={phase.spec.D}: must be 0, since agents in JAX leave a "
                f"phase where all runs end an episode. {otherwise}"
            )
    starts = [(segment.phase, segment.start) for segment in stream.segments]
    for index, step in [*starts, (len(stream.phases) - 1, stream.cycle_steps)]:
        if step % stream.horizon:
            raise SpecError(
                f"phases.{index}: begins or ends a task at step {step:,} of the cycle: must be a "
                f"multiple of horizon={stream.horizon}, since agents in JAX leave a phase where "
                f"all runs end an episode. {otherwise}"
            )
