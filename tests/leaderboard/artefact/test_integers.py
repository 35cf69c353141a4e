"""Only arithmetic on integers that are small for certain is exact."""

from __future__ import annotations

import numpy as np
from onnx import TensorProto

from leaderboard.artefact import schema
from leaderboard.artefact.graph import BOOL, FLOAT, node_of, read
from leaderboard.artefact.integers import Integers
from tests.leaderboard.artefact.models import node, squashed, tensor

f32 = np.float32
CONSTANTS = {
    "one": f32(1),
    "nine": f32(9),
    "minus": f32(-9),
    "half": f32(0.5),
    "large": f32(2.0**23),
    "most": f32(2.0**24),
    "nan": f32(np.nan),
    "W": np.full((2, 3), 5.0, f32),
    "V": np.full((2, 3), 0.1, f32),
    "double": np.float64(2.0**40),
}
SMALL = [node("Floor", "y", "f"), node("Clip", "f minus nine", "x")]  # |x| <= 9


def exact(*nodes):
    """Whether the last of some nodes computes integers exactly."""
    tensors = [tensor(name, value) for name, value in CONSTANTS.items()]
    data = squashed(list(nodes), tensors).SerializeToString()
    graph = read(read(memoryview(data), schema.MODEL)["graph"][0], schema.GRAPH)
    integers = Integers([read(each, schema.TENSOR) for each in graph["initializer"]])
    for each in map(node_of, graph["node"]):
        types = [BOOL if name == "b" else FLOAT for name in each.inputs]
        last = integers.add(each, types, BOOL if each.operator == "Less" else FLOAT)
    return last


EXACT = {
    "a clipped floor": SMALL,
    "a sum": [*SMALL, node("Add", "x nine", "a")],
    "a product": [*SMALL, node("Mul", "x x", "a")],
    "a product with weights on the left": [*SMALL, node("MatMul", "W x", "a")],
    "an affine map": [*SMALL, node("Gemm", "x W one", "a")],
    "a truth value": [node("Less", "y half", "b"), node("Cast", "b", "a", to=TensorProto.FLOAT)],
    "a sign": [node("Sign", "y", "s"), node("Mul", "s most", "a")],
    "a choice": [*SMALL, node("Where", "b x nine", "w"), node("Mul", "w large", "l"),
                 node("Sign", "l", "a")],
    "a constant node": [node("Constant", "", "c", value=tensor("", f32(3))),
                        node("Mul", "c nine", "a")],
}  # fmt: skip
NOT_EXACT = {
    "no integer": [node("Mul", "y one", "a")],
    "a floor without bounds": [node("Floor", "y", "x"), node("Mul", "x one", "a")],
    "a floor with one bound": [node("Floor", "y", "f"), node("Clip", "f minus", "x"),
                               node("Mul", "x one", "a")],
    "a large product": [*SMALL, node("Mul", "x large", "a")],
    "a sum that becomes small again": [node("Add", "most one", "l"), node("Sub", "l most", "a")],
    "a large constant in double precision": [*SMALL, node("Mul", "x double", "a")],
    "weights that are no integers": [*SMALL, node("MatMul", "x V", "a")],
    "a product of values": [*SMALL, node("MatMul", "x x", "a")],
    "an affine map with factors": [*SMALL, node("Gemm", "x W one", "a", alpha=0.1)],
    "a choice of another value": [*SMALL, node("Where", "b x y", "w"), node("Mul", "w one", "a")],
    "a quotient": [*SMALL, node("Div", "x nine", "a")],
    "a constant that is no number": [*SMALL, node("Mul", "x nan", "a")],
}  # fmt: skip


def test_arithmetic_on_small_integers_is_exact_and_other_arithmetic_is_not():
    assert {kind for kind, nodes in (EXACT | NOT_EXACT).items() if exact(*nodes)} == set(EXACT)
