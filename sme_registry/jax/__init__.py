"""SMEs and agents on the accelerator: environment, learner and evaluation in one XLA program.

    params = task_params("SME/Default-v1")
    observation, state = reset(key, params)
    observation, state, reward, done, info = step(key, state, action, params)   # gymnax's signature

Importing the package configures the process's JAX, and turns 64-bit numbers on: states are float64,
as METHOD, section 1 defines them. Nothing outside this folder imports JAX.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from sme_registry.errors import OptionError
from sme_registry.io import check_writable, require_packages

CACHE_VARIABLE = "SME_JAX_CACHE"  # a folder, or "off"


def prepare() -> None:
    """Configure JAX for exact states, for agents equal to SB3's, and to keep compiled programs."""
    require_packages("tasks and agents on the accelerator", {"jax": "JAX"}, "jax")
    import jax

    # As a scope, 64-bit numbers fail under vmap of a scan.
    jax.config.update("jax_enable_x64", True)
    # Recent GPUs multiply float32 matrices in TF32 by default: one update of TD3 is then 2e-4 off.
    jax.config.update("jax_default_matmul_precision", "highest")
    folder = os.environ.get(CACHE_VARIABLE) or str(_cache_folder())
    if folder == "off" or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        check_writable(Path(folder) / "entry")
    except OptionError:
        print(  # no warning: training hides those of libraries
            f"sme_registry: {folder} cannot be written, so each process compiles its programs of "
            f"JAX again. Set {CACHE_VARIABLE} to a folder that you may write to, or to off.",
            file=sys.stderr,
        )
    else:
        jax.config.update("jax_compilation_cache_dir", folder)


def find_device(name: str | None = None) -> Any:
    """The first device of a platform: "cpu", "gpu" or "tpu"; None for JAX's default."""
    import jax

    if name is None:
        return jax.devices()[0]
    try:
        return jax.devices(name)[0]
    except RuntimeError:
        known = sorted({each.platform for each in jax.devices()} | {"cpu"})
        raise OptionError(
            f"device={name!r}: must be one of {', '.join(known)}, the devices that JAX finds here. "
            "For an NVIDIA GPU, install jax[cuda12] or jax[cuda13]."
        ) from None


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "sme-registry" / "jax"


prepare()
