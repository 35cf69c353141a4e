"""Files and folders that are written completely or not at all.

Both are written to a temporary path next to the target, which is then renamed to the target. A
killed process leaves the old target and at most temporary paths that `TEMPORARY` matches.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Collection, Iterator
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
    """Write text as UTF-8, or bytes, completely or not at all; returns the path.

    The folder is created if it is missing.

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


def refuse_existing(path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Return a path that a command is about to write; call it before the work, not after.

    Raises:
      OptionError: it exists and `force` is false, or nothing can be written there.
    """
    path = refuse_unwritable(path)
    if os.path.lexists(path) and not force:
        raise OptionError(
            f"{path} already exists. Use --force to replace it (in Python, force=True)."
        )
    return path


def refuse_unwritable(path: str | os.PathLike[str]) -> Path:
    """Return a path, of a file or a folder, whose parent folders can be created and written to.

    Nothing remains of the check.

    Raises:
      OptionError: they cannot.
    """
    path = Path(path)
    try:
        # As an absolute path, so that there is an existing parent. By a file rather than
        # `os.access`, which does not see read-only file systems.
        parent = next(each for each in path.absolute().parents if os.path.lexists(each))
        probe = temporary_beside(parent / path.name)
        os.close(os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        os.unlink(probe)
    except (OSError, ValueError) as error:
        raise unwritable(path, error) from None
    return path


def claim_folder(
    folder: str | os.PathLike[str], files: Collection[str], *, force: bool = False
) -> Path:
    """Create an output folder, or check that an existing one may be written to.

    Nothing is removed from it.

    Args:
      folder: the folder.
      files: names of the files and folders that the caller writes there.
      force: whether these may be replaced; other files are refused even then.

    Raises:
      OptionError: the folder is a file, holds other files that are not hidden, holds `files` and
        `force` is false, or cannot be created.
    """
    folder = Path(folder)
    if os.path.lexists(folder) and not folder.is_dir():
        raise OptionError(f"{folder}: is a file. Give a folder.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Hidden files may be locks, or writes of ours that were cut short.
        names = sorted(path.name for path in folder.iterdir() if path.name[0] != ".")
    except (OSError, ValueError) as error:
        raise unwritable(folder, error) from None
    others = [name for name in names if name not in files]
    if others:
        raise OptionError(
            f"{folder}: contains other files, such as {others[0]!r}. Give an empty or a new folder."
        )
    if names:
        refuse_existing(folder, force=force)
    refuse_unwritable(folder / "run")
    return folder


@contextlib.contextmanager
def build_folder(target: str | os.PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """Build a folder completely or not at all.

    The block writes into a temporary folder, which is flushed to disk and renamed to `target` at
    the end. If the block fails, nothing remains of it.

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


def unwritable(path: Path, error: Exception) -> OptionError:
    """The error for a file or folder that cannot be written."""
    reason = getattr(error, "strerror", None) or str(error)
    return OptionError(
        f"{path}: cannot be written: {reason}. Give a path in a folder that you may write to."
    )


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
