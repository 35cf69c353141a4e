"""`FolderLock`: one writer or many readers of a board at a time, across processes.

The lock is `flock` on the log's folder, which is never replaced. It needs no file of its own, so a
board can be read from a folder that is read-only, and the kernel frees it when its holder dies.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from leaderboard.errors import BoardError

try:
    import fcntl
except ImportError:  # Windows, where boards can be read but not written
    fcntl = None  # type: ignore[assignment]

BUSY_SECONDS = 60.0


class FolderLock:
    """A lock on a folder."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open = True
        self._handle = None if fcntl is None else os.open(path, os.O_RDONLY | os.O_DIRECTORY)

    def close(self) -> None:
        """Release the lock's handle; closing twice does nothing."""
        if self._open and self._handle is not None:
            os.close(self._handle)
        self._open = False

    @contextlib.contextmanager
    def hold(self, *, exclusive: bool) -> Iterator[None]:
        """Hold the lock for the block; a shared one admits other shared holders.

        Raises:
          BoardError: the lock is closed, another process holds it for a minute, or (exclusive)
            this system has no `flock`.
        """
        if not self._open:
            raise BoardError(f"{self._path.parent}: the store is closed. Open it again.")
        if self._handle is None:
            if exclusive:
                raise BoardError(
                    f"{self._path.parent}: a board can only be written on Linux and macOS. "
                    "Open it read-only here."
                )
            yield  # no process of this system can write
            return
        kind = fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH
        deadline = time.monotonic() + BUSY_SECONDS
        while True:
            try:
                fcntl.flock(self._handle, kind | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise BoardError(
                        f"{self._path.parent}: another process has locked the board for "
                        f"{BUSY_SECONDS:.0f} s. Find the process that hangs, then try again."
                    ) from None
                time.sleep(0.002)
        try:
            yield
        finally:
            fcntl.flock(self._handle, fcntl.LOCK_UN)
