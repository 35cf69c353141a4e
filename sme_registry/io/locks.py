"""Locks between processes, on Linux, macOS and Windows.

The operating system holds the lock and releases it when the process ends, even if it is killed.
The lock file itself stays in place and has no content.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from sme_registry.errors import OptionError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    import filelock

_POLL_SECONDS = 0.002


class Lock:
    """A lock that this process holds until it releases or drops this object.

    As a context manager it is released at the end of the block.
    """

    def __init__(self, lock: filelock.BaseFileLock) -> None:
        self._lock = lock

    def release(self) -> None:
        """Release the lock. Releasing twice does nothing."""
        self._lock.release()

    def __enter__(self) -> Lock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def file_lock(path: str | os.PathLike[str], *, timeout: float = 0.0) -> Lock | None:
    """Acquire the exclusive lock of a file, which is created with its folder if it is missing.

    Args:
      path: the lock file.
      timeout: seconds to wait for another holder; 0 tries once, a negative number waits forever.

    Returns:
      The lock, or None if another process, or another lock of this one, still holds it.

    Raises:
      OptionError: the file cannot be created, or its file system has no locks.
    """
    import filelock  # on first use: most programs take no lock

    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # No fallback to a lock that consists of the file's existence: it would survive a kill.
        lock = filelock.FileLock(path, thread_local=False, fallback_to_soft=False)
        lock.acquire(timeout=timeout, poll_interval=_POLL_SECONDS)
    except filelock.Timeout:
        return None
    except (OSError, ValueError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise OptionError(
            f"{path}: cannot be locked: {reason}. Give a folder that you may write to, on a file "
            "system that supports locks."
        ) from None
    return Lock(lock)


def is_locked(path: str | os.PathLike[str]) -> bool:
    """Whether a lock file is held, by this process or another one. Creates no file.

    Where the system has `flock`, reading the file suffices, and asking does not hold up others.
    """
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    try:
        # Waiting a moment keeps two simultaneous questions from answering each other's with yes.
        lock = file_lock(path, timeout=5 * _POLL_SECONDS)
    except OptionError:
        return False
    if lock is None:
        return True
    lock.release()
    return False
