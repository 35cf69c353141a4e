"""The graph of a model that the gate has accepted: its messages, its nodes, and their types.

No name is decoded as anything but text, and no other parser of the format is used.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from graphlib import TopologicalSorter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from leaderboard.artefact import schema
from leaderboard.artefact.wire import Budget, encoded, fields

FLOAT, INT32, INT64, BOOL, DOUBLE = 1, 6, 7, 9, 11  # types of tensors; 0 is any other
FORMATS = {FLOAT: "<f4", DOUBLE: "<f8", BOOL: "?"}
PREDICATES = frozenset(
    ("And", "Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Not", "Or", "Xor")
)

_CONSTANT_TYPES = {"value_float": FLOAT, "value_floats": FLOAT}


class Node(NamedTuple):
    """A node: its operator, the names of its values, its attributes by name, and other fields."""

    operator: str
    inputs: list[str]
    outputs: list[str]
    attributes: dict[str, dict[str, list[Any]]]
    rest: bytes


def in_order(nodes: Iterable[Node]) -> list[Node]:
    """The nodes, each after those that compute its inputs; the format does not require it."""
    nodes = list(nodes)
    producers = {name: index for index, node in enumerate(nodes) for name in node.outputs if name}
    needed = {
        index: {producers[name] for name in node.inputs if name in producers}
        for index, node in enumerate(nodes)
    }
    return [nodes[index] for index in TopologicalSorter(needed).static_order()]


def node_of(data: memoryview) -> Node:
    """A node by its message."""
    node = read(data, schema.NODE)
    attributes = [read(each, schema.ATTRIBUTE) for each in node["attribute"]]
    rest = [
        message(schema.NODE, **{field: value})
        for field in ("op_type", "domain", "attribute")
        for value in node[field]
    ]
    return Node(
        operator=text(node["op_type"][0]),
        inputs=[text(name) for name in node["input"]],
        outputs=[text(name) for name in node["output"]],
        attributes={text(each["name"][0]): each for each in attributes},
        rest=b"".join(rest),
    )


def output_types(node: Node, types: list[int]) -> list[int]:
    """The types of a node's outputs, by those of its inputs."""
    if node.operator in PREDICATES:
        first = BOOL
    elif node.operator in ("ArgMax", "ArgMin"):
        first = INT64
    elif node.operator == "Cast":
        first = node.attributes["to"]["i"][0]
    elif node.operator == "Constant":
        name, attribute = next(iter(node.attributes.items()))
        first = _CONSTANT_TYPES.get(name, 0)
        if name == "value":
            first = read(attribute["t"][0], schema.TENSOR)["data_type"][0]
    else:
        first = types[1 if node.operator == "Where" else 0]
    rest = FLOAT if node.operator == "LayerNormalization" else first
    return [first, *[rest] * (len(node.outputs) - 1)]


def numbers(tensor: dict[str, list[Any]]) -> npt.NDArray[Any] | None:
    """The entries of a tensor of floating-point numbers, flat; None for another type."""
    type = tensor["data_type"][0]
    if type not in (FLOAT, DOUBLE):
        return None
    field = schema.TYPES[type].field
    return np.frombuffer(b"".join(tensor["raw_data"] or tensor[field]), FORMATS[type])


def read(data: memoryview, known: schema.Schema) -> dict[str, list[Any]]:
    """The values of a message's fields, by name. The gate has accepted the message."""
    values: dict[str, list[Any]] = {field.name: [] for field in known.values()}
    for number, _, value in fields(data, Budget(sys.maxsize)):
        values[known[number].name].append(value)
    return values


def message(known: schema.Schema, **values: int | bytes | memoryview) -> bytes:
    """The fields of a message that have these values."""
    fields = {field.name: number for number, field in known.items()}
    return b"".join(encoded(fields[name], value) for name, value in values.items())


def text(name: memoryview) -> str:
    """A name as text, without loss."""
    return bytes(name).decode("utf-8", "surrogateescape")


def to_bytes(name: str) -> bytes:
    """The bytes of a name."""
    return name.encode("utf-8", "surrogateescape")
