"""`network_of`: the network of a submitted file as numbers, for a page that computes it.

The confined child reads the file. Nothing but numbers leaves this module: no name and no text.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import numpy.typing as npt

from leaderboard.errors import Rejection
from leaderboard.gate.isolation import Isolation
from leaderboard.gate.sandbox import Confined
from sme_registry.errors import SMEError
from sme_registry.explorer import GraphNode, NetworkProgram, program_of_graph
from sme_registry.io import parse_json

_MOST_LISTS = 2**16  # of a network that the gate accepts; a child taken over may send more
_TYPES = ("<f4", "<f8", "<i4", "<i8")


def network_of(
    data: bytes, observation_dim: int, action_dim: int, isolation: Isolation | None = None
) -> NetworkProgram | None:
    """The network of an ONNX file; None if it is no network that a page can compute.

    Args:
      data: the bytes of the file.
      observation_dim: the width of its input.
      action_dim: the width of its output.
      isolation: of the child; None for the one that this machine has.

    Raises:
      ScoringFault: the child does not start, or the machine lacks memory or processor time.
    """
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
