"""`export_sb3`: a Stable-Baselines3 model as an ONNX file that boards accept.

`sme_registry.export_onnx` writes it; here it passes the checks of a board, too.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from leaderboard.artefact.gate import inspect
from sme_registry import SMESpec
from sme_registry.errors import PolicyError
from sme_registry.evaluation import load_sb3
from sme_registry.export import onnx_bytes
from sme_registry.io import require_packages, write_atomically


def export_sb3(
    model: Any,
    path: str | os.PathLike[str],
    *,
    vec_normalize: Any = None,
    spec: SMESpec | None = None,
) -> Path:
    """Write a model's deterministic policy as an ONNX file, and check it against the model.

    Args:
      model: a model of Stable-Baselines3 or sb3-contrib, or the path of its .zip (loading a .zip
        can run its author's code). Its action space is [0, 1] or [−1, 1] in every channel.
      path: the file to write, completely or not at all; an existing file is replaced.
      vec_normalize: see `sme_registry.export_onnx`.
      spec: the task, to check the widths; None skips the check.

    Returns:
      The path written.

    Raises:
      PolicyError: see `sme_registry.export_onnx`.
      Rejection: its network needs operators that no board accepts, or is too large.
      OptionError: the file cannot be written.
      MissingDependencyError: Stable-Baselines3, PyTorch, onnx or ONNX Runtime is not installed.
    """
    libraries = {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}
    require_packages("exporting a model", libraries, "train")
    if isinstance(model, str | os.PathLike):
        model = load_sb3(model)
    if not hasattr(model, "predict"):
        raise PolicyError(
            f"model={model!r:.80}: must be a Stable-Baselines3 model or the path of its .zip."
        )
    data = onnx_bytes(model, spec, vec_normalize=vec_normalize)
    inspect(data, *(space.shape[0] for space in (model.observation_space, model.action_space)))
    return write_atomically(path, data)
