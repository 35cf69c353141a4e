"""`resolve`: whatever names a task (an id, a path, a digest, a spec) to its `SMESpec`."""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import Any

from sme_registry.errors import MalformedDocumentError, UnknownNameError
from sme_registry.io import read_json
from sme_registry.spec import catalogue
from sme_registry.spec.envelope import EnvFile, SuiteFile
from sme_registry.spec.sme_spec import SMESpec, as_spec

# Specs that this process registered under ids of its own; `registration.register` fills it.
registered: dict[str, SMESpec] = {}


def resolve(task: SMESpec | dict[str, Any] | str | os.PathLike[str]) -> SMESpec:
    """The spec that is meant.

    Args:
      task: a spec; its fields as a mapping; an id (`SME/Default-v1`, `Default-v1`, `Default`);
        a name by content (`SME/sha256-<12 hex>-v1`); a digest (`sha256:<64 hex>`, or any prefix
        that only one known spec has, of 12 digits or more); or the path of a file.

    Returns:
      The spec. One read from a file carries that file's fingerprint, which `materialize` checks.

    Raises:
      UnknownNameError: nothing has this name; says what is near.
      SpecError: a file or mapping is not a valid spec.
    """
    if not isinstance(task, str | os.PathLike):
        return as_spec(task)
    name = str(task)
    if (
        isinstance(task, os.PathLike)
        or name.endswith(".json")
        or (os.sep in name and Path(name).is_file())
    ):
        return with_fingerprint(read_env_file(name))
    short = name.removeprefix("sme_registry:").removeprefix(f"{catalogue.NAMESPACE}/")
    full = f"{catalogue.NAMESPACE}/{short}"
    for env_id in registered:
        if full in (env_id, env_id.rsplit("-v", 1)[0]):
            return registered[env_id]
    if short.startswith(("sha256:", "sha256-")):
        return _by_content(short)
    own = [env_id.removeprefix(f"{catalogue.NAMESPACE}/") for env_id in registered]
    return with_fingerprint(catalogue.find(EnvFile, short, own))


def read_env_file(path: str | os.PathLike[str]) -> EnvFile:
    """Read a task's file; a bare spec without an envelope is refused with the way out.

    Raises:
      MalformedDocumentError: not readable, not strict JSON, or a bare spec.
      SpecError, DigestMismatchError: see `EnvFile.open`.
    """
    data = read_json(path)
    refuse_bare_spec(data, str(path))
    return EnvFile.open(data, str(path))


def refuse_bare_spec(data: Any, source: str) -> None:
    """Raise where plain data is a spec alone, such as `SMESpec.model_dump_json` writes.

    Raises:
      MalformedDocumentError: says how to get its file.
    """
    if isinstance(data, dict) and data and data.keys() <= SMESpec.model_fields.keys():
        raise MalformedDocumentError(
            f"{source}: is a bare spec, without the digest and fingerprint of a task's file. "
            "In Python, `sme_registry.save(SMESpec(**fields), path)` writes that."
        )


def with_fingerprint(file: EnvFile) -> SMESpec:
    """A file's spec, carrying its fingerprint."""
    spec = file.spec.model_copy()
    spec._fingerprint = file.fingerprint
    return spec


def known_specs() -> dict[str, SMESpec]:
    """Digest → spec of everything named: registered here, catalogue, then suites' instances."""
    known: dict[str, SMESpec] = {}
    for file in catalogue.entries(EnvFile):
        known.setdefault(file.digest, with_fingerprint(file))
    for spec in registered.values():
        known.setdefault(spec.digest, spec)
    for suite in catalogue.entries(SuiteFile):
        for spec in suite.suite.instances:
            known.setdefault(spec.digest, spec)
    return known


def _by_content(name: str) -> SMESpec:
    digits, _, version = name[len("sha256:") :].lower().partition("-v")
    versions = {str(file.version) for file in catalogue.entries(EnvFile)}
    if version and version not in versions:
        raise UnknownNameError(
            f"{name!r}: no task has version {version} of the dynamics. "
            f"Known: {', '.join(sorted(versions))}."
        )
    known = known_specs()
    found = [spec for digest, spec in known.items() if digest[len("sha256:") :].startswith(digits)]
    if len(found) == 1 and len(digits) >= 12:
        return found[0]
    if len(digits) < 12:
        raise UnknownNameError(f"{name!r}: give at least 12 hex digits of the digest.")
    prefixes = [digest[len("sha256:") :][: len(digits)] for digest in known]
    near = difflib.get_close_matches(digits, prefixes, n=1, cutoff=0.8)
    hint = f" Did you mean 'sha256:{near[0]}'?" if near else ""
    raise UnknownNameError(
        f"{name!r}: no task in the catalogue or its suites has this digest.{hint} "
        "A digest cannot be turned back into a spec: load its file instead."
    )
