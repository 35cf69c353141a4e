"""Atomic writes: a file is written completely or not at all.

Every file this package writes goes through `atomic_file`, most by `write_atomically`: into a
temporary file beside the target, then renamed over it. A killed process leaves the old file and at
most a temporary file that `TEMPORARY` matches.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from sme_registry.errors import OptionError

TEMPORARY = ".*.tmp*"  # the star at the end: SQLite's own files beside one of ours


def temporary_beside(path: Path) -> Path:
    """A new name beside `path`, in its file system, that `TEMPORARY` matches."""
    return path.with_name(f".{path.name[:64]}.{secrets.token_hex(4)}.tmp")


@contextlib.contextmanager
def atomic_file(path: Path, *, new: bool = False) -> Iterator[BinaryIO]:
    """A stream whose bytes become `path` when the block ends well, and nothing otherwise.

    Args:
      path: the target, in a folder that is there.
      new: link instead of rename, so that an existing file is never replaced.

    Raises:
      OSError: the disk is full, the folder cannot be written to, or (`new`) the name is taken;
        what stood there is untouched.
    """
    temporary = temporary_beside(path)
    try:
        # Not mkstemp, whose 0600 would hide results from colleagues; the umask is the user's.
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        with os.fdopen(handle, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        if new:
            os.link(temporary, path)
        else:
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError, ValueError):
            os.unlink(temporary)


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a file whole or not at all; the folder is made where it is missing.

    Args:
      path: the target; an existing file is replaced.
      content: text (written as UTF-8) or bytes.

    Returns:
      The path written.

    Raises:
      OptionError: the folder cannot be made or written to; what stood there is untouched.
    """
    path = Path(path)
    try:
        data = content.encode("utf-8") if isinstance(content, str) else content
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as stream:
            stream.write(data)
    except (OSError, ValueError) as error:  # ValueError: a path with a null byte, broken text
        reason = getattr(error, "strerror", None) or str(error)
        raise OptionError(
            f"{path}: cannot be written: {reason}. Give a path in a folder that you may write to."
        ) from None
    return path
