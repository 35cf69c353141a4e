"""Files and folders written completely or not at all, strict JSON, named arrays, digests and locks.

A killed process leaves the old target and at most temporary paths that `TEMPORARY` matches.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import secrets
import shutil
import stat
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

import numpy as np
import numpy.typing as npt

from sme_registry.errors import MalformedDocumentError, OptionError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    import filelock


TEMPORARY = ".*.tmp*"  # the last star: SQLite adds suffixes for its own temporary files


def temporary_beside(path: Path) -> Path:
    """A new path in the folder of `path`, which `TEMPORARY` matches."""
    return path.with_name(f".{path.name[:64]}.{secrets.token_hex(4)}.tmp")


@contextlib.contextmanager
def atomic_file(path: Path, *, new: bool = False) -> Iterator[BinaryIO]:
    """A stream whose content becomes `path` if the block succeeds; `new` never replaces a file."""
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
    """Write text as UTF-8, or bytes, completely or not at all; returns the path."""
    path = Path(path)
    with _writing(path):
        data = content.encode("utf-8") if isinstance(content, str) else content
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as stream:
            stream.write(data)
    return path


def check_new(path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Return a path that a command is about to write; call it before the work, not after."""
    path = check_writable(path)
    if os.path.lexists(path) and not force:
        raise OptionError(
            f"{path} already exists. Use --force to replace it (in Python, force=True)."
        )
    return path


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Return a path, of a file or a folder, whose parent folders can be created and written to."""
    path = Path(path)
    with _writing(path):
        # As an absolute path, so that there is an existing parent. By a file rather than
        # `os.access`, which does not see read-only file systems.
        parent = next(filter(os.path.lexists, path.absolute().parents), path)
        probe = temporary_beside(parent / path.name)
        os.close(os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        os.unlink(probe)
    return path


def claim_folder(
    folder: str | os.PathLike[str], files: Collection[str], *, force: bool = False
) -> Path:
    """Create an output folder; `force` allows an existing one with these files, and no others."""
    folder = Path(folder)
    if os.path.lexists(folder) and not folder.is_dir():
        raise OptionError(f"{folder}: is a file. Give a folder.")
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        # Hidden files may be locks, or writes of ours that were cut short.
        names = sorted(path.name for path in folder.iterdir() if path.name[0] != ".")
    others = [name for name in names if name not in files]
    if others:
        raise OptionError(
            f"{folder}: contains other files, such as {others[0]!r}. Give an empty or a new folder."
        )
    if names:
        check_new(folder, force=force)
    check_writable(folder / "run")
    return folder


@contextlib.contextmanager
def build_folder(target: str | os.PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """A temporary folder, renamed to `target` if the block succeeds; otherwise nothing changes."""
    target = check_new(target, force=force)
    building, replaced = temporary_beside(target), temporary_beside(target)
    with _writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        building.mkdir()
    try:
        yield building
        _flush(building)
        check_new(target, force=force)
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


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Raise the error of a path that cannot be written where the block cannot write it."""
    try:
        yield
    except (OSError, ValueError) as error:  # ValueError: a path with a null byte, broken text
        raise unwritable(path, error) from None


def unwritable(path: Path, error: Exception) -> OptionError:
    return OptionError(
        f"{path}: cannot be written: {reason_of(error)}. Give a path in a folder that you may "
        "write to."
    )


def reason_of(error: Exception) -> str:
    """Why the system refused: `Permission denied`."""
    return getattr(error, "strerror", None) or str(error)


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
    if os.name != "posix":
        return
    for parent, _, names in os.walk(folder):
        for name in names:
            with open(os.path.join(parent, name), "rb") as stream:
                os.fsync(stream.fileno())
        sync_folder(parent)


MAX_DOCUMENT_BYTES = 64 * 2**20


def parse_json(text: str | bytes, source: str = "document") -> Any:
    """Parse strict JSON text; error messages call it `source`, such as its path."""

    def reject_constant(name: str) -> NoReturn:
        raise MalformedDocumentError(f"{source}: {name} is not valid JSON. Use a finite number.")

    def reject_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for key, value in pairs:
            if key in mapping:
                raise MalformedDocumentError(
                    f"{source}: the key {key!r:.80} occurs twice. Remove one of them."
                )
            mapping[key] = value
        return mapping

    try:
        if isinstance(text, bytes):
            text = text.decode("utf-8")
        return json.loads(text, parse_constant=reject_constant, object_pairs_hook=reject_duplicates)
    except MalformedDocumentError:
        raise
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise MalformedDocumentError(
            f"{source}: is not JSON in UTF-8: {reason}. Correct it, or take the file again."
        ) from None


# Where a system has them: pipes are not waited for, text is not translated.
_FLAGS = os.O_RDONLY
for _name in ("O_NONBLOCK", "O_BINARY", "O_CLOEXEC"):
    _FLAGS |= getattr(os, _name, 0)
_IRREGULAR = (errno.ELOOP, errno.ENXIO)  # a link, a socket


def open_regular(path: str | os.PathLike[str], *, links: bool = False) -> io.BufferedReader:
    """Open a file for reading; a pipe, a device or a folder is an OSError, and no wait.

    So is a link, as a stranger may have prepared the folder; a user may name one (`links`).
    """
    try:
        handle = os.open(path, _FLAGS | (0 if links else getattr(os, "O_NOFOLLOW", 0)))
    except OSError as error:
        if error.errno in _IRREGULAR:
            raise OSError(errno.EINVAL, "is not a regular file") from None
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "is not a regular file")
    return os.fdopen(handle, "rb")


def read_regular(path: str | os.PathLike[str], limit: int, *, links: bool = False) -> bytes:
    """The bytes of a file as `open_regular` opens it; more than `limit` are an OSError."""
    with open_regular(path, links=links) as stream:
        large = os.fstat(stream.fileno()).st_size > limit
        data = b"" if large else stream.read(limit + 1)
    if large or len(data) > limit:
        raise OSError(errno.EFBIG, f"has more than {limit:,} bytes")
    return data


def is_regular(path: str | os.PathLike[str]) -> bool:
    """Whether the path is a regular file, and not a link to one."""
    with contextlib.suppress(OSError, ValueError):
        return stat.S_ISREG(os.lstat(path).st_mode)
    return False


def read_json(path: str | os.PathLike[str]) -> Any:
    try:
        text = read_regular(path, MAX_DOCUMENT_BYTES, links=True)
    except (OSError, ValueError) as error:
        raise MalformedDocumentError(
            f"{os.fspath(path)}: cannot be read: {reason_of(error)}."
        ) from None
    return parse_json(text, os.fspath(path))


def to_json(value: Any) -> str:
    """Plain data as indented JSON text with a final newline. Raises ValueError for NaN."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


Arrays = dict[str, npt.NDArray[Any]]


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays of numbers or text, and remove what killed writes left of the file."""
    path = Path(path)
    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        for rest in path.parent.glob(TEMPORARY):
            if rest.name.startswith(f".{path.name}."):
                rest.unlink(missing_ok=True)
        with atomic_file(path) as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]


def read_arrays(path: str | os.PathLike[str], names: Collection[str] | None = None) -> Arrays:
    """The arrays of a file; with `names`, only these are read."""
    try:
        # Opened here: NumPy leaves a file open that is no archive.
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {name: archive[name] for name in (archive.files if names is None else names)}
    except Exception as error:  # of many kinds, by what is damaged
        raise OptionError(
            f"{os.fspath(path)}: cannot be read: {type(error).__name__}: {error}. Remove it."
        ) from error


def sha256_of(data: bytes) -> str:
    """The SHA-256 digest of bytes: `sha256:` and 64 lower-case hex digits."""
    return "sha256:" + hashlib.sha256(data).hexdigest()


_POLL_SECONDS = 0.002


class Lock:
    """A lock that this process holds until it releases or drops this object."""

    def __init__(self, lock: filelock.BaseFileLock) -> None:
        self._lock = lock

    def release(self) -> None:
        self._lock.release()

    def __enter__(self) -> Lock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def file_lock(path: str | os.PathLike[str], *, timeout: float = 0.0) -> Lock | None:
    """The lock of a file; None if another holder keeps it for `timeout` seconds (−1: forever)."""
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
        raise OptionError(
            f"{path}: cannot be locked: {reason_of(error)}. Give a folder that you may write to, "
            "on a file system that supports locks."
        ) from None
    return Lock(lock)


def is_locked(path: str | os.PathLike[str]) -> bool:
    """Whether a lock file is held, by this process or another one. Creates no file."""
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
