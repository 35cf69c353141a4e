"""What has a card: every environment and every stream of the catalogue."""

from __future__ import annotations

from sme_registry.spec import EnvFile, SMESpec, StreamFile, StreamSpec, catalogue

Entry = EnvFile | StreamFile


def entries() -> dict[str, Entry]:
    """Their files by versioned name, environments first."""
    files: list[Entry] = [*catalogue.entries(EnvFile), *catalogue.entries(StreamFile)]
    return {file.versioned_name: file for file in files}


def document(file: Entry) -> SMESpec | StreamSpec:
    """The task or the stream of a file."""
    return file.spec if isinstance(file, EnvFile) else file.stream
