"""`rounding_twin`: a model whose every rounding error is redrawn at random each time that it runs.

Another version of a runtime sums in another order and approximates exp by another polynomial, so
its results differ in their last bits. A twin shows what such a difference does to the actions:

    z ↦ z (1 ± δ) ± c δ,  δ = 4u       each float entry, both signs drawn anew in each run

u is the unit roundoff: 2⁻²⁴ in float32, 2⁻⁵³ in float64. c is 1 for functions that some kernels
round relative to 1 (as the tail of a sigmoid computed from ½), 2⁻¹⁰⁰ for those that some kernels
round to 0 below a small number, and otherwise 0. Errors apply to the observations, to the inputs of
operators that sum (their terms may cancel), and to the output of every operator that rounds.
Operators that select, compare or round to integers are exact, and so is arithmetic on small
integers (`integers.py`). A cast to integers first clips to their range: outside, its result depends
on the processor.

Source: Parker, "Monte Carlo arithmetic" (1997); Vignes, "A stochastic arithmetic for reliable
scientific computation" (1993). The twin is written in the wire format from bytes that the gate has
accepted; no other parser reads them in this process. Signs come from Dropout's mask, which
onnxruntime has in every opset; no submission may contain it.
"""

from __future__ import annotations

import secrets
from typing import Any

import numpy as np

from leaderboard.artefact import schema
from leaderboard.artefact.graph import (
    BOOL,
    DOUBLE,
    FLOAT,
    FORMATS,
    INT32,
    INT64,
    PREDICATES,
    Node,
    in_order,
    message,
    node_of,
    output_types,
    read,
    text,
    to_bytes,
)
from leaderboard.artefact.integers import Integers

_UNIT_ROUNDOFF = {FLOAT: 2.0**-24, DOUBLE: 2.0**-53}
_END_OF_INTEGERS = {INT32: 2.0**31, INT64: 2.0**63}
_INTEGER_ATTRIBUTE = 2
_AMPLITUDE = 4.0

_EXACT = """
    Abs ArgMax ArgMin Cast Ceil Clip Concat Constant Flatten Floor Gather GatherElements Identity
    Max Min Mod Neg ReduceMax ReduceMin Relu Reshape Round Sign Slice Split Squeeze ThresholdedRelu
    Transpose Unsqueeze Where
"""
_SUMS = """
    BatchNormalization Gemm LayerNormalization LogSoftmax MatMul Mean RMSNormalization ReduceL1
    ReduceL2 ReduceLogSumExp ReduceMean ReduceProd ReduceSum ReduceSumSquare Softmax Sum
"""
_ROUND_RELATIVE_TO_ONE = """
    Acos Acosh Asin Asinh Atan Atanh Celu Cos Elu Erf Gelu HardSigmoid HardSwish Log LogSoftmax Mish
    ReduceLogSumExp Selu Sigmoid Sin Sinh Softmax Softplus Softsign Tan Tanh
"""
EXACT, SUMS = PREDICATES | {*_EXACT.split()}, frozenset(_SUMS.split())
FLOORS = dict.fromkeys(_ROUND_RELATIVE_TO_ONE.split(), 1.0) | {"Exp": 2.0**-100, "Pow": 2.0**-100}


def rounding_twin(data: bytes) -> bytes:
    """The twin of a model.

    Args:
      data: a model that `gate.inspect` accepts and onnxruntime has loaded.

    Returns:
      The bytes of a model with the same input and output. The signs of its errors differ in each
      run, and nobody can predict them.
    """
    model = read(memoryview(data), schema.MODEL)
    graph = _Graph(read(model["graph"][0], schema.GRAPH))
    kept = {name: model[name][0] for name in ("ir_version", "opset_import")}
    return message(schema.MODEL, **kept, graph=graph.message())


class _Graph:
    """The graph of a twin under construction. Values are referred to by name."""

    def __init__(self, graph: dict[str, list[Any]]) -> None:
        self._kept = {name: graph[name] for name in ("name", "initializer", "input", "output")}
        self._prefix = secrets.token_hex(8)  # no name of the model can have it
        self._count = 0
        self._nodes: list[bytes] = []
        self._constants: dict[str, bytes] = {}
        tensors = [read(data, schema.TENSOR) for data in graph["initializer"]]
        self._types = {text(each["name"][0]): each["data_type"][0] for each in tensors}
        observations = text(read(graph["input"][0], schema.VALUE_INFO)["name"][0])
        self._types[observations] = FLOAT
        self._integers = Integers(tensors)
        self._replaced = {observations: self._rounded(observations, FLOAT)}
        for node in in_order(map(node_of, graph["node"])):
            self._add(node)

    def message(self) -> bytes:
        kept = [
            message(schema.GRAPH, **{name: each})
            for name in self._kept
            for each in self._kept[name]
        ]
        nodes = [message(schema.GRAPH, node=node) for node in self._nodes]
        constants = [message(schema.GRAPH, initializer=each) for each in self._constants.values()]
        return b"".join(kept + nodes + constants)

    def _add(self, node: Node) -> None:
        """Add a node of the model, and the rounding of its inputs and outputs."""
        types = [self._types.get(name, 0) for name in node.inputs]
        inputs = [self._replaced.get(name, name) for name in node.inputs]
        results = output_types(node, types)
        exact = self._integers.add(node, types, results[0]) or node.operator in EXACT
        if node.operator in SUMS and not exact:
            inputs = [
                self._rounded(name, type) if type in _UNIT_ROUNDOFF else name
                for name, type in zip(inputs, types, strict=True)
            ]
        if node.operator == "Cast" and types[0] in _UNIT_ROUNDOFF:
            inputs = [self._clipped(inputs[0], types[0], results[0])]
        self._types |= zip(node.outputs, results, strict=True)
        if exact:
            self._emit(inputs, node.outputs, node.rest)
            return
        before = [
            self._new_name() if name and type in _UNIT_ROUNDOFF else name
            for name, type in zip(node.outputs, results, strict=True)
        ]
        self._emit(inputs, before, node.rest)
        for name, type, unrounded in zip(node.outputs, results, before, strict=True):
            if unrounded != name:
                self._rounded(unrounded, type, name, FLOORS.get(node.operator, 0.0))

    def _rounded(self, name: str, type: int, output: str = "", floor: float = 0.0) -> str:
        """Add nodes that round a value at random; return the name of the result."""
        δ = _AMPLITUDE * _UNIT_ROUNDOFF[type]
        factor = self._either(name, 1.0 - δ, 1.0 + δ, type)
        if floor == 0.0:
            return self._node("Mul", [name, factor], output)
        product = self._node("Mul", [name, factor])
        absolute = self._either(name, -floor * δ, floor * δ, type)
        return self._node("Add", [product, absolute], output)

    def _either(self, name: str, first: float, second: float, type: int) -> str:
        """Add a value of the same shape, each entry one of two numbers at random."""
        half, training = self._constant(0.5, FLOAT), self._constant(True, BOOL)
        seed = message(
            schema.ATTRIBUTE, name=b"seed", i=secrets.randbits(31), type=_INTEGER_ATTRIBUTE
        )
        mask = self._new_name()
        self._emit(
            [name, half, training],
            [self._new_name(), mask],
            message(schema.NODE, op_type=b"Dropout", attribute=seed),
        )
        ends = self._constant(first, type), self._constant(second, type)
        return self._node("Where", [mask, *ends])

    def _clipped(self, name: str, type: int, target: int) -> str:
        """Add a value clipped to the range of a type of integers; of another type, as it is."""
        if target not in _END_OF_INTEGERS:
            return name
        end = np.dtype(FORMATS[type]).type(_END_OF_INTEGERS[target])
        last = float(np.nextafter(end, end.dtype.type(0)))
        ends = self._constant(-float(end), type), self._constant(last, type)
        return self._node("Clip", [name, *ends])

    def _constant(self, value: float, type: int) -> str:
        name = f"{self._prefix}/{type}/{value!r}"
        raw = np.array(value, FORMATS[type]).tobytes()
        self._constants[name] = message(
            schema.TENSOR, data_type=type, name=name.encode(), raw_data=raw
        )
        return name

    def _node(self, operator: str, inputs: list[str], output: str = "") -> str:
        """Add a node with one output; return its name."""
        output = output or self._new_name()
        self._emit(inputs, [output], message(schema.NODE, op_type=operator.encode()))
        return output

    def _emit(self, inputs: list[str], outputs: list[str], rest: bytes) -> None:
        """Add a node; `rest` is its fields but the names of its values."""
        names = [message(schema.NODE, input=to_bytes(name)) for name in inputs]
        names += [message(schema.NODE, output=to_bytes(name)) for name in outputs]
        self._nodes.append(b"".join([*names, rest]))

    def _new_name(self) -> str:
        self._count += 1
        return f"{self._prefix}/{self._count}"
