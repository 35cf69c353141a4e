"""Reading strict JSON, importing what a file names, and writes that are whole or absent.

Every file this package writes goes through `whole`, most by `write_atomically`: into a temporary
file beside the target, then renamed over it. A killed process leaves the old file, never half a new
one, and at most a temporary file that `TEMPORARY` matches.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import secrets
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from sme_registry.errors import MalformedDocumentError, OptionError, SMEError, did_you_mean

MAX_DOCUMENT_BYTES = 64 * 2**20
TEMPORARY = ".*.tmp*"  # the star at the end: SQLite's own files beside one of ours


def parse_json(text: str | bytes, source: str = "document") -> Any:
    """Parse strict JSON: UTF-8, no NaN or infinity, no key given twice.

    Args:
      text: the JSON text.
      source: what to call it in an error, such as its path.

    Returns:
      The parsed value.

    Raises:
      MalformedDocumentError: with line and column where there is one.
    """

    def refuse_constant(name: str) -> NoReturn:
        raise MalformedDocumentError(f"{source}: {name} is not JSON. Use a finite number.")

    def refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        seen: dict[str, Any] = {}
        for key, value in pairs:
            if key in seen:
                raise MalformedDocumentError(
                    f"{source}: the key {key!r} is given twice. Keep one of them."
                )
            seen[key] = value
        return seen

    try:
        if isinstance(text, bytes):
            text = text.decode("utf-8")
        return json.loads(text, parse_constant=refuse_constant, object_pairs_hook=refuse_duplicates)
    except UnicodeDecodeError as error:
        raise MalformedDocumentError(
            f"{source}: not UTF-8 text (byte {error.start}). Save it as UTF-8 JSON."
        ) from None
    except json.JSONDecodeError as error:
        raise MalformedDocumentError(
            f"{source}: not JSON: {error.msg} at line {error.lineno}, column {error.colno}."
        ) from None
    except RecursionError:
        raise MalformedDocumentError(
            f"{source}: nested too deeply. No document of ours is nested more than ten deep."
        ) from None
    except MalformedDocumentError:
        raise
    except ValueError as error:  # an integer of thousands of digits
        raise MalformedDocumentError(f"{source}: not JSON that can be read: {error}.") from None


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a strict JSON file.

    Raises:
      MalformedDocumentError: the file is missing, unreadable, too large, or not strict JSON.
    """
    path = Path(path)
    try:
        if path.is_file() and path.stat().st_size > MAX_DOCUMENT_BYTES:
            raise MalformedDocumentError(
                f"{path}: larger than {MAX_DOCUMENT_BYTES // 2**20} MiB; no document of ours is."
            )
        text = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise MalformedDocumentError(f"{path}: cannot be read: {reason}.") from None
    return parse_json(text, str(path))


def imported(name: str, field: str, error: type[SMEError]) -> Any:
    """What `module:function` names; the module is looked for in this folder, too.

    Args:
      name: `module:function`. Importing a module runs it.
      field: what the name was given for, which a message begins with.
      error: the kind of error to raise.

    Raises:
      SMEError: of that kind: the module or its function is not there, or fails when it is imported.
    """
    module_name, _, attribute = name.partition(":")
    folder, near = os.getcwd(), ""
    sys.path.insert(0, folder)
    try:
        module = importlib.import_module(module_name)
        near = did_you_mean(attribute, dir(module))
        return getattr(module, attribute)
    except SMEError:
        raise
    except Exception as reason:
        raise error(
            f"{field}={name!r}: cannot be imported: {type(reason).__name__}: {reason}.{near} It "
            "must be module:function, the module in this folder or installed."
        ) from reason
    finally:
        sys.path.remove(folder)


def temporary_beside(path: Path) -> Path:
    """A new name beside `path`, in its file system, that `TEMPORARY` matches."""
    return path.with_name(f".{path.name[:64]}.{secrets.token_hex(4)}.tmp")


@contextlib.contextmanager
def whole(path: Path, *, new: bool = False) -> Iterator[BinaryIO]:
    """A stream whose bytes become `path` when the block ends well, and nothing otherwise.

    Args:
      path: the target, in a folder that is there.
      new: link instead of rename, so that an existing file is never replaced.

    Raises:
      OSError: the disk is full, the folder cannot be written to, or (`new`) the name is taken;
        what stood there is untouched.
    """
    temporary = temporary_beside(path)
    try:
        # Not mkstemp, whose 0600 would hide results from colleagues; the umask is the user's.
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
    """Write a file whole or not at all; the folder is made where it is missing.

    Args:
      path: the target; an existing file is replaced.
      content: text (written as UTF-8) or bytes.

    Returns:
      The path written.

    Raises:
      OptionError: the folder cannot be made or written to; what stood there is untouched.
    """
    path = Path(path)
    try:
        data = content.encode("utf-8") if isinstance(content, str) else content
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as stream:
            stream.write(data)
    except (OSError, ValueError) as error:  # ValueError: a path with a null byte, broken text
        reason = getattr(error, "strerror", None) or str(error)
        raise OptionError(
            f"{path}: cannot be written: {reason}. Give a path in a folder that you may write to."
        ) from None
    return path


def to_json(value: Any) -> str:
    """Readable JSON text (two spaces, final newline) of plain data; refuses NaN."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
