"""The reference policies as ONNX files: the optimal policy π*, and the constant ½.

They pass the same gate, sandbox and scorer as every submission. If their scores differ from 0 and
1, the pipeline is faulty. Source: METHOD, section 1. `B` batch, `S` state_dim, `A` action_dim.

    π*(s) = Φ(W_L Φ(… Φ(W_1 s + b_1) …) + b_L)

Float64 is needed: float32 rounding causes a regret of 9e-6 at complexity 50. ONNX Runtime has no
`Erf` for float64, so Φ is a table with step h = 1/512, and between its entries the integral of the
density φ by the midpoint rule. With c the multiple of h nearest to x:

    Φ(x) = Φ(c) + (x − c) φ((x + c)/2),  |x − c| ≤ h/2,  within (h/2)³ max |φ″| / 24 = 2e-11

Beyond ±8.5, where x is clipped, Φ is within 1e-17 of 0 or 1. The products come out in units of h,
so rounding one gives its index into the table; negative indices count from the table's end.

Operators: Cast, Gemm, Clip, Round, Sub, Gather, Add, Mul, Exp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from sme_registry import SMESpec, materialize
from sme_registry.errors import SpecError
from sme_registry.io import require_packages
from sme_registry.task import Layer

OPSET = 17
_IR_VERSION = 8

_LIMIT = 8.5
_CELLS_PER_UNIT = 512
_h = 1.0 / _CELLS_PER_UNIT
_LAST_CELL = int(_LIMIT * _CELLS_PER_UNIT)


def optimal_onnx(spec: SMESpec) -> bytes:
    """π* of a task as an ONNX file.

    Args:
      spec: the task, of a single agent.

    Returns:
      The file's bytes: input `observations` `[B, S + 2]` float32, output `actions` `[B, A]`
      float32 in [0, 1], the nearest float32 to π*(s) up to an error of about 1e-10.

    Raises:
      SpecError: the spec has a team.
      ResourceLimitError: the task does not fit in memory.
      MissingDependencyError: the package `onnx` is not installed.
    """
    graph = _Graph(spec)
    cells = np.arange(_LAST_CELL + 1)
    table = ndtr(np.concatenate([cells, -cells[:0:-1]]) * _h)
    graph.constant("table", table)
    graph.constant("first_cell", np.array(-float(_LAST_CELL)))
    graph.constant("last_cell", np.array(float(_LAST_CELL)))
    graph.constant("to_exponent", np.array(-0.5 * (_h / 2.0) ** 2))
    graph.constant("to_density", np.array(_h / math.sqrt(2.0 * math.pi)))

    x = graph.node("Cast", ["observations"], "states", to="DOUBLE")
    layers = cast(list[Layer], materialize(spec).layers)
    for index, (W, b) in enumerate(layers):
        # π* does not depend on t/T and r_cum/k.
        inputs = W if index > 0 else np.hstack([W, np.zeros((len(W), 2))])
        x = _uniform_layer(graph, f"layer_{index}", x, inputs, b)
    graph.node("Cast", [x], "actions", to="FLOAT")
    return graph.to_bytes("optimal")


def constant_onnx(spec: SMESpec) -> bytes:
    """The constant policy as an ONNX file: exactly ½ in every channel of every row.

    Args:
      spec: the task, of a single agent.

    Returns:
      The file's bytes, with the interface of `optimal_onnx`.

    Raises:
      SpecError: the spec has a team.
      MissingDependencyError: the package `onnx` is not installed.
    """
    graph = _Graph(spec)
    graph.constant("zero", np.zeros((spec.state_dim + 2, spec.action_dim), np.float32))
    graph.constant("half", np.full(spec.action_dim, 0.5, np.float32))
    graph.node("Gemm", ["observations", "zero", "half"], "actions")
    return graph.to_bytes("constant")


def _uniform_layer(
    graph: _Graph, name: str, x: str, W: npt.NDArray[np.float64], b: npt.NDArray[np.float64]
) -> str:
    """Add Φ(W x + b) of the value `x`; return the name of the result."""
    weights = graph.constant(f"{name}/W", np.ascontiguousarray(W.T) * _CELLS_PER_UNIT)
    offset = graph.constant(f"{name}/b", b * _CELLS_PER_UNIT)
    product = graph.node("Gemm", [x, weights, offset], f"{name}/product")
    x = graph.node("Clip", [product, "first_cell", "last_cell"], f"{name}/x")
    c = graph.node("Round", [x], f"{name}/c")
    place = graph.node("Cast", [c], f"{name}/place", to="INT32")
    nearest = graph.node("Gather", ["table", place], f"{name}/nearest")
    distance = graph.node("Sub", [x, c], f"{name}/distance")
    twice = graph.node("Add", [x, c], f"{name}/twice_the_midpoint")
    square = graph.node("Mul", [twice, twice], f"{name}/square")
    exponent = graph.node("Mul", [square, "to_exponent"], f"{name}/exponent")
    density = graph.node("Exp", [exponent], f"{name}/density")
    scaled = graph.node("Mul", [distance, "to_density"], f"{name}/scaled_distance")
    integral = graph.node("Mul", [scaled, density], f"{name}/integral")
    return graph.node("Add", [nearest, integral], f"{name}/y")


class _Graph:
    """An ONNX graph under construction. Values are referred to by name."""

    def __init__(self, spec: SMESpec) -> None:
        if spec.team is not None:
            raise SpecError(
                f"team: {len(spec.team.agents)} agents: boards have single agents only. "
                "Give a spec without a team."
            )
        require_packages("writing reference policies", {"onnx": "onnx"}, "leaderboard")
        import onnx

        self._onnx, self._spec = onnx, spec
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, name: str, value: npt.NDArray[Any]) -> str:
        """Add an array; return its name."""
        self._constants.append(self._onnx.numpy_helper.from_array(value, name))
        return name

    def node(self, op: str, inputs: Sequence[str], output: str, to: str | None = None) -> str:
        """Add a node with one output; return its name. `to` is the target type of a Cast."""
        attributes = {} if to is None else {"to": getattr(self._onnx.TensorProto, to)}
        self._nodes.append(self._onnx.helper.make_node(op, inputs, [output], **attributes))
        return output

    def to_bytes(self, name: str) -> bytes:
        """The model's bytes, from `observations` `[B, S + 2]` to `actions` `[B, A]`."""
        value, FLOAT = self._onnx.helper.make_tensor_value_info, self._onnx.TensorProto.FLOAT
        graph = self._onnx.helper.make_graph(
            self._nodes,
            name,
            [value("observations", FLOAT, ["batch", self._spec.state_dim + 2])],
            [value("actions", FLOAT, ["batch", self._spec.action_dim])],
            self._constants,
        )
        model = self._onnx.helper.make_model(
            graph,
            opset_imports=[self._onnx.helper.make_opsetid("", OPSET)],
            ir_version=_IR_VERSION,
            producer_name="sme-registry",
        )
        return bytes(model.SerializeToString(deterministic=True))
