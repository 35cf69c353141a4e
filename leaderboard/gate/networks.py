"""The reference policies as ONNX files: the optimal policy π*, and the constant ½; and `explorer`.

They pass the same gate, sandbox and scorer as every submission. If their scores differ from 0 and
1, the pipeline is faulty. Source: METHOD, section 1. `B` batch, `S` state_dim, `A` action_dim.

    π*(s) = Φ(W_L Φ(… Φ(W_1 s + b_1) …) + b_L)

Float64 is needed: float32 rounding causes a regret of 9e-6 at complexity 50. ONNX Runtime has no
`Erf` for float64, so Φ is a table with step h = 1/512, and between its entries the integral of the
density φ by the midpoint rule. With c the multiple of h nearest to x:

    Φ(x) = Φ(c) + (x − c) φ((x + c)/2),  |x − c| ≤ h/2,  within (h/2)³ max |φ″| / 24 = 2e-11

Beyond ±8.5, where x is clipped, Φ is within 1e-17 of 0 or 1. The products come out in units of h,
so rounding one gives its index into the table; negative indices count from the table's end.

A team's file is called for each agent with its shared observation, which ends with the agent's
one-hot index. It computes every agent's π*_i from the channels that the agent observes, and adds
up what the index selects:

    a = Σ_i 1[this is agent i] · (π*_i(s[O_i]), 0, …, 0)

Operators: Cast, Gemm, Clip, Round, Sub, Gather, Add, Mul, Exp.

Explorers are pages that compute a submitted policy's network in the browser. The confined child
reads the file, and nothing but numbers reaches a page: no name and no text. Of a network that is
not understood in full, or whose actions are not finite, it shows the task alone.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from leaderboard.errors import Rejection
from leaderboard.gate.isolation import Isolation
from leaderboard.gate.sandbox import Confined, widths
from sme_registry import SMESpec, materialize
from sme_registry.diagnosis import load_policy
from sme_registry.errors import OptionError, PolicyError, ResourceLimitError, SMEError
from sme_registry.explorer import (
    GraphNode,
    NetworkProgram,
    check_size,
    explorer_page,
    facts,
    program_of_graph,
)
from sme_registry.io import parse_json, require_packages
from sme_registry.task import Layer

OPSET = 17
_IR_VERSION = 8

_LIMIT = 8.5
_CELLS_PER_UNIT = 512
_h = 1.0 / _CELLS_PER_UNIT
_LAST_CELL = int(_LIMIT * _CELLS_PER_UNIT)


def optimal_onnx(spec: SMESpec) -> bytes:
    """π* of a task as an ONNX file, of the widths of `sandbox.widths`.

    From `observations` `[B, S + 2]` to `actions` `[B, A]` in [0, 1], float32, the nearest to π*(s)
    up to an error of about 1e-10.
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
    task = materialize(spec)
    if spec.team is None:
        x = _policy(graph, "", x, task.policies[0], task.observed[0])
    else:
        agents = zip(task.policies, task.observed, strict=True)
        actions = [
            _selected(graph, index, x, _policy(graph, f"agent_{index}/", x, layers, observed))
            for index, (layers, observed) in enumerate(agents)
        ]
        x = actions[0]
        for index, each in enumerate(actions[1:], start=1):
            x = graph.node("Add", [x, each], f"agents_to_{index}")
    graph.node("Cast", [x], "actions", to="FLOAT")
    return graph.to_bytes("optimal")


def _policy(
    graph: _Graph, prefix: str, x: str, layers: Sequence[Layer], observed: Sequence[int]
) -> str:
    """Add π* of one agent of the observations `x`, float64; return the name of the result."""
    for index, (W, b) in enumerate(layers):
        inputs = W
        if index == 0:  # π* does not depend on t/T, r_cum/k and what the agent does not observe
            inputs = np.zeros((len(W), graph.observation_dim))
            inputs[:, list(observed)] = W
        x = _uniform_layer(graph, f"{prefix}layer_{index}", x, inputs, b)
    return x


def _selected(graph: _Graph, index: int, x: str, action: str) -> str:
    """Add an agent's action, as wide as the widest one, times its entry of the one-hot index."""
    agents = len(graph.owned)
    entry = np.zeros((graph.observation_dim, graph.action_dim))
    entry[graph.observation_dim - agents + index] = 1.0
    indicator = graph.node(
        "Gemm", [x, graph.constant(f"agent_{index}/entry", entry)], f"agent_{index}/indicator"
    )
    wide = graph.constant(f"agent_{index}/wide", np.eye(graph.owned[index], graph.action_dim))
    widened = graph.node("Gemm", [action, wide], f"agent_{index}/widened")
    return graph.node("Mul", [indicator, widened], f"agent_{index}/selected")


def constant_onnx(spec: SMESpec) -> bytes:
    """The constant policy as such a file: exactly ½ in every channel of every row."""
    graph = _Graph(spec)
    graph.constant("zero", np.zeros((graph.observation_dim, graph.action_dim), np.float32))
    graph.constant("half", np.full(graph.action_dim, 0.5, np.float32))
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
        require_packages("writing reference policies", {"onnx": "onnx"}, "leaderboard")
        import onnx

        self._onnx = onnx
        self.observation_dim, self.action_dim = widths(spec)
        agents = () if spec.team is None else spec.team.agents
        self.owned = [agent.action_dim for agent in agents]  # action channels of each agent
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
        """The model's bytes, from `observations` to `actions`."""
        value, FLOAT = self._onnx.helper.make_tensor_value_info, self._onnx.TensorProto.FLOAT
        graph = self._onnx.helper.make_graph(
            self._nodes,
            name,
            [value("observations", FLOAT, ["batch", self.observation_dim])],
            [value("actions", FLOAT, ["batch", self.action_dim])],
            self._constants,
        )
        model = self._onnx.helper.make_model(
            graph,
            opset_imports=[self._onnx.helper.make_opsetid("", OPSET)],
            ir_version=_IR_VERSION,
            producer_name="sme-registry",
        )
        return bytes(model.SerializeToString(deterministic=True))


_MOST_LISTS = 2**16  # of a network that the gate accepts; a child taken over may send more
_TYPES = ("<f4", "<f8", "<i4", "<i8")


def network_of(
    data: bytes, observation_dim: int, action_dim: int, isolation: Isolation | None = None
) -> NetworkProgram | None:
    """The network of an ONNX file of these widths; None if a page cannot compute it."""
    try:
        with Confined(isolation=isolation) as child:
            text = child.network(data, observation_dim, action_dim)
    except Rejection:
        return None
    if text.count(b"[") + text.count(b"{") > _MOST_LISTS:
        return None
    try:
        network: Any = parse_json(text, "network")
        constants = {name: _array(tensor) for name, tensor in network["constants"].items()}
        nodes = [
            GraphNode(
                node["operator"],
                tuple(node["inputs"]),
                tuple(node["outputs"]),
                {
                    name: _array(value) if isinstance(value, dict) else value
                    for name, value in node["attributes"].items()
                },
            )
            for node in network["nodes"]
        ]
        ends = network["input"], network["output"]
    except (SMEError, KeyError, TypeError, AttributeError, ValueError):  # of a child taken over
        return None
    program = program_of_graph(nodes, constants, *ends, observation_dim)
    return program if program is not None and program.width == action_dim else None


def _array(tensor: dict[str, Any]) -> npt.NDArray[Any]:
    if tensor["type"] not in _TYPES:
        raise ValueError(f"a tensor of type {tensor['type']!r:.20}")
    content = base64.b64decode(tensor["data"], validate=True)
    return np.frombuffer(content, tensor["type"]).reshape(tensor["shape"])


_UNKNOWN = (
    "This page cannot compute the network of this policy. It shows the task, with a linear and a "
    "constant policy."
)


def can_show(spec: SMESpec) -> bool:
    """Whether a task is small enough for the page of an explorer."""
    try:
        check_size(spec)
    except (OptionError, ResourceLimitError):
        return False
    return True


def explorer(name: str, data: bytes, spec: SMESpec) -> str:
    """The page of a policy, of its ONNX file."""
    network = network_of(data, *widths(spec))
    if network is not None:
        try:
            subject = load_policy(network, spec, action_range="unit", name=name)
            return explorer_page(facts(subject), "../static/")
        except PolicyError:
            pass
    return explorer_page(facts(spec, remark=_UNKNOWN), "../static/")
