"""ONNX files, run by onnxruntime in this process and without limits.

Open only files whose author you trust: the leaderboard runs others' in a sandbox.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sme_registry.envs.types import Observation
from sme_registry.errors import PolicyError
from sme_registry.evaluation.policies.policy import Interface
from sme_registry.io import require_packages
from sme_registry.spec import ACTION_RANGES

ACTION_RANGE = "action_range"  # a field of a file's metadata: "unit" or "symmetric"


def load_onnx(path: str | os.PathLike[str], interface: Interface) -> OnnxNetwork:
    """Load an ONNX file's network, on one thread of the CPU: a function of observations."""
    path = Path(path)
    if not path.is_file():
        raise PolicyError(f"{path} does not exist. Give the path of an .onnx file.")
    session = start_session(path)
    ends = {"input": session.get_inputs(), "output": session.get_outputs()}
    for (what, tensors), width in zip(ends.items(), interface[:2], strict=True):
        shape = tensors[0].shape if len(tensors) == 1 else []
        # A length that is not a number is dynamic, and known only when the network runs.
        fits = len(shape) == 2 and not isinstance(shape[0], int)
        fits = fits and (not isinstance(shape[1], int) or shape[1] == width)
        if not fits or tensors[0].type != "tensor(float)":
            actual = ", ".join(f"{tensor.name} {tensor.type} {tensor.shape}" for tensor in tensors)
            raise PolicyError(
                f"{path}: its {what}s are {actual or 'none'}: must be one tensor(float) "
                f"[batch, {width}] for {interface.description}, the batch of any size. Evaluate it "
                "on the task it was trained for, and export it with a dynamic batch axis."
            )
    return OnnxNetwork(session, path)


class OnnxNetwork:
    """An ONNX network: a function of observations."""

    def __init__(self, session: Any, path: Path) -> None:
        self._session, self._input = session, session.get_inputs()[0].name
        self.path = path
        recorded = session.get_modelmeta().custom_metadata_map.get(ACTION_RANGE)
        self.action_range = recorded if recorded in ACTION_RANGES else None

    def __call__(self, observations: Observation) -> Any:
        """Actions `[B, A]` for observations `[B, O]`."""
        return self._session.run(None, {self._input: observations})[0]


def start_session(model: Path | bytes) -> Any:
    """A session of onnxruntime for a file or its content."""
    name = "model" if isinstance(model, bytes) else str(model)
    require_packages(f"running {name}", {"onnxruntime": "onnxruntime"}, "onnx")
    # From version 1.31 on its telemetry is on by default; an evaluation must not send any.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised instead
    try:
        return onnxruntime.InferenceSession(
            model if isinstance(model, bytes) else os.fspath(model),
            options,
            providers=["CPUExecutionProvider"],
        )
    except Exception as error:
        raise PolicyError(
            f"{name}: not a network that onnxruntime can load: {error}. Export it again "
            "with an opset from 13 to 23, or pass a callable."
        ) from error
