"""An ONNX graph of a feed-forward network as a program.

A value of the graph is either a number array that the file fixes, or a value `[B, n]` of the
program. Names, types and shapes of the file are not trusted: whatever is not understood in full
makes the network unknown, and nothing but numbers ever reaches a page.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sme_registry.errors import ResourceLimitError
from sme_registry.explorer.program import Program, ProgramBuilder
from sme_registry.io import is_installed

__all__ = ["GraphNode", "program_of_graph", "read_onnx"]

Value = int | npt.NDArray[Any]
"""The number of a program's value, or an array."""

_FLOATS = (1, 11)  # TensorProto.FLOAT and DOUBLE
_UNARY = ("Relu", "Tanh", "Sigmoid", "Softplus", "Erf", "Exp", "Sqrt", "Abs", "Neg")
_BINARY = {"Add": np.add, "Sub": np.subtract, "Mul": np.multiply, "Div": np.divide}


class GraphNode(NamedTuple):
    """A node of a graph."""

    operator: str  # of ONNX, such as "Gemm"
    # names of the values that it reads; empty for an optional one that is missing
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]  # names of the values that it computes
    attributes: Mapping[str, Any]  # by name: integers, floats, lists of them, and tensors as arrays


class _UnknownGraph(Exception):
    """Something that is no part of a feed-forward network, or not understood."""


def read_onnx(data: bytes) -> Program | None:
    """The network of an ONNX file; None if it is unknown, or the package onnx is not installed.

    The file is parsed by the package onnx: give only a file whose author you trust.
    """
    if not is_installed("onnx"):
        return None
    import onnx

    model = onnx.load_model_from_string(data)
    graph = model.graph
    tensors = {each.name: each for each in graph.initializer}
    names = [each for each in graph.input if each.name not in tensors]
    if len(names) != 1 or len(graph.output) != 1:
        return None
    dims = names[0].type.tensor_type.shape.dim
    if len(dims) != 2 or dims[1].dim_value < 1:
        return None

    def array(tensor: Any) -> npt.NDArray[Any]:
        if tensor.data_location == onnx.TensorProto.EXTERNAL:
            raise _UnknownGraph
        return np.asarray(onnx.numpy_helper.to_array(tensor))

    def attribute(each: Any) -> Any:
        value = onnx.helper.get_attribute_value(each)
        return array(value) if isinstance(value, onnx.TensorProto) else value

    try:
        constants = {name: array(tensor) for name, tensor in tensors.items()}
        nodes = [
            GraphNode(
                node.op_type,
                tuple(node.input),
                tuple(node.output),
                {each.name: attribute(each) for each in node.attribute},
            )
            for node in graph.node
        ]
    except _UnknownGraph:
        return None
    ends = names[0].name, graph.output[0].name
    return program_of_graph(nodes, constants, *ends, dims[1].dim_value)


def program_of_graph(
    nodes: Iterable[GraphNode],
    constants: Mapping[str, npt.NDArray[Any]],
    input: str,
    output: str,
    width: int,
) -> Program | None:
    """The program of a graph."""
    reader = _Reader(constants, input, width)
    try:
        for node in nodes:
            reader.add(node)
        return reader.finished(output)
    except (_UnknownGraph, ResourceLimitError):
        return None
    except (KeyError, IndexError, TypeError, ValueError, OverflowError):  # not a valid graph
        return None


class _Reader:
    """Reads nodes in order; each method is one operator or a family of them."""

    def __init__(self, constants: Mapping[str, npt.NDArray[Any]], input: str, width: int) -> None:
        self._build = ProgramBuilder(width)
        self._values: dict[str, Value] = {**constants, input: 0}
        self._known: dict[str, Callable[[GraphNode, list[Any]], Value]] = {
            **dict.fromkeys(_UNARY, self._unary),
            **dict.fromkeys(_BINARY, self._binary),
            **dict.fromkeys(("Identity", "Flatten", "Cast", "Reshape"), self._same),
            "Constant": lambda node, _: _constant_of(node.attributes),
            "Gemm": self._gemm,
            "MatMul": self._matmul,
            "Clip": self._clip,
            "Elu": lambda node, x: self._leaking("elu", node, x, 1.0),
            "LeakyRelu": lambda node, x: self._leaking("leaky_relu", node, x, 0.01),
            "Pow": self._pow,
            "Concat": self._concat,
            "Slice": self._slice,
            "Gather": self._gather,
            "LayerNormalization": self._layer_normalization,
            "Transpose": self._transpose,
        }

    def add(self, node: GraphNode) -> None:
        """Read one node."""
        x = [self._values[name] if name else None for name in node.inputs]
        if node.operator == "Split":
            for name, value in zip(node.outputs, self._split(node, x), strict=True):
                self._values[name] = value
            return
        if node.operator not in self._known or len([name for name in node.outputs if name]) != 1:
            raise _UnknownGraph
        self._values[node.outputs[0]] = self._known[node.operator](node, x)

    def finished(self, output: str) -> Program:
        """The program whose output is this value."""
        value = self._number(self._values[output])
        # The output must be the newest value.
        self._build.unary("clip", value, low=-1e300, high=1e300)
        return self._build.build()

    def _number(self, value: Any) -> int:
        if isinstance(value, int):
            return value
        return self._build.constant(_row(value))

    def _data(self, value: Any) -> int:
        if not isinstance(value, int):
            raise _UnknownGraph
        return value

    def _unary(self, node: GraphNode, x: list[Any]) -> Value:
        return self._build.unary(node.operator.lower(), self._data(x[0]))

    def _leaking(self, op: str, node: GraphNode, x: list[Any], default: float) -> Value:
        alpha = float(node.attributes.get("alpha", default))
        return self._build.unary(op, self._data(x[0]), alpha=alpha)

    def _binary(self, node: GraphNode, x: list[Any]) -> Value:
        left, right = x
        if not isinstance(left, int) and not isinstance(right, int):
            return np.asarray(_BINARY[node.operator](left, right))
        rows = [each if isinstance(each, int) else _row(each) for each in (left, right)]
        return self._build.binary(node.operator.lower(), *rows)

    def _same(self, node: GraphNode, x: list[Any]) -> Value:
        """What leaves the rows of a value as they are."""
        attributes = node.attributes
        if node.operator == "Cast" and attributes["to"] not in _FLOATS:
            raise _UnknownGraph
        if not isinstance(x[0], int):
            if node.operator in ("Identity", "Cast"):
                return np.asarray(x[0])
            raise _UnknownGraph
        if node.operator == "Flatten" and attributes.get("axis", 1) not in (1, -1):
            raise _UnknownGraph
        if node.operator == "Reshape":
            rows, *columns = np.asarray(x[1]).tolist()
            width = self._build.width(x[0])
            if columns not in ([width], [-1]) or rows not in (-1, 0) or rows == columns[0]:
                raise _UnknownGraph
        return x[0]

    def _gemm(self, node: GraphNode, x: list[Any]) -> Value:
        attributes = node.attributes
        if attributes.get("transA", 0):
            raise _UnknownGraph
        W = _matrix(x[1])
        W = (W if attributes.get("transB", 0) else W.T) * W.dtype.type(attributes.get("alpha", 1.0))
        b = np.zeros(len(W), W.dtype)
        if len(x) > 2 and x[2] is not None:
            b = b + _row(x[2]).astype(W.dtype) * W.dtype.type(attributes.get("beta", 1.0))
        return self._dense(self._data(x[0]), W, b)

    def _matmul(self, node: GraphNode, x: list[Any]) -> Value:
        W = _matrix(x[1]).T
        return self._dense(self._data(x[0]), W, np.zeros(len(W), W.dtype))

    def _dense(self, x: int, W: npt.NDArray[Any], b: npt.NDArray[Any]) -> int:
        if W.shape != (len(b), self._build.width(x)):
            raise _UnknownGraph
        return self._build.dense(x, np.ascontiguousarray(W), b)

    def _clip(self, node: GraphNode, x: list[Any]) -> Value:
        ends = {"low": -1e300, "high": 1e300}
        given = [*x[1:], None, None]
        for index, (end, name) in enumerate((("low", "min"), ("high", "max"))):
            value = node.attributes.get(name, given[index])
            if isinstance(value, int):  # depends on the input
                raise _UnknownGraph
            if value is not None:
                ends[end] = float(np.asarray(value).reshape(()))
        return self._build.unary("clip", self._data(x[0]), **ends)

    def _pow(self, node: GraphNode, x: list[Any]) -> Value:
        if float(np.asarray(x[1]).reshape(())) != 2.0 or isinstance(x[1], int):
            raise _UnknownGraph
        return self._build.binary("mul", self._data(x[0]), self._data(x[0]))

    def _concat(self, node: GraphNode, x: list[Any]) -> Value:
        _last_axis(node.attributes["axis"])
        return self._build.concat(*map(self._number, x))

    def _slice(self, node: GraphNode, x: list[Any]) -> Value:
        start, end = (int(np.asarray(each).reshape(())) for each in x[1:3])
        _last_axis(int(np.asarray(x[3]).reshape(())))
        step = int(np.asarray(x[4]).reshape(())) if len(x) > 4 and x[4] is not None else 1
        data = self._data(x[0])
        return self._build.columns(data, tuple(range(self._build.width(data))[start:end:step]))

    def _gather(self, node: GraphNode, x: list[Any]) -> Value:
        _last_axis(node.attributes.get("axis", 0))
        data, indices = self._data(x[0]), np.asarray(x[1])
        if isinstance(x[1], int) or indices.ndim != 1:
            raise _UnknownGraph
        every = range(self._build.width(data))
        return self._build.columns(data, tuple(every[i] for i in indices.tolist()))

    def _split(self, node: GraphNode, x: list[Any]) -> Iterable[int]:
        _last_axis(node.attributes.get("axis", 0))
        data = self._data(x[0])
        width, parts = self._build.width(data), len(node.outputs)
        if len(x) > 1 and x[1] is not None:
            lengths = np.asarray(x[1]).tolist()
        else:
            size = -(-width // parts)
            lengths = [size] * (parts - 1) + [width - size * (parts - 1)]
        if sum(lengths) != width or min(lengths) < 1:
            raise _UnknownGraph
        ends = np.cumsum(lengths).tolist()
        return [
            self._build.columns(data, tuple(range(end - length, end)))
            for length, end in zip(lengths, ends, strict=True)
        ]

    def _layer_normalization(self, node: GraphNode, x: list[Any]) -> Value:
        _last_axis(node.attributes.get("axis", -1))
        epsilon = float(node.attributes.get("epsilon", 1e-5))
        y = self._build.unary("normalise", self._data(x[0]), epsilon=epsilon)
        y = self._build.binary("mul", y, _row(x[1]))
        if len(x) > 2 and x[2] is not None:
            y = self._build.binary("add", y, _row(x[2]))
        return y

    def _transpose(self, node: GraphNode, x: list[Any]) -> Value:
        if list(node.attributes.get("perm", [1, 0])) != [1, 0]:
            raise _UnknownGraph
        return _matrix(x[0]).T


def _constant_of(attributes: Mapping[str, Any]) -> npt.NDArray[Any]:
    ((name, value),) = attributes.items()
    if name not in ("value", "value_float", "value_floats", "value_int", "value_ints"):
        raise _UnknownGraph
    return np.asarray(value)


def _matrix(value: Any) -> npt.NDArray[Any]:
    if isinstance(value, int) or np.ndim(value) != 2:
        raise _UnknownGraph
    return _finite(value)


def _row(value: Any) -> npt.NDArray[Any]:
    """An array that broadcasts along rows, as one row."""
    array = np.asarray(value)
    if isinstance(value, int) or array.size not in (array.shape[-1:] or (1,)):
        raise _UnknownGraph
    return _finite(array).reshape(-1)


def _finite(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if array.dtype not in (np.float32, np.float64) or not np.isfinite(array).all():
        raise _UnknownGraph
    return array


def _last_axis(axis: int) -> None:
    if axis not in (1, -1):
        raise _UnknownGraph
