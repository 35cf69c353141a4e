"""Atomic writes: a file is written completely or not at all.

All files are written through `atomic_file`, most of them by `write_atomically`: to a temporary file
next to the target, which then replaces the target. A killed process leaves the old file and at
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

TEMPORARY = ".*.tmp*"  # the last star: SQLite adds suffixes for its own temporary files


def temporary_beside(path: Path) -> Path:
    """A new path in the folder of `path`, which `TEMPORARY` matches."""
    return path.with_name(f".{path.name[:64]}.{secrets.token_hex(4)}.tmp")


@contextlib.contextmanager
def atomic_file(path: Path, *, new: bool = False) -> Iterator[BinaryIO]:
    """A stream whose content becomes `path` if the block succeeds; otherwise nothing changes.

    Args:
      path: the target; its folder must exist.
      new: link instead of rename, so that an existing file is never replaced.

    Raises:
      OSError: the disk is full, the folder is not writable, or with `new` the target exists; an
        existing target is unchanged.
    """
    temporary = temporary_beside(path)
    try:
        # Not mkstemp, whose mode 0600 hides results from colleagues: the user's umask decides.
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
    """Write a file completely or not at all; its folder is created if it is missing.

    Args:
      path: the target; an existing file is replaced.
      content: text (written as UTF-8) or bytes.

    Returns:
      The path written.

    Raises:
      OptionError: the folder cannot be created or written to; an existing file is unchanged.
    """
    path = Path(path)
    try:
        data = content.encode("utf-8") if isinstance(content, str) else content
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as stream:
            stream.write(data)
    except (OSError, ValueError) as error:  # ValueError: a path with a null byte, broken text
        raise unwritable(path, error) from None
    return path


def unwritable(path: Path, error: Exception) -> OptionError:
    """The error for a file or folder that cannot be written."""
    reason = getattr(error, "strerror", None) or str(error)
    return OptionError(
        f"{path}: cannot be written: {reason}. Give a path in a folder that you may write to."
    )
