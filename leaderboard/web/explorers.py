"""Explorers of submitted policies: pages that compute a policy's network in the browser.

The confined child reads the file. Nothing but numbers reaches a page: no name and no text. Of a
network that is not understood in full, or whose actions are not finite, it shows the task alone.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import numpy.typing as npt

from leaderboard.errors import Rejection
from leaderboard.gate.isolation import Isolation
from leaderboard.gate.sandbox import Confined, widths
from sme_registry import SMESpec
from sme_registry.diagnosis import load_policy
from sme_registry.errors import OptionError, PolicyError, ResourceLimitError, SMEError
from sme_registry.explorer import (
    STATIC,
    GraphNode,
    NetworkProgram,
    check_size,
    explorer_page,
    facts,
    program_of_graph,
)
from sme_registry.io import parse_json

_UNKNOWN = (
    "This page cannot compute the network of this policy. It shows the task, with a linear and a "
    "constant policy."
)
_MOST_LISTS = 2**16  # of a network that the gate accepts; a child taken over may send more
_TYPES = ("<f4", "<f8", "<i4", "<i8")


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


def network_of(
    data: bytes, observation_dim: int, action_dim: int, isolation: Isolation | None = None
) -> NetworkProgram | None:
    """The network of an ONNX file of these widths; None if a page cannot compute it.

    A ScoringFault is raised if the child does not start, or the machine lacks memory or time.
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


__all__ = ["STATIC", "can_show", "explorer", "network_of"]
