"""Files that are whole or absent: a temporary one beside, fsync, then rename or link, then fsync.

A process that is killed leaves at most a temporary file, `.name.xxxxxxxx.tmp`, which `gc` removes.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from leaderboard.errors import BoardError

TEMPORARY = ".*.tmp*"  # the star at the end: SQLite's own files beside one of ours


def temporary_beside(path: Path) -> Path:
    """A new name beside `path`, in its file system, that `TEMPORARY` matches."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


@contextlib.contextmanager
def whole(path: Path, *, new: bool = False) -> Iterator[BinaryIO]:
    """A stream whose bytes become `path` when the block ends well, and nothing otherwise.

    Args:
      path: the target; its folder is made where it is missing.
      new: link instead of rename, so that an existing file is never replaced.

    Raises:
      BoardError: the disk is full, the folder cannot be written to, or (`new`) the name is taken.
    """
    temporary = temporary_beside(path)
    try:
        make_folder(path.parent)
        try:
            with open(temporary, "xb") as stream:
                os.fchmod(stream.fileno(), 0o644)
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            if new:
                os.link(temporary, path)
            else:
                os.replace(temporary, path)
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
        sync_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error


def write(path: Path, data: bytes, *, new: bool = False) -> None:
    """Write a file whole or not at all; arguments and errors as for `whole`."""
    with whole(path, new=new) as stream:
        stream.write(data)


def make_folder(path: Path) -> None:
    """Make a folder, if need be, such that it is still there after a loss of power."""
    if not path.is_dir():
        path.mkdir(parents=True, exist_ok=True)
        sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Make the names in a folder durable."""
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def unwritable(path: Path, error: OSError) -> BoardError:
    """What to raise where a write failed."""
    return BoardError(
        f"{path}: cannot be written: {error.strerror or error}. "
        "Nothing was changed. Make room or give the right to write, and try again."
    )
