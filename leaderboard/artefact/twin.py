"""`rounding_twin`: a model whose every rounding error is redrawn at random each time that it runs.

Another version of a runtime sums in another order and approximates exp by another polynomial, so
its results differ in their last bits. A twin shows what such a difference does to the actions:

    z ↦ z (1 ± δ),  δ = 4u             each float entry, its sign drawn anew in each run
    z ↦ z (1 ± δ) ± δ                  outputs of functions that round relative to 1, as 1 + erf

u is the unit roundoff: 2⁻²⁴ in float32, 2⁻⁵³ in float64. Factors apply to the observations, to the
inputs of operators that sum (their terms may cancel), and to the output of every operator that
rounds. Operators that select, compare or round to integers are exact. A cast to integers first
clips to the integers' range: outside, its result depends on the processor.

Source: Parker, "Monte Carlo arithmetic" (1997); Vignes, "A stochastic arithmetic for reliable
scientific computation" (1993). The twin is written in the wire format from bytes that the gate has
accepted; no other parser reads them in this process. Signs come from Dropout's mask, which
onnxruntime has in every opset; no submission may contain it.
"""

from __future__ import annotations

import secrets
import sys
from graphlib import TopologicalSorter
from typing import Any, NamedTuple

import numpy as np

from leaderboard.artefact import schema
from leaderboard.artefact.wire import Budget, encoded, fields

_FLOAT, _INT32, _INT64, _BOOL, _DOUBLE = 1, 6, 7, 9, 11  # types of tensors
_ROUNDOFFS = {_FLOAT: 2.0**-24, _DOUBLE: 2.0**-53}
_FORMATS = {_FLOAT: "<f", _DOUBLE: "<d", _BOOL: "<?"}
_AMPLITUDE = 4.0
_INT = 2  # type of an attribute

_PREDICATES = "And Equal Greater GreaterOrEqual Less LessOrEqual Not Or Xor"
_EXACT = f"""
    {_PREDICATES}
    Abs ArgMax ArgMin Cast Ceil Clip Concat Constant Flatten Floor Gather GatherElements Identity
    Max Min Mod Neg ReduceMax ReduceMin Relu Reshape Round Sign Slice Split Squeeze ThresholdedRelu
    Transpose Unsqueeze Where
"""
_SUMS = """
    BatchNormalization Gemm LayerNormalization LogSoftmax MatMul Mean RMSNormalization ReduceL1
    ReduceL2 ReduceLogSumExp ReduceMean ReduceProd ReduceSum ReduceSumSquare Softmax Sum
"""
_RELATIVE_TO_ONE = """
    Acos Acosh Asin Asinh Atan Atanh Celu Cos Elu Erf Gelu HardSigmoid HardSwish Log LogSoftmax Mish
    ReduceLogSumExp Selu Sigmoid Sin Sinh Softmax Softplus Softsign Tan Tanh
"""
PREDICATES, EXACT, SUMS, RELATIVE_TO_ONE = (
    frozenset(names.split()) for names in (_PREDICATES, _EXACT, _SUMS, _RELATIVE_TO_ONE)
)
_FLOAT, _INT32, _INT64, _BOOL, _DOUBLE = 1, 6, 7, 9, 11  # types of tensors; 0 is any other
_UNIT_ROUNDOFF = {_FLOAT: 2.0**-24, _DOUBLE: 2.0**-53}
_END_OF_INTEGERS = {_INT32: 2.0**31, _INT64: 2.0**63}
_FORMATS = {_FLOAT: "<f4", _DOUBLE: "<f8", _BOOL: "?"}
_CONSTANT_TYPES = {"value_float": _FLOAT, "value_floats": _FLOAT}
_INTEGER_ATTRIBUTE = 2
_AMPLITUDE = 4.0


class _Node(NamedTuple):
    """A node: its operator, the names of its values, its attributes by name, and other fields."""

    operator: str
    inputs: list[str]
    outputs: list[str]
    attributes: dict[str, dict[str, list[Any]]]
    rest: bytes


def rounding_twin(data: bytes) -> bytes:
    """The twin of a model.

    Args:
      data: a model that `gate.inspect` accepts and onnxruntime has loaded.

    Returns:
      The bytes of a model with the same input and output. The signs of its errors differ in each
      run, and nobody can predict them.
    """
    model = _read(memoryview(data), schema.MODEL)
    graph = _Graph(_read(model["graph"][0], schema.GRAPH))
    kept = {name: model[name][0] for name in ("ir_version", "opset_import")}
    return _message(schema.MODEL, **kept, graph=graph.message())


class _Graph:
    """The graph of a twin under construction. Values are referred to by name."""

    def __init__(self, graph: dict[str, list[Any]]) -> None:
        self._kept = {name: graph[name] for name in ("name", "initializer", "input", "output")}
        self._prefix = secrets.token_hex(8)  # no name of the model can have it
        self._count = 0
        self._nodes: list[bytes] = []
        self._constants: dict[str, bytes] = {}
        tensors = [_read(message, schema.TENSOR) for message in graph["initializer"]]
        self._types = {_text(each["name"][0]): each["data_type"][0] for each in tensors}
        observations = _text(_read(graph["input"][0], schema.VALUE_INFO)["name"][0])
        self._types[observations] = _FLOAT
        self._replaced = {observations: self._rounded(observations, _FLOAT)}
        for node in _in_order([_node(message) for message in graph["node"]]):
            self._add(node)

    def message(self) -> bytes:
        kept = [
            _message(schema.GRAPH, **{name: each})
            for name in self._kept
            for each in self._kept[name]
        ]
        nodes = [_message(schema.GRAPH, node=node) for node in self._nodes]
        constants = [_message(schema.GRAPH, initializer=each) for each in self._constants.values()]
        return b"".join(kept + nodes + constants)

    def _add(self, node: _Node) -> None:
        """Add a node of the model, and the rounding of its inputs and outputs."""
        types = [self._types.get(name, 0) for name in node.inputs]
        inputs = [self._replaced.get(name, name) for name in node.inputs]
        results = _output_types(node, types)
        if node.operator in SUMS:
            inputs = [
                self._rounded(name, type) if type in _UNIT_ROUNDOFF else name
                for name, type in zip(inputs, types, strict=True)
            ]
        if node.operator == "Cast" and types[0] in _UNIT_ROUNDOFF:
            inputs = [self._clipped(inputs[0], types[0], results[0])]
        self._types |= zip(node.outputs, results, strict=True)
        if node.operator in EXACT:
            self._emit(inputs, node.outputs, node.rest)
            return
        before = [
            self._new_name() if name and type in _UNIT_ROUNDOFF else name
            for name, type in zip(node.outputs, results, strict=True)
        ]
        self._emit(inputs, before, node.rest)
        for name, type, exact in zip(node.outputs, results, before, strict=True):
            if exact != name:
                self._rounded(exact, type, name, relative_to_one=node.operator in RELATIVE_TO_ONE)

    def _rounded(
        self, name: str, type: int, output: str = "", *, relative_to_one: bool = False
    ) -> str:
        """Add nodes that round a value at random; return the name of the result."""
        δ = _AMPLITUDE * _UNIT_ROUNDOFF[type]
        factor = self._either(name, 1.0 - δ, 1.0 + δ, type)
        if not relative_to_one:
            return self._node("Mul", [name, factor], output)
        product = self._node("Mul", [name, factor])
        return self._node("Add", [product, self._either(name, -δ, δ, type)], output)

    def _either(self, name: str, first: float, second: float, type: int) -> str:
        """Add a value of the same shape, each entry one of two numbers at random."""
        half, training = self._constant(0.5, _FLOAT), self._constant(True, _BOOL)
        seed = _message(
            schema.ATTRIBUTE, name=b"seed", i=secrets.randbits(31), type=_INTEGER_ATTRIBUTE
        )
        mask = self._new_name()
        self._emit(
            [name, half, training],
            [self._new_name(), mask],
            _message(schema.NODE, op_type=b"Dropout", attribute=seed),
        )
        ends = self._constant(first, type), self._constant(second, type)
        return self._node("Where", [mask, *ends])

    def _clipped(self, name: str, type: int, target: int) -> str:
        """Add a value clipped to the range of a type of integers; of another type, as it is."""
        if target not in _END_OF_INTEGERS:
            return name
        end = np.dtype(_FORMATS[type]).type(_END_OF_INTEGERS[target])
        last = float(np.nextafter(end, end.dtype.type(0)))
        ends = self._constant(-float(end), type), self._constant(last, type)
        return self._node("Clip", [name, *ends])

    def _constant(self, value: float, type: int) -> str:
        name = f"{self._prefix}/{type}/{value!r}"
        raw = np.array(value, _FORMATS[type]).tobytes()
        self._constants[name] = _message(
            schema.TENSOR, data_type=type, name=name.encode(), raw_data=raw
        )
        return name

    def _node(self, operator: str, inputs: list[str], output: str = "") -> str:
        """Add a node with one output; return its name."""
        output = output or self._new_name()
        self._emit(inputs, [output], _message(schema.NODE, op_type=operator.encode()))
        return output

    def _emit(self, inputs: list[str], outputs: list[str], rest: bytes) -> None:
        """Add a node; `rest` is its fields but the names of its values."""
        names = [_message(schema.NODE, input=_bytes(name)) for name in inputs]
        names += [_message(schema.NODE, output=_bytes(name)) for name in outputs]
        self._nodes.append(b"".join([*names, rest]))

    def _new_name(self) -> str:
        self._count += 1
        return f"{self._prefix}/{self._count}"


def _output_types(node: _Node, types: list[int]) -> list[int]:
    """The types of a node's outputs, by those of its inputs."""
    if node.operator in PREDICATES:
        first = _BOOL
    elif node.operator in ("ArgMax", "ArgMin"):
        first = _INT64
    elif node.operator == "Cast":
        first = node.attributes["to"]["i"][0]
    elif node.operator == "Constant":
        name, attribute = next(iter(node.attributes.items()))
        first = _CONSTANT_TYPES.get(name, 0)
        if name == "value":
            first = _read(attribute["t"][0], schema.TENSOR)["data_type"][0]
    else:
        first = types[1 if node.operator == "Where" else 0]
    rest = _FLOAT if node.operator == "LayerNormalization" else first
    return [first, *[rest] * (len(node.outputs) - 1)]


def _in_order(nodes: list[_Node]) -> list[_Node]:
    """The nodes, each after those that compute its inputs; the format does not require it."""
    producers = {name: index for index, node in enumerate(nodes) for name in node.outputs if name}
    needed = {
        index: {producers[name] for name in node.inputs if name in producers}
        for index, node in enumerate(nodes)
    }
    return [nodes[index] for index in TopologicalSorter(needed).static_order()]


def _node(message: memoryview) -> _Node:
    node = _read(message, schema.NODE)
    attributes = [_read(each, schema.ATTRIBUTE) for each in node["attribute"]]
    rest = [
        _message(schema.NODE, **{field: value})
        for field in ("op_type", "domain", "attribute")
        for value in node[field]
    ]
    return _Node(
        operator=_text(node["op_type"][0]),
        inputs=[_text(name) for name in node["input"]],
        outputs=[_text(name) for name in node["output"]],
        attributes={_text(each["name"][0]): each for each in attributes},
        rest=b"".join(rest),
    )


def _read(message: memoryview, known: schema.Schema) -> dict[str, list[Any]]:
    """The values of a message's fields, by name. The gate has accepted the message."""
    read: dict[str, list[Any]] = {field.name: [] for field in known.values()}
    for number, _, value in fields(message, Budget(sys.maxsize)):
        read[known[number].name].append(value)
    return read


def _message(known: schema.Schema, **values: int | bytes | memoryview) -> bytes:
    """The fields of a message that have these values."""
    numbers = {field.name: number for number, field in known.items()}
    return b"".join(encoded(numbers[name], value) for name, value in values.items())


def _text(name: memoryview) -> str:
    return bytes(name).decode("utf-8", "surrogateescape")


def _bytes(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")
