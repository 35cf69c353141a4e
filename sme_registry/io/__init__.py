"""Files, locks, digests, strict JSON, arrays, servers, spare memory, packages, argument checks."""

from sme_registry.io.arrays import Arrays, read_arrays, write_arrays
from sme_registry.io.checks import choice, integer_in, number_in
from sme_registry.io.digests import sha256_of
from sme_registry.io.files import (
    TEMPORARY,
    atomic_file,
    build_folder,
    claim_folder,
    refuse_existing,
    refuse_unwritable,
    sync_folder,
    temporary_beside,
    write_atomically,
)
from sme_registry.io.json_files import MAX_DOCUMENT_BYTES, parse_json, read_json, to_json
from sme_registry.io.locks import Lock, file_lock, is_locked
from sme_registry.io.memory import available_memory
from sme_registry.io.packages import (
    import_object,
    install_command,
    is_installed,
    missing_dependency,
    require_packages,
    versions,
)
from sme_registry.io.servers import Address, printable, server_address

__all__ = [
    "MAX_DOCUMENT_BYTES",
    "TEMPORARY",
    "Address",
    "Arrays",
    "Lock",
    "atomic_file",
    "available_memory",
    "build_folder",
    "choice",
    "claim_folder",
    "file_lock",
    "import_object",
    "install_command",
    "integer_in",
    "is_installed",
    "is_locked",
    "missing_dependency",
    "number_in",
    "parse_json",
    "printable",
    "read_arrays",
    "read_json",
    "refuse_existing",
    "refuse_unwritable",
    "require_packages",
    "server_address",
    "sha256_of",
    "sync_folder",
    "temporary_beside",
    "to_json",
    "versions",
    "write_arrays",
    "write_atomically",
]
