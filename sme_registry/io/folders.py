"""Output folders: refuse existing ones, and build new ones completely or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path

from sme_registry.errors import OptionError
from sme_registry.io.files import temporary_beside, unwritable


def refuse_existing(path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Check that a file or folder does not exist yet, or may be replaced.

    Args:
      path: what a command is about to write.
      force: whether an existing one may be replaced.

    Returns:
      The path.

    Raises:
      OptionError: it exists and `force` is false.
    """
    path = Path(path)
    if os.path.lexists(path) and not force:
        raise OptionError(
            f"{path} already exists. Use --force to replace it (in Python, force=True)."
        )
    return path


def claim_folder(
    folder: str | os.PathLike[str], files: Collection[str], *, force: bool = False
) -> Path:
    """Create an output folder, or check that an existing one may be written to.

    Nothing is removed from it.

    Args:
      folder: the folder.
      files: names of the files and folders that the caller writes there. A folder that holds
        anything else is refused, even with `force`.
      force: whether these may be replaced.

    Returns:
      The folder, which exists.

    Raises:
      OptionError: it is a file, holds other files, holds `files` and `force` is false, or cannot
        be created.
    """
    folder = Path(folder)
    if os.path.lexists(folder) and not folder.is_dir():
        raise OptionError(f"{folder}: is a file. Give a folder.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in folder.iterdir())
    except (OSError, ValueError) as error:
        raise unwritable(folder, error) from None
    others = [name for name in names if name not in files]
    if others:
        raise OptionError(
            f"{folder}: contains other files, such as {others[0]!r}. Give an empty or a new folder."
        )
    if names:
        refuse_existing(folder, force=force)
    return folder


@contextlib.contextmanager
def build_folder(target: str | os.PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """Build a folder completely or not at all.

    The block writes into a temporary folder next to `target`, which is flushed to disk and renamed
    to `target` at the end. If the block fails, nothing remains of it. A killed process leaves at
    most folders that `TEMPORARY` matches.

    Args:
      target: the folder to build; its parent is created if it is missing.
      force: whether an existing `target`, file or folder, is replaced. It remains in place until
        the new one is complete, and is restored if the rename fails.

    Yields:
      The temporary folder, empty.

    Raises:
      OptionError: `target` exists and `force` is false, or writing fails, in the block or here.
    """
    target = refuse_existing(target, force=force)
    building, replaced = temporary_beside(target), temporary_beside(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        building.mkdir()
    except (OSError, ValueError) as error:  # ValueError: a path with a null byte
        raise unwritable(target, error) from None
    try:
        yield building
        _flush(building)
        refuse_existing(target, force=force)
        _replace(building, target, replaced)
        sync_folder(target.parent)
    except OSError as error:
        raise unwritable(target, error) from None
    finally:
        for path in (building, replaced):
            shutil.rmtree(path, ignore_errors=True)


def sync_folder(folder: str | os.PathLike[str]) -> None:
    """Flush a folder's list of names to disk, on systems where a folder can be opened."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _replace(building: Path, target: Path, replaced: Path) -> None:
    """Rename `building` to `target`; what stood there is moved to `replaced` or restored."""
    if not os.path.lexists(target):
        os.rename(building, target)
        return
    os.rename(target, replaced)
    try:
        os.rename(building, target)
    except BaseException:
        os.rename(replaced, target)
        raise
    if not replaced.is_dir() or replaced.is_symlink():
        replaced.unlink()


def _flush(folder: Path) -> None:
    """Flush a folder and everything in it to disk."""
    if os.name != "posix":
        return
    for parent, _, names in os.walk(folder):
        for name in names:
            with open(os.path.join(parent, name), "rb") as stream:
                os.fsync(stream.fileno())
        sync_folder(parent)
