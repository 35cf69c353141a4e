"""A network as plain steps, a `NetworkProgram`, which NumPy and a page's script compute alike.

Value 0 is the input `[B, n]`, and step i computes value i from earlier ones. The last value is the
output. All sums are in float64; weights keep the type that they were given in.

    dense      x Wᵀ + b, W [out, in], b [out]          constant   the row v
    columns    some columns of x                        concat     columns side by side
    add, sub, mul, div    of two values, or of a value and a row v
    clip       to [low, high]                           normalise  (x − mean x) / √(var x + epsilon)
    phi        Φ(x), the standard normal CDF            round32    to the nearest float32
    relu, tanh, sigmoid, softplus, elu (alpha), leaky_relu (alpha), erf, exp, sqrt, abs, neg

Every program of a task has the same input, a *point* x = (s, d, t/T, r_cum/k) `[B, S + m + 2]`.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import erf, expit, ndtr

from sme_registry.errors import ResourceLimitError
from sme_registry.evaluation.references import References
from sme_registry.spec import SMESpec
from sme_registry.task import Task
from sme_registry.task.draw import Array, Layer

MAX_WEIGHTS = 2**21  # of a program: 22 MB of text as float64, and seconds for a map in a browser
MAX_WIDTH = 2**13  # columns of a value

OPERATIONS: dict[str, Callable[..., Any]] = {
    "dense": lambda x, W, b: x @ W.T + b,
    "constant": lambda x, v: np.tile(v, (len(x), 1)),
    "columns": lambda x, columns: x[:, list(columns)],
    "concat": lambda *x: np.concatenate(x, axis=1),
    "add": lambda x, v: x + v,
    "sub": lambda x, v: x - v,
    "mul": lambda x, v: x * v,
    "div": lambda x, v: x / v,
    "phi": ndtr,
    "round32": lambda x: x.astype(np.float32).astype(np.float64),
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "sigmoid": expit,
    "softplus": lambda x: np.logaddexp(0.0, x),
    "elu": lambda x, alpha: np.where(x > 0.0, x, alpha * np.expm1(np.minimum(x, 0.0))),
    "leaky_relu": lambda x, alpha: np.where(x > 0.0, x, alpha * x),
    "erf": erf,
    "exp": np.exp,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "neg": np.negative,
    "clip": lambda x, low, high: np.clip(x, low, high),
    "normalise": lambda x, epsilon: (
        (x - x.mean(axis=1, keepdims=True)) / np.sqrt(x.var(axis=1, keepdims=True) + epsilon)
    ),
}


class ProgramStep(NamedTuple):
    op: str  # one of those in the module's first lines
    inputs: tuple[int, ...]  # the values that it reads, by their numbers
    width: int  # columns of its value
    # arrays, numbers, or a tuple of columns, by the operation's names
    parameters: Mapping[str, Any]


class NetworkProgram:
    """A function from rows `[B, n]` to rows `[B, width]`, deterministic, to which steps are added.

    The methods that add a step return the number of its value. `what` is for errors.
    """

    def __init__(self, inputs: int, what: str = "network") -> None:
        self.inputs, self._what = inputs, what
        self.steps: list[ProgramStep] = []
        self._weights = 0

    def __call__(self, x: npt.ArrayLike) -> Array:
        """The output `[B, width]` for inputs `[B, n]`."""
        values: list[Array] = [np.asarray(x, dtype=np.float64)]
        with np.errstate(all="ignore"):  # as in the script; the caller checks what comes out
            for step in self.steps:
                operands = [values[i] for i in step.inputs or (0,)]
                parameters = {
                    name: value.astype(np.float64) if isinstance(value, np.ndarray) else value
                    for name, value in step.parameters.items()
                }
                values.append(np.asarray(OPERATIONS[step.op](*operands, **parameters)))
        return values[-1]

    def to_dict(self) -> dict[str, Any]:
        steps = [
            {
                "op": step.op,
                "in": step.inputs,
                "width": step.width,
                **{
                    name: encoded(value) if isinstance(value, np.ndarray) else value
                    for name, value in step.parameters.items()
                },
            }
            for step in self.steps
        ]
        return {"inputs": self.inputs, "steps": steps}

    @property
    def last(self) -> int:
        return len(self.steps)

    @property
    def width(self) -> int:
        return self.width_of(self.last)

    def width_of(self, value: int) -> int:
        return self.inputs if value == 0 else self.steps[value - 1].width

    def dense(self, x: int, W: npt.NDArray[Any], b: npt.NDArray[Any]) -> int:
        return self._add("dense", (x,), len(b), W=W, b=b)

    def layers(self, x: int, layers: tuple[Layer, ...]) -> int:
        """Φ(W x + b) of each layer: a Deep Uniform Network (METHOD, section 1)."""
        for W, b in layers:
            x = self.unary("phi", self.dense(x, W, b))
        return x

    def constant(self, v: npt.NDArray[Any]) -> int:
        return self._add("constant", (), len(v), v=v)

    def columns(self, x: int, columns: tuple[int, ...]) -> int:
        """Some columns of a value; the value itself where they are all, in order."""
        if columns == tuple(range(self.width_of(x))):
            return x
        return self._add("columns", (x,), len(columns), columns=columns)

    def concat(self, *values: int) -> int:
        if len(values) == 1:
            return values[0]
        return self._add("concat", values, sum(map(self.width_of, values)))

    def binary(self, op: str, left: int | npt.NDArray[Any], right: int | npt.NDArray[Any]) -> int:
        """`add`, `sub`, `mul` or `div` of values, or of a value and a row `[m]` or `[1]`."""
        if not isinstance(left, int):
            left = self.constant(left)
        widths = [
            self.width_of(left),
            self.width_of(right) if isinstance(right, int) else len(right),
        ]
        if 1 not in widths and widths[0] != widths[1]:
            raise ValueError(f"{op} of widths {widths}")
        if isinstance(right, int):
            return self._add(op, (left, right), max(widths))
        return self._add(op, (left,), max(widths), v=right)

    def unary(self, op: str, x: int, **numbers: float) -> int:
        return self._add(op, (x,), self.width_of(x), **numbers)

    def affine(self, x: int, scale: float, shift: float) -> int:
        return self.binary("add", self.binary("mul", x, np.array([scale])), np.array([shift]))

    def append(self, program: NetworkProgram, x: int) -> int:
        """The steps of another program, whose input is the value x."""
        numbers = [x]
        for step in program.steps:
            inputs = tuple(numbers[i] for i in step.inputs)
            numbers.append(self._add(step.op, inputs, step.width, **step.parameters))
        return numbers[-1]

    def _add(self, op: str, inputs: tuple[int, ...], width: int, **parameters: Any) -> int:
        self._weights += sum(np.size(v) for v in parameters.values() if isinstance(v, np.ndarray))
        if width > MAX_WIDTH or self._weights > MAX_WEIGHTS:
            raise ResourceLimitError(
                f"{self._what}: has more than {MAX_WEIGHTS:,} weights, or a layer of more than "
                f"{MAX_WIDTH:,} units: too large for a page. Use `sme evaluate` or `sme diagnose`."
            )
        self.steps.append(ProgramStep(op, inputs, width, parameters))
        return self.last


def encoded(array: npt.NDArray[Any]) -> dict[str, str]:
    """An array as JSON data: its type, "f4" or "f8", and its little-endian bytes in base 64."""
    kind = "f4" if array.dtype == np.float32 else "f8"
    data = np.ascontiguousarray(array, dtype=f"<{kind}").tobytes()
    return {kind: base64.b64encode(data).decode("ascii")}


def point_width(spec: SMESpec) -> int:
    """Entries of a point: S + m + 2."""
    return spec.state_dim + spec.distractors + 2


def optimal(task: Task) -> NetworkProgram:
    """π* of a point; of a team, each agent's from what it observes."""
    spec = task.spec
    program = NetworkProgram(point_width(spec), "π*")
    actions = [
        program.layers(program.columns(0, tuple(observed)), layers)
        for observed, layers in zip(task.observed, task.policies, strict=True)
    ]
    program.concat(*actions)
    return program


def limit(task: Task) -> NetworkProgram | None:
    """ℓ(s) = 1 − 2τ v(s) of a point; None without safety."""
    if task.spec.safety is None:
        return None
    program = NetworkProgram(point_width(task.spec), "the network of the limits")
    v = program.layers(program.columns(0, tuple(range(task.spec.state_dim))), task.limiting)
    program.affine(v, -2.0 * task.spec.safety.tightness, 1.0)
    return program


def observe(task: Task) -> NetworkProgram:
    """What the policy sees in a point, rounded to float32."""
    spec = task.spec
    n = spec.state_dim + spec.distractors
    program = NetworkProgram(point_width(spec), "the mixing")
    x = 0
    if spec.mixing != "none":
        x = program.columns(0, tuple(range(n)))
        if spec.mixing == "orthogonal":
            ((W, b),) = task.mixing
            x = program.dense(x, W, b)
        else:
            x = program.layers(x, task.mixing)
        x = program.concat(x, program.columns(0, (n, n + 1)))
    program.unary("round32", x)
    return program


def linear(task: Task, fitted: References) -> NetworkProgram:
    """The linear least-squares policy of a report, of a point."""
    program = NetworkProgram(point_width(task.spec), "the linear policy")
    s = program.columns(0, tuple(range(task.spec.state_dim)))
    program.dense(s, fitted.slope.T.copy(), fitted.intercept - 0.5 * fitted.slope.sum(axis=0))
    return program


def constant(task: Task, action: Array) -> NetworkProgram:
    """One action `[A]` in every point."""
    program = NetworkProgram(point_width(task.spec), "the constant policy")
    program.constant(action)
    return program
