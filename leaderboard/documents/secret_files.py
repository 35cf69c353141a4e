"""Files that hold a secret of 32 bytes as 64 hex digits: readable by their owner only."""

from __future__ import annotations

import os
from pathlib import Path

from leaderboard.errors import BoardError


def write_secret(path: str | os.PathLike[str], secret: bytes) -> Path:
    """Write a secret into a new file that only its owner can read.

    Raises:
      BoardError: the file exists (an overwritten secret is lost) or cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise BoardError(f"{path} already exists and is not replaced. Give another path.") from None
    except OSError as error:
        raise BoardError(f"{path}: cannot be written: {error.strerror}.") from None
    with os.fdopen(handle, "w") as stream:
        stream.write(secret.hex() + "\n")
        stream.flush()
        os.fsync(stream.fileno())
    return path


def parse_secret(data: bytes) -> bytes:
    """The bytes in the contents of such a file.

    Raises:
      ValueError: they are not hex digits.
    """
    return bytes.fromhex(data.decode("ascii").strip())
