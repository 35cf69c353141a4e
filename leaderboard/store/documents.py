"""Documents in files: written in one form, read back only if they still are what was logged."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TypeVar

from leaderboard.documents.board import Folder, hex_of
from leaderboard.errors import TamperedError
from leaderboard.store.files import write
from sme_registry.errors import SMEError
from sme_registry.io import parse_json, to_json
from sme_registry.spec import StrictModel

_Model = TypeVar("_Model", bound=StrictModel)


def to_bytes(document: StrictModel) -> bytes:
    """A document's file."""
    return to_json(document.to_dict()).encode()


def digest_of(document: StrictModel) -> str:
    """`sha256:` and 64 hex digits: of the document's file, as `sha256sum` would say."""
    return "sha256:" + hashlib.sha256(to_bytes(document)).hexdigest()


def write_document(path: Path, document: StrictModel, *, new: bool = False) -> None:
    """Write a document's file whole or not at all; see `files.atomic_file`."""
    write(path, to_bytes(document), new=new)


def read_document(
    folder: Folder, path: Path, kind: type[_Model], digest: str | None = None
) -> _Model:
    """A document of a board.

    Args:
      folder: the board's, to say where.
      path: the file.
      kind: what it must be.
      digest: of the file, as the log says; None where it says nothing.

    Raises:
      TamperedError: the file is missing, is no such document, is another one than was logged, or
        is not in the form in which the board writes it.
    """
    where = path.relative_to(folder.path).as_posix()
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TamperedError(where, f"cannot be read: {error.strerror}") from None
    if digest is not None and hashlib.sha256(data).hexdigest() != hex_of(digest):
        raise TamperedError(where, f"is not the document that the log names, {digest[:19]}…")
    try:
        document = kind.from_dict(parse_json(data, where), where)
    except SMEError as error:
        raise TamperedError(where, f"is not what the board wrote: {error}") from None
    if digest is None and to_bytes(document) != data:
        raise TamperedError(where, "is not in the form in which the board writes it")
    return document
