"""Strict JSON: UTF-8, no NaN or infinity, no duplicate keys."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, NoReturn

from sme_registry.errors import MalformedDocumentError

MAX_DOCUMENT_BYTES = 64 * 2**20


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


def to_json(value: Any) -> str:
    """Readable JSON text (two spaces, final newline) of plain data; refuses NaN."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
