"""Strict JSON: UTF-8, no NaN or infinity, no duplicate keys."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, NoReturn

from sme_registry.errors import MalformedDocumentError

MAX_DOCUMENT_BYTES = 64 * 2**20


def parse_json(text: str | bytes, source: str = "document") -> Any:
    """Parse strict JSON text; error messages call it `source`, such as its path.

    Raises:
      MalformedDocumentError: it is not strict JSON; with line and column if they are known.
    """

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
        raise MalformedDocumentError(f"{source}: {_reason(error)}") from None


def _reason(error: ValueError | RecursionError) -> str:
    if isinstance(error, UnicodeDecodeError):
        return f"not UTF-8 text (byte {error.start}). Save it as UTF-8 JSON."
    if isinstance(error, json.JSONDecodeError):
        if error.doc.startswith("\ufeff"):
            return "starts with a byte order mark (BOM). Save it as UTF-8 without BOM."
        return f"not JSON: {error.msg} at line {error.lineno}, column {error.colno}."
    if isinstance(error, RecursionError):
        return "nested too deeply. Valid documents have at most ten levels."
    return f"cannot be parsed: {error}."  # an integer of thousands of digits


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a strict JSON file.

    Raises:
      MalformedDocumentError: the file does not exist or cannot be read, is too large, or is not
        strict JSON.
    """
    path = Path(path)
    try:
        if path.is_file() and path.stat().st_size > MAX_DOCUMENT_BYTES:
            raise MalformedDocumentError(
                f"{path}: larger than {MAX_DOCUMENT_BYTES // 2**20} MiB, the limit for documents."
            )
        text = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise MalformedDocumentError(f"{path}: cannot be read: {reason}.") from None
    return parse_json(text, str(path))


def to_json(value: Any) -> str:
    """Plain data as indented JSON text with a final newline. Raises ValueError for NaN."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
