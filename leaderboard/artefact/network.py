"""`network_of`: the network of a submitted file as numbers, for a page that computes it.

The file is read by the gate's own parser, and only where the gate has accepted it. Nothing but
numbers leaves this module: no name and no text of the file.
"""

from __future__ import annotations

import sys
from graphlib import CycleError
from typing import Any

import numpy as np
import numpy.typing as npt

from leaderboard.artefact import schema
from leaderboard.artefact.gate import inspect
from leaderboard.artefact.graph import (
    DOUBLE,
    FLOAT,
    FORMATS,
    INT32,
    INT64,
    Node,
    in_order,
    node_of,
    read,
    text,
)
from leaderboard.artefact.wire import Budget, WireError, signed, varints
from leaderboard.errors import Rejection
from sme_registry.explorer import GraphNode, NetworkProgram, program_of_graph

_INTEGERS = {INT32: "<i4", INT64: "<i8"}


def network_of(data: bytes, observation_dim: int, action_dim: int) -> NetworkProgram | None:
    """The network of an ONNX file; None if it is no network that a page can compute.

    Args:
      data: the bytes of the file.
      observation_dim: the width of its input.
      action_dim: the width of its output.
    """
    try:
        inspect(data, observation_dim, action_dim)
        model = read(memoryview(data), schema.MODEL)
        graph = read(model["graph"][0], schema.GRAPH)
        tensors = [read(each, schema.TENSOR) for each in graph["initializer"]]
        constants = {text(each["name"][0]): _array(each) for each in tensors if each["name"]}
        nodes = [_graph_node(node) for node in in_order(map(node_of, graph["node"]))]
        ends = [
            text(read(graph[end][0], schema.VALUE_INFO)["name"][0]) for end in ("input", "output")
        ]
    except (Rejection, WireError, CycleError, KeyError, IndexError, ValueError):
        return None
    program = program_of_graph(nodes, constants, ends[0], ends[1], observation_dim)
    return program if program is not None and program.width == action_dim else None


def _graph_node(node: Node) -> GraphNode:
    attributes = {name: _value(attribute) for name, attribute in node.attributes.items()}
    return GraphNode(node.operator, tuple(node.inputs), tuple(node.outputs), attributes)


def _value(attribute: dict[str, list[Any]]) -> Any:
    """An attribute's number, list of numbers or array; None for text."""
    kind = schema.ATTRIBUTE_VALUES[attribute["type"][0]]
    values = attribute[kind]
    if kind == "i":
        return signed(values[0])
    if kind == "f":
        return float(np.frombuffer(values[0], "<f4")[0])
    if kind == "t":
        return _array(read(values[0], schema.TENSOR))
    if kind == "ints":
        return _integers(values)
    if kind == "floats":
        return np.frombuffer(b"".join(values), "<f4").tolist()
    return None


def _array(tensor: dict[str, list[Any]]) -> npt.NDArray[Any]:
    """A tensor of the file."""
    kind, dims = tensor["data_type"][0], _integers(tensor["dims"])
    field = schema.TYPES[kind].field
    if kind in (FLOAT, DOUBLE):
        content = b"".join(tensor["raw_data"] or tensor[field])
        return np.frombuffer(content, FORMATS[kind]).reshape(dims)
    if kind not in _INTEGERS:
        raise ValueError(f"a tensor of type {kind}")
    if tensor["raw_data"]:
        return np.frombuffer(b"".join(tensor["raw_data"]), _INTEGERS[kind]).reshape(dims)
    return np.array(_integers(tensor[field]), np.int64).reshape(dims)


def _integers(values: list[Any]) -> list[int]:
    """Repeated integers, packed or one by one."""
    found: list[int] = []
    for value in values:
        if isinstance(value, int):
            found.append(signed(value))
        else:
            found.extend(signed(each) for each in varints(value, Budget(sys.maxsize)))
    return found
