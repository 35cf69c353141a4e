"""One compile cache for all workers of a test run."""

import os
import tempfile
from pathlib import Path

os.environ.setdefault(
    "SME_JAX_CACHE", str(Path(tempfile.gettempdir()) / f"sme-jax-cache-{os.getuid()}")
)
