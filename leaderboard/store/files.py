"""Files that are whole or absent, and durable: the folder that names them is synced, too.

A process that is killed leaves at most a temporary file, `.name.xxxxxxxx.tmp`, which `gc` removes.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from leaderboard.errors import BoardError
from sme_registry import io


@contextlib.contextmanager
def atomic_file(path: Path, *, new: bool = False) -> Iterator[BinaryIO]:
    """`sme_registry.io.atomic_file`, such that the file is still there after a loss of power.

    Args:
      path: the target; its folder is made where it is missing.
      new: never replace an existing file.

    Raises:
      BoardError: the disk is full, the folder cannot be written to, or (`new`) the name is taken.
    """
    try:
        make_folder(path.parent)
        with io.atomic_file(path, new=new) as stream:
            os.fchmod(stream.fileno(), 0o644)
            yield stream
        sync_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error


def write(path: Path, data: bytes, *, new: bool = False) -> None:
    """Write a file whole or not at all; arguments and errors as for `whole`."""
    with atomic_file(path, new=new) as stream:
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
