"""`Network`: a policy that can be written as ONNX, and what its file must do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from sme_registry.envs.types import Observation

OPSET = 17
INPUT, OUTPUT = "observations", "actions"


class Network(NamedTuple):
    """A policy that can be written as ONNX."""

    observation_dim: int
    act: Callable[[Observation], Any]
    to_onnx: Callable[[], bytes]
