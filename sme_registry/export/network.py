"""`Network`: a policy that can be written as ONNX, and what its file must do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from sme_registry.envs.types import Observation

OPSET = 17
INPUT, OUTPUT = "observations", "actions"


class Network(NamedTuple):
    """A policy that can be written as ONNX.

    Attributes:
      observation_dim: entries of an observation.
      act: the policy's own actions `[B, A]` in the unit range, before they are clipped.
      to_onnx: writes the model, which clips them.
    """

    observation_dim: int
    act: Callable[[Observation], Any]
    to_onnx: Callable[[], bytes]
