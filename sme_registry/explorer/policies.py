"""A policy's network as a program of its observations: of arrays, of PyTorch, or of an ONNX graph.

A value of a graph is either an array that the file fixes, or a value of the program. Names, types
and shapes of the file are not trusted: whatever is not understood in full makes the network
unknown, and nothing but numbers ever reaches a page.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.diagnosis.subject import perceptron_of
from sme_registry.errors import PolicyError, ResourceLimitError
from sme_registry.evaluation import Perceptron, Policy
from sme_registry.evaluation.models import ModulePredictor, OnnxNetwork
from sme_registry.evaluation.policies import TeamPolicy
from sme_registry.explorer.program import OPERATIONS, NetworkProgram, point_width
from sme_registry.export.networks import traced
from sme_registry.io import is_installed
from sme_registry.spec import SMESpec
from sme_registry.task import draw
from sme_registry.task.draw import Array

TOLERANCE = 1e-5  # of an action in [0, 1]; a policy's own float32 sums move it by 1e-6
_PROBES = 256


class _UnknownNetwork(Exception):
    """Something that is no part of a feed-forward network, or not understood."""


def policy_program(policy: Policy | TeamPolicy, spec: SMESpec) -> NetworkProgram | None:
    """Actions in the unit range as a program of observations; None where they are unknown.

    They are known if they equal the policy's own in probes in and outside the cube.
    """
    program = NetworkProgram(spec.observation_dim)
    try:
        if isinstance(policy, TeamPolicy):
            _append_team(program, policy, spec)
        else:
            _append(program, 0, policy)
    except (_UnknownNetwork, ResourceLimitError):
        return None
    observations = probe_points(spec).astype(np.float32)
    expected, actions = (np.clip(act(observations), 0.0, 1.0) for act in (policy, program))
    # NaN counts as a difference.
    return program if bool(np.all(np.abs(actions - expected) <= TOLERANCE)) else None


def probe_points(spec: SMESpec) -> Array:
    """Points to compare in, the second half of them in the cube of twice the side."""
    n = point_width(spec)
    x = draw.uniform(0, "explorer/probes", _PROBES * n).reshape(_PROBES, n)
    x[_PROBES // 2 :] = 2.0 * x[_PROBES // 2 :] - 0.5
    return x


def _append(program: NetworkProgram, observation: int, policy: Policy) -> None:
    act: Any = policy.act
    width = program.width_of(observation)
    perceptron = perceptron_of(policy)
    if perceptron is not None:
        x = _append_perceptron(program, observation, perceptron)
    else:
        network = act if isinstance(act, NetworkProgram) else _exported(act, width)
        if network is None or network.inputs != width:
            raise _UnknownNetwork
        x = program.append(network, observation)
    if policy.action_range == "symmetric":
        program.affine(x, 0.5, 0.5)


def _append_perceptron(program: NetworkProgram, x: int, network: Perceptron) -> int:
    for W, b, activation in network.layers:
        x = program.dense(x, np.ascontiguousarray(W.T), b)
        if activation == "silu":
            x = program.binary("mul", x, program.unary("sigmoid", x))
        elif activation == "elu":
            x = program.unary("elu", x, alpha=1.0)
        elif activation != "identity":
            x = program.unary(activation, x)
    if network.low is not None and network.high is not None:
        half = 0.5 * (network.high.astype(np.float64) - network.low)
        x = program.binary("add", program.binary("mul", x, half), network.low + half)
    return x


def _append_team(program: NetworkProgram, team: TeamPolicy, spec: SMESpec) -> None:
    n = point_width(spec)
    actions = []
    for member in team.members:
        # What an agent sees of the joint observation is an affine map of these rows.
        nothing = member.observe(np.zeros((1, n), np.float32))[0]
        rows = member.observe(np.eye(n, dtype=np.float32)) - nothing
        seen = program.dense(0, rows.T.copy(), nothing)
        _append(program, seen, member.policy)
        actions.append(program.columns(program.last, tuple(range(member.action_dim))))
    program.concat(*actions)


def _exported(act: Any, width: int) -> NetworkProgram | None:
    """The program of an ONNX file, or of a module that PyTorch can export."""
    if isinstance(act, OnnxNetwork):
        return read_onnx(act.path.read_bytes())
    if not isinstance(act, ModulePredictor):
        return None
    try:
        return read_onnx(traced(act.module, width))
    except PolicyError:
        return None


class GraphNode(NamedTuple):
    operator: str  # of ONNX, such as "Gemm"
    # names of the values that it reads; empty for an optional one that is missing
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]  # names of the values that it computes
    attributes: Mapping[str, Any]  # by name: integers, floats, lists of them, and tensors as arrays


def read_onnx(data: bytes) -> NetworkProgram | None:
    """The network of an ONNX file; None if it is unknown, or the package onnx is not installed."""
    if not is_installed("onnx"):
        return None
    import onnx

    def array(tensor: Any) -> npt.NDArray[Any]:
        if tensor.data_location == onnx.TensorProto.EXTERNAL:
            raise _UnknownNetwork
        return np.asarray(onnx.numpy_helper.to_array(tensor))

    def attribute(field: Any) -> Any:
        value = onnx.helper.get_attribute_value(field)
        return array(value) if isinstance(value, onnx.TensorProto) else value

    graph = onnx.load_model_from_string(data).graph
    try:
        constants = {tensor.name: array(tensor) for tensor in graph.initializer}
        nodes = [
            GraphNode(
                node.op_type,
                tuple(node.input),
                tuple(node.output),
                {field.name: attribute(field) for field in node.attribute},
            )
            for node in graph.node
        ]
        (observation,) = [value for value in graph.input if value.name not in constants]
        (action,) = graph.output
        _, width = (dim.dim_value for dim in observation.type.tensor_type.shape.dim)
    except (_UnknownNetwork, ValueError):  # also another number of inputs, outputs or axes
        return None
    return program_of_graph(nodes, constants, observation.name, action.name, width)


def program_of_graph(
    nodes: Iterable[GraphNode],
    constants: Mapping[str, npt.NDArray[Any]],
    input: str,
    output: str,
    width: int,
) -> NetworkProgram | None:
    program = NetworkProgram(width)
    values: dict[str, _Value] = {**constants, input: 0}
    try:
        for node in nodes:
            operands = [values[name] if name else None for name in node.inputs]
            (name,) = node.outputs
            values[name] = _OPERATORS[node.operator](program, *operands, **node.attributes)
        # The output must be the newest value.
        program.unary("clip", _number(program, values[output]), low=-1e300, high=1e300)
        return program
    except (_UnknownNetwork, ResourceLimitError):
        return None
    except (KeyError, IndexError, TypeError, ValueError, OverflowError):  # not a valid graph
        return None


# An operator's function takes the inputs of a node in order, and its attributes by name.
_Value = int | npt.NDArray[Any]
"""The number of a program's value, or an array."""

_FLOATS = (1, 11)  # TensorProto.FLOAT and DOUBLE
_UNARY = ("Relu", "Tanh", "Sigmoid", "Softplus", "Erf", "Exp", "Sqrt", "Abs", "Neg")


def _unary(op: str, program: NetworkProgram, x: Any) -> _Value:
    return program.unary(op, _data(x))


def _leaking(op: str, program: NetworkProgram, x: Any, *, alpha: Any) -> _Value:
    return program.unary(op, _data(x), alpha=float(alpha))


def _binary(op: str, program: NetworkProgram, left: Any, right: Any) -> _Value:
    if isinstance(left, int) or isinstance(right, int):
        return program.binary(op, *(x if isinstance(x, int) else _row(x) for x in (left, right)))
    return np.asarray(OPERATIONS[op](left, right))


def _constant(program: NetworkProgram, **value: Any) -> _Value:
    ((name, number),) = value.items()
    if name not in ("value", "value_float", "value_floats", "value_int", "value_ints"):
        raise _UnknownNetwork
    return np.asarray(number)


def _cast(program: NetworkProgram, x: _Value, to: int, saturate: int = 1) -> _Value:
    if to not in _FLOATS:
        raise _UnknownNetwork
    return x


def _flatten(program: NetworkProgram, x: Any, axis: int = 1) -> _Value:
    _check_last(axis)
    return _data(x)


def _reshape(program: NetworkProgram, x: Any, shape: Any, allowzero: int = 0) -> _Value:
    """Only what leaves the rows of a value as they are."""
    rows, *columns = np.asarray(shape).tolist()
    width = program.width_of(_data(x))
    if columns not in ([width], [-1]) or rows not in (-1, 0) or rows == columns[0]:
        raise _UnknownNetwork
    return _data(x)


def _gemm(
    program: NetworkProgram,
    x: Any,
    W: Any,
    b: Any = None,
    alpha: float = 1.0,
    beta: float = 1.0,
    transA: int = 0,
    transB: int = 0,
) -> _Value:
    if transA:
        raise _UnknownNetwork
    W = _matrix(W)
    W = (W if transB else W.T) * W.dtype.type(alpha)
    offset = np.zeros(len(W), W.dtype)
    if b is not None:
        offset = offset + _row(b).astype(W.dtype) * W.dtype.type(beta)
    if W.shape != (len(offset), program.width_of(_data(x))):
        raise _UnknownNetwork
    return program.dense(x, np.ascontiguousarray(W), offset)


def _clip(
    program: NetworkProgram,
    x: Any,
    low: Any = None,
    high: Any = None,
    min: Any = -1e300,
    max: Any = 1e300,
) -> _Value:
    low, high = (
        _scalar(end if value is None else value) for value, end in ((low, min), (high, max))
    )
    return program.unary("clip", _data(x), low=low, high=high)


def _concat(program: NetworkProgram, *values: Any, axis: int) -> _Value:
    _check_last(axis)
    return program.concat(*(_number(program, value) for value in values))


def _layer_normalization(
    program: NetworkProgram,
    x: Any,
    scale: Any,
    shift: Any = None,
    axis: int = -1,
    epsilon: Any = 1e-5,
    stash_type: int = 1,
) -> _Value:
    _check_last(axis)
    y = program.unary("normalise", _data(x), epsilon=float(epsilon))
    y = program.binary("mul", y, _row(scale))
    return y if shift is None else program.binary("add", y, _row(shift))


def _transpose(program: NetworkProgram, x: Any, perm: Sequence[int] = (1, 0)) -> _Value:
    if list(perm) != [1, 0]:
        raise _UnknownNetwork
    return _matrix(x).T


_OPERATORS: dict[str, Callable[..., _Value]] = {
    **{name: partial(_unary, name.lower()) for name in _UNARY},
    **{name: partial(_binary, name.lower()) for name in ("Add", "Sub", "Mul", "Div")},
    "Elu": partial(_leaking, "elu", alpha=1.0),
    "LeakyRelu": partial(_leaking, "leaky_relu", alpha=0.01),
    "Identity": lambda program, x: x,
    "Cast": _cast,
    "Flatten": _flatten,
    "Reshape": _reshape,
    "Constant": _constant,
    "Gemm": _gemm,
    "MatMul": lambda program, x, W: _gemm(program, x, W),
    "Clip": _clip,
    "Concat": _concat,
    "LayerNormalization": _layer_normalization,
    "Transpose": _transpose,
}


def _data(value: Any) -> int:
    """The number of a value that depends on the input."""
    if not isinstance(value, int):
        raise _UnknownNetwork
    return value


def _number(program: NetworkProgram, value: Any) -> int:
    return value if isinstance(value, int) else program.constant(_row(value))


def _scalar(value: Any) -> float:
    if isinstance(value, int):  # depends on the input
        raise _UnknownNetwork
    return float(np.asarray(value).reshape(()))


def _matrix(value: Any) -> npt.NDArray[Any]:
    if isinstance(value, int) or np.ndim(value) != 2:
        raise _UnknownNetwork
    return _finite(value)


def _row(value: Any) -> npt.NDArray[Any]:
    """An array that broadcasts along rows, as one row."""
    array = np.asarray(value)
    if isinstance(value, int) or array.size not in (array.shape[-1:] or (1,)):
        raise _UnknownNetwork
    return _finite(array).reshape(-1)


def _finite(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if array.dtype not in (np.float32, np.float64) or not np.isfinite(array).all():
        raise _UnknownNetwork
    return array


def _check_last(axis: int) -> None:
    if axis not in (1, -1):
        raise _UnknownNetwork
