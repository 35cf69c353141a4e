"""Reading files of a board's folder, which a stranger may have prepared.

A pipe or a device hangs its reader, a link leads elsewhere, and a sparse file of a terabyte takes
no space on the disk: only regular files are read, and only up to the size of what they may contain.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import stat
from pathlib import Path

# Where a system has them: links are not followed, pipes not waited for, text not translated.
_FLAGS = os.O_RDONLY
for _name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY", "O_CLOEXEC"):
    _FLAGS |= getattr(os, _name, 0)


def open_regular(path: Path) -> io.BufferedReader:
    """Open a regular file for reading.

    Raises:
      OSError: it does not exist, cannot be read, or is a link, a pipe, a device or a folder.
    """
    try:
        handle = os.open(path, _FLAGS)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):  # a link, a socket
            raise OSError(errno.EINVAL, "is not a regular file") from None
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "is not a regular file")
    return os.fdopen(handle, "rb")


def read_regular(path: Path, limit: int) -> bytes:
    """Read a regular file of at most `limit` bytes.

    Raises:
      OSError: as `open_regular`, or it is larger.
    """
    with open_regular(path) as stream:
        large = os.fstat(stream.fileno()).st_size > limit
        data = b"" if large else stream.read(limit + 1)
    if large or len(data) > limit:
        raise OSError(errno.EFBIG, f"has more than {limit:,} bytes")
    return data


def is_regular(path: Path) -> bool:
    """Whether the path is a regular file, and not a link to one."""
    with contextlib.suppress(OSError, ValueError):
        return stat.S_ISREG(os.lstat(path).st_mode)
    return False
