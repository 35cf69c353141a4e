"""Files: strict JSON, atomic writes, imports by name."""

from sme_registry.io.files import TEMPORARY, atomic_file, temporary_beside, write_atomically
from sme_registry.io.imports import import_object
from sme_registry.io.json_files import MAX_DOCUMENT_BYTES, parse_json, read_json, to_json

__all__ = [
    "MAX_DOCUMENT_BYTES",
    "TEMPORARY",
    "atomic_file",
    "import_object",
    "parse_json",
    "read_json",
    "temporary_beside",
    "to_json",
    "write_atomically",
]
