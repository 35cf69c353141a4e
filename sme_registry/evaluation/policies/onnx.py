"""ONNX files, run by onnxruntime in this process and without limits.

Open only files whose author you trust: the leaderboard runs others' in a sandbox.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sme_registry.envs.types import Observation as Observations
from sme_registry.errors import MissingDependencyError, PolicyError
from sme_registry.evaluation.policies.interface import Interface


def load_onnx(path: str | os.PathLike[str], interface: Interface) -> Callable[[Observations], Any]:
    """Load an ONNX file's network, on one thread of the CPU.

    Args:
      path: an .onnx file with one float32 input `[B, O]` and one output `[B, A]`. It runs in this
        process without limits.
      interface: O, A, and what they belong to.

    Returns:
      Its actions, as a function of observations.

    Raises:
      PolicyError: it does not exist, onnxruntime rejects it, or its interface differs.
      MissingDependencyError: onnxruntime is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise PolicyError(f"{path} does not exist. Give the path of an .onnx file.")
    # From version 1.31 on its telemetry is on by default; an evaluation must not send any.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        import onnxruntime
    except ImportError:
        raise MissingDependencyError(
            f"{path}: running it requires onnxruntime, which is not installed. "
            "Run `pip install 'sme-registry[onnx]'`."
        ) from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised instead
    try:
        session = onnxruntime.InferenceSession(
            os.fspath(path), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:
        raise PolicyError(
            f"{path}: not a network that onnxruntime can load: {error}. Export it again "
            "with an opset from 13 to 23, or pass a callable."
        ) from error
    for what, ends, width in zip(
        ("input", "output"),
        (session.get_inputs(), session.get_outputs()),
        interface[:2],
        strict=True,
    ):
        actual = ", ".join(f"{end.name} {end.type} {end.shape}" for end in ends)
        # A length that is not a number is dynamic, and known only when the network runs.
        fits = len(ends) == 1 and ends[0].type == "tensor(float)" and len(ends[0].shape) == 2
        if not fits or any(
            isinstance(length, int) and length != wanted
            for length, wanted in zip(ends[0].shape, (None, width), strict=True)
        ):
            raise PolicyError(
                f"{path}: its {what}s are {actual or 'none'}: must be one tensor(float) "
                f"[batch, {width}] for {interface.description}, the batch of any size. Evaluate it "
                "on the task it was trained for, and export it with a dynamic batch axis."
            )
    observation = session.get_inputs()[0].name
    return lambda observations: session.run(None, {observation: observations})[0]
