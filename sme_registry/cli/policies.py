"""The policies that `sme evaluate` takes: a file, `module:function`, or a reference."""

from __future__ import annotations

import os
from typing import Any

from sme_registry.errors import PolicyError, UnknownNameError, did_you_mean
from sme_registry.evaluation.references import POLICIES, reference_policy
from sme_registry.io import import_object
from sme_registry.spec import SMESpec

REFERENCES = tuple(POLICIES)


def find_policy(name: str, spec: SMESpec) -> Any:
    """What `evaluate` takes as a policy.

    Args:
      name: a path ending in .zip, .onnx or .npz, `module:function` (looked for in this folder,
        too), or the name of a reference policy.
      spec: the task it is for.

    Raises:
      UnknownNameError: none of these.
      PolicyError: the module or its function is not there, or fails when it is imported.
    """
    if name in REFERENCES:
        return reference_policy(name, spec)
    if name.endswith(".npz"):
        from sme_registry.offline import OfflinePolicy

        return OfflinePolicy.load(name)
    if name.endswith((".zip", ".onnx")) or (os.sep in name and os.path.exists(name)):
        return name
    if ":" in name:
        return _imported(name)
    raise UnknownNameError(
        f"policy={name!r}: must be a .zip, .onnx or .npz, a module:function, or one of "
        f"{', '.join(REFERENCES)}.{did_you_mean(name, REFERENCES)}"
    )


def _imported(name: str) -> Any:
    found = import_object(name, "policy", PolicyError)
    if not callable(found):
        raise PolicyError(
            f"policy={name!r}: is a {type(found).__name__}: must be a function from observations "
            f"to actions."
        )
    return found
