"""From what a user types to a document: a name, a path, or a digest of any kind."""

from __future__ import annotations

import os
from typing import Any

from sme_registry.errors import (
    MalformedDocumentError,
    OptionError,
    SMEError,
    UnknownNameError,
    did_you_mean,
)
from sme_registry.io import parse_json, read_json
from sme_registry.spec import EnvFile, ProtocolFile, SMESpec, StudyFile, SuiteFile, catalogue
from sme_registry.spec.envelope import Envelope
from sme_registry.spec.resolve import is_path, refuse_bare_spec, resolve

# The first of a name is what is meant by it: `smoke` is a suite, and the study of that name is what
# `sme study` takes.
KINDS: dict[str, type[Envelope]] = {
    "env": EnvFile,
    "suite": SuiteFile,
    "protocol": ProtocolFile,
    "study": StudyFile,
}


def read_any(path: str | os.PathLike[str]) -> Envelope:
    """Read a file of any kind; its kind is the document that it carries.

    Raises:
      MalformedDocumentError: not strict JSON, or no file of ours.
      SpecError, DigestMismatchError: see `Envelope.from_dict`.
    """
    data = read_json(path)
    for kind in KINDS.values():
        if isinstance(data, dict) and kind.content in data:
            return kind.from_dict(data, os.fspath(path))
    refuse_bare_spec(data, os.fspath(path))
    contents = ", ".join(repr(kind.content) for kind in KINDS.values())
    raise MalformedDocumentError(f"{os.fspath(path)}: must be an object with one of {contents}.")


def find_any(name: str) -> Envelope | SMESpec:
    """The file of a name, path or digest; a spec alone where it has no file of its own.

    Raises:
      UnknownNameError: no environment, suite, protocol or study has this name or digest.
    """
    if is_path(name):
        return read_any(name)
    every = [(kind, file) for kind in KINDS.values() for file in catalogue.entries(kind)]
    for _, file in every:
        if name in (file.name, file.versioned_name, file.digest):
            return file
    try:
        spec = resolve(name).spec
    except UnknownNameError as error:
        short = name.rsplit("/", 1)[-1]
        hint = did_you_mean(short, [file.name for _, file in every])
        if hint and "Did you mean" not in str(error):
            raise UnknownNameError(
                f"{name!r}: nothing in the catalogue has this name.{hint}"
            ) from None
        raise
    files = [file for kind, file in every if kind is EnvFile and file.digest == spec.digest]
    return files[0] if len(files) == 1 else spec


def overrides(pairs: list[str]) -> dict[str, Any]:
    """`field=value` pairs as spec fields; a value is read as JSON where it is JSON.

    Raises:
      OptionError: a pair has no `=`, or a field is given twice.
    """
    fields: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not equals or not name:
            raise OptionError(f"--set {pair!r}: must be field=value, as in --set complexity=10.")
        if name in fields:
            raise OptionError(f"--set {pair!r}: {name} is set twice. Remove one.")
        fields[name] = json_or_text(text.strip())
    return fields


def json_or_text(text: str) -> Any:
    """A value as JSON (`10`, `0.5`, `{"agents": …}`), else as the text it is (`0x1f`)."""
    try:
        return parse_json(text)
    except SMEError:
        return text
