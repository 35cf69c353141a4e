"""A notice while Numba compiles: without it, the first environment looks like a hanging program.

Numba keeps what it compiled next to this package or in NUMBA_CACHE_DIR: once for each version.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator

_PATIENCE = 1.0  # seconds; loading what is already compiled takes a third of it
_TEXT = (
    "sme_registry: Numba is preparing the environment's step. The first time on a machine, this "
    "takes some seconds; SME_BACKEND=numpy does without."
)


@contextlib.contextmanager
def compiling() -> Iterator[None]:
    """Say what happens in the block if it takes long and somebody watches: on stderr, once."""
    timer = threading.Timer(_PATIENCE, print, [_TEXT], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    if _is_watched():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _is_watched() -> bool:
    """Whether stderr is a terminal or a notebook, rather than a log."""
    return sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
