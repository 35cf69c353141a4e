"""From the name of a task or stream (an id, a path, a digest) to its `SMESpec` or `StreamSpec`."""

from __future__ import annotations

import difflib
import functools
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

from sme_registry.errors import MalformedDocumentError, StreamError, UnknownNameError
from sme_registry.io import read_json
from sme_registry.spec import catalogue
from sme_registry.spec.catalogue import EnvFile, Fingerprint, StreamFile, SuiteFile
from sme_registry.spec.document import NamedDocument, finders, short_repr
from sme_registry.spec.sme_spec import SMESpec, as_spec
from sme_registry.spec.stream import StreamSpec, as_stream

_HEX_DIGITS = 12  # fewest digits that name a document
_VERSION = re.compile(r"-v\d+$")

registered: dict[str, SMESpec | StreamSpec] = {}
"""What is registered in this process, by id; see `registration.register`."""

_D = TypeVar("_D", bound=NamedDocument)


@dataclass(frozen=True)
class Resolved(Generic[_D]):
    """A spec or a stream, and what its file publishes about the numbers drawn from it.

    Attributes:
      document: the spec or stream.
      fingerprints: of the spec, or of each phase's spec; empty where there is no file.
    """

    document: _D
    fingerprints: tuple[Fingerprint, ...] = ()


@overload
def resolve(name: Any, kind: type[_D]) -> Resolved[_D]: ...
@overload
def resolve(name: Any, kind: None = None) -> Resolved[SMESpec | StreamSpec]: ...
def resolve(name: Any, kind: Any = None) -> Any:
    """What a name stands for; with a `kind`, `SMESpec` or `StreamSpec`, no other. Draws nothing.

    A name is a document or its fields; an id (`SME/Default-v1`, `Default`, `StreamSwitch5`); a name
    by content; a digest or a prefix of 12 digits or more that only one known document has; or the
    path of a file. A stream in place of a spec is a `StreamError`.
    """
    if not isinstance(name, str | os.PathLike):
        resolved = Resolved(as_document(name, kind))
    elif isinstance(name, os.PathLike) or is_path(name):
        resolved = _of_data(read_json(name), str(name), kind)
    else:
        resolved = _of_name(_short(name), kind)
    if kind is SMESpec and isinstance(resolved.document, StreamSpec):
        raise StreamError(
            f"{short_repr(str(name) if isinstance(name, os.PathLike) else name)}: is a stream, and "
            "this needs a single task. Use that of one phase, in Python "
            "`sme_registry.load(STREAM).phases[0].spec`; for the command line, save it as a file, "
            "`sme_registry.save(spec, 'phase0.json')`. On the whole stream, `sme train` trains an "
            "agent, `sme_registry.evaluation.evaluate_stream` evaluates its policies, and "
            "`sme_registry.make` makes an environment."
        )
    return resolved


def names_stream(value: Any) -> bool:
    """Whether a value is a stream, or the name, path or content of one, rather than of a task."""
    if not isinstance(value, str | os.PathLike):
        return isinstance(value, StreamSpec) or (isinstance(value, dict) and "phases" in value)
    if isinstance(value, os.PathLike) or is_path(value):
        return _has_stream(read_json(value))
    try:
        return isinstance(_of_name(_short(value)).document, StreamSpec)
    except UnknownNameError:
        return False


def known(kind: type[NamedDocument]) -> dict[str, Resolved[Any]]:
    """Digest → document: of the catalogue, registered here, and of the suites' instances."""
    documents = {file.digest: _of_file(file) for file in catalogue.entries(_FILES[kind])}
    for document in registered.values():
        if isinstance(document, kind):
            documents.setdefault(document.digest, Resolved(document))
    return _instances(kind) | documents


def is_path(name: str) -> bool:
    """Whether text is the path of a file rather than a name."""
    return name.endswith(".json") or (os.sep in name and Path(name).is_file())


def check_not_bare(data: Any, source: str) -> None:
    """Raise MalformedDocumentError on a spec alone, such as `SMESpec.model_dump_json` writes."""
    if isinstance(data, dict) and data and data.keys() <= SMESpec.model_fields.keys():
        raise MalformedDocumentError(
            f"{source}: is a bare spec, without the digest and fingerprint of a task's file. "
            "To write the file, in Python: `sme_registry.save(SMESpec(**fields), path)`."
        )


def check_not_symmetric(name: str) -> None:
    """Raise UnknownNameError on `DefaultSymmetric`, which presents the task of another name."""
    short = _VERSION.sub("", name)
    if short.endswith(catalogue.SYMMETRIC):
        task = short.removesuffix(catalogue.SYMMETRIC)
        _of_name(_short(task))  # raises where this is unknown, too
        raise UnknownNameError(
            f"{name!r}: stands for environments of the task {task!r} with actions in [−1, 1], not "
            f"for a task. Use {task!r}, and action_range='symmetric' where actions are meant."
        )


_FILES: dict[type[NamedDocument], Any] = {SMESpec: EnvFile, StreamSpec: StreamFile}
finders[SMESpec] = lambda name: resolve(name, SMESpec).document
finders[StreamSpec] = lambda name: resolve(name, StreamSpec).document


def as_document(value: Any, kind: Any = None) -> SMESpec | StreamSpec:
    """A spec or a stream from itself or from plain data."""
    return as_stream(value) if kind is StreamSpec or names_stream(value) else as_spec(value)


def _of_data(data: Any, source: str, kind: Any) -> Resolved[Any]:
    if kind is not StreamSpec and not _has_stream(data):
        check_not_bare(data, source)
        file: EnvFile | StreamFile = EnvFile.from_dict(data, source)
    else:
        file = StreamFile.from_dict(data, source)
    resolved = _of_file(file)
    return Resolved(resolved.document.named(file.name), resolved.fingerprints)


def _has_stream(data: Any) -> bool:
    return isinstance(data, dict) and StreamFile.content in data


def _of_file(file: EnvFile | StreamFile) -> Resolved[Any]:
    if isinstance(file, StreamFile):
        return Resolved(file.stream, file.fingerprints)
    return Resolved(file.spec, (file.fingerprint,))


def _of_name(short: str, kind: Any = None) -> Resolved[Any]:
    """The document of a name; where both kinds know none, the message about specs."""
    try:
        return _of_name_of(short, kind or SMESpec)
    except UnknownNameError:
        if kind is StreamSpec:
            raise
        try:
            return _of_name_of(short, StreamSpec)
        except UnknownNameError:
            pass
        raise


def _of_name_of(short: str, kind: type[NamedDocument]) -> Resolved[Any]:
    full = f"{catalogue.NAMESPACE}/{short}"
    for env_id, document in registered.items():
        if isinstance(document, kind) and full in (env_id, _VERSION.sub("", env_id)):
            return Resolved(document)
    if short.startswith(("sha256:", "sha256-")):
        return _by_content(short, known(kind))
    check_not_symmetric(short)
    if kind is StreamSpec:
        return _of_file(catalogue.find(StreamFile, short.removeprefix(catalogue.STREAM)))
    return _of_file(catalogue.find(EnvFile, short, _other_names()))


def _other_names() -> Iterator[str]:
    """What an unknown name may have meant besides the catalogue's tasks."""
    yield from (env_id.removeprefix(f"{catalogue.NAMESPACE}/") for env_id in registered)
    yield from catalogue.names(StreamFile)


def _short(name: str) -> str:
    """An id without the module and the namespace before it."""
    return name.removeprefix("sme_registry:").removeprefix(f"{catalogue.NAMESPACE}/")


@functools.cache
def _instances(kind: type[NamedDocument]) -> dict[str, Resolved[Any]]:
    """Of the catalogue's suites, by digest."""
    suites = [file.suite for file in catalogue.entries(SuiteFile)]
    documents = (
        document
        for suite in suites
        for document in (suite.instances if kind is SMESpec else suite.stream_instances)
    )
    return {document.digest: Resolved(document) for document in documents}


def _by_content(name: str, documents: dict[str, Resolved[Any]]) -> Resolved[Any]:
    """The only known document whose digest begins with the digits of `sha256:…`, of any version."""
    digits, _, version = name[len("sha256:") :].lower().partition("-v")
    versions = {str(file.version) for file in catalogue.entries(EnvFile)}
    if version and version not in versions:
        raise UnknownNameError(
            f"{name!r}: no task has version {version} of the dynamics. "
            f"Known: {', '.join(sorted(versions))}."
        )
    if len(digits) < _HEX_DIGITS:
        raise UnknownNameError(f"{name!r}: give at least {_HEX_DIGITS} hex digits of the digest.")
    by_digits = {digest.removeprefix("sha256:"): each for digest, each in documents.items()}
    matches = [each for digest, each in by_digits.items() if digest.startswith(digits)]
    if len(matches) == 1:
        return matches[0]
    prefixes = [digest[: len(digits)] for digest in by_digits]
    near = difflib.get_close_matches(digits, prefixes, n=1, cutoff=0.8)
    hint = f" Did you mean 'sha256:{near[0]}'?" if near else ""
    raise UnknownNameError(
        f"{name!r}: no task in the catalogue or its suites has this digest.{hint} "
        "A digest cannot be turned back into a spec: load its file instead. On the tasks of a "
        "suite's file: `sme study new plan.json --suite FILE -a PPO`."
    )
