"""`Network`: a policy that can be written as ONNX; and networks of arrays, without PyTorch.

A network of arrays has one Gemm and one activation for each layer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sme_registry.compiled.arrays import Observation
from sme_registry.evaluation import OfflinePolicy, Perceptron

OPSET = 17
INPUT, OUTPUT = "observations", "actions"
_OPERATORS = {"relu": "Relu", "tanh": "Tanh", "sigmoid": "Sigmoid", "elu": "Elu"}
_IR_VERSION = 8  # of opset 17


class Network(NamedTuple):
    """A policy that can be written as ONNX."""

    observation_dim: int
    act: Callable[[Observation], Any]
    to_onnx: Callable[[], bytes]


def of_offline_policy(policy: OfflinePolicy) -> Perceptron:
    """The same network: ReLU between the layers, tanh scaled to [0, 1] after the last."""
    layers = [(W.T, b, "relu") for W, b in policy.layers]
    layers[-1] = (*layers[-1][:2], "tanh")
    A = policy.action_dim
    return Perceptron(layers, np.zeros(A, np.float32), np.ones(A, np.float32))


def network(perceptron: Perceptron, symmetric: bool) -> Network:
    """A perceptron whose actions are in [−1, 1] if `symmetric`, else in [0, 1]."""

    def act(observations: Any) -> Any:
        actions = perceptron(observations)
        return (actions + 1.0) * 0.5 if symmetric else actions

    return Network(perceptron.observation_dim, act, lambda: _onnx(perceptron, symmetric))


def _onnx(perceptron: Perceptron, symmetric: bool) -> bytes:
    from onnx import TensorProto, helper

    graph = _Graph()
    x = INPUT
    for W, b, activation in perceptron.layers:
        x = graph.node("Gemm", x, graph.constant(W), graph.constant(b))
        x = graph.activation(activation, x)
    if perceptron.low is not None and perceptron.high is not None:
        x = graph.affine(x, 0.5 * (perceptron.high - perceptron.low), perceptron.low)
    if symmetric:
        x = graph.affine(x, np.float32(0.5), np.float32(0.0))
    x = graph.node("Clip", x, graph.constant(np.float32(0.0)), graph.constant(np.float32(1.0)))
    graph.nodes.append(helper.make_node("Identity", [x], [OUTPUT]))
    widths = {INPUT: perceptron.observation_dim, OUTPUT: perceptron.action_dim}
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width])
        for name, width in widths.items()
    ]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "policy", ends[:1], ends[1:], graph.constants),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=_IR_VERSION,
        producer_name="sme-registry",
    )
    return bytes(model.SerializeToString())


class _Graph:
    """Nodes and constants of a graph, named by their order."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def node(self, operator: str, *inputs: str) -> str:
        from onnx import helper

        output = f"x{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [output]))
        return output

    def constant(self, array: Any) -> str:
        from onnx import numpy_helper

        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(array, np.float32), name))
        return name

    def activation(self, name: str, x: str) -> str:
        if name == "identity":
            return x
        if name == "silu":
            return self.node("Mul", x, self.node("Sigmoid", x))
        return self.node(_OPERATORS[name], x)

    def affine(self, x: str, scale: Any, low: Any) -> str:
        """low + scale (x + 1)."""
        x = self.node("Add", x, self.constant(np.float32(1.0)))
        return self.node("Add", self.node("Mul", x, self.constant(scale)), self.constant(low))
