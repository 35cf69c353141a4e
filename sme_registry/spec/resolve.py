"""From the name of a task or stream (an id, a path, a digest) to its `SMESpec` or `StreamSpec`."""

from __future__ import annotations

import difflib
import functools
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from sme_registry.errors import MalformedDocumentError, SpecError, StreamError, UnknownNameError
from sme_registry.io import read_json
from sme_registry.spec import catalogue
from sme_registry.spec.document import short_repr
from sme_registry.spec.envelope import EnvFile, Fingerprint, StreamFile, SuiteFile
from sme_registry.spec.sme_spec import SMESpec, SpecLike, as_spec
from sme_registry.spec.stream import StreamLike, StreamSpec, as_stream

_HEX_DIGITS = 12  # fewest digits that name a spec

# Specs registered in this process, by id; see `registration.register`.
registered: dict[str, SMESpec] = {}
registered_streams: dict[str, StreamSpec] = {}

_T = TypeVar("_T")


@dataclass(frozen=True)
class ResolvedSpec:
    """A spec, and what its file publishes about the numbers drawn from it.

    Attributes:
      spec: the spec.
      fingerprint: of its file, to pass to `materialize`; None where the spec has no file.
    """

    spec: SMESpec
    fingerprint: Fingerprint | None = None

    def derive(self, **overrides: Any) -> ResolvedSpec:
        """The derived spec; it has no published numbers, unless nothing is overridden."""
        return ResolvedSpec(self.spec.derive(**overrides)) if overrides else self


@dataclass(frozen=True)
class ResolvedStream:
    """A stream, and what its file publishes about the numbers of its phases.

    Attributes:
      stream: the stream.
      fingerprints: of each phase's spec; empty where the stream has no file.
    """

    stream: StreamSpec
    fingerprints: tuple[Fingerprint, ...] = ()


def resolve(task: SpecLike) -> ResolvedSpec:
    """The spec of a name; a stream's is a `StreamError`. Draws nothing.

    A name is a spec or its fields; an id (`SME/Default-v1`, `Default`); a name by content; a digest
    or a prefix of 12 digits or more that only one known spec has; or the path of a file.
    """
    try:
        return _resolve(task)
    except (UnknownNameError, SpecError):
        if not names_stream(task):
            raise
    label = short_repr(str(task) if isinstance(task, str | os.PathLike) else task)
    raise StreamError(
        f"{label}: is a stream, and this needs a single task. Use that of one phase, in Python "
        "`sme_registry.load(STREAM).phases[0].spec`; for the command line, save it as a file, "
        "`sme_registry.save(spec, 'phase0.json')`. On the whole stream, `sme train` trains an "
        "agent, `sme_registry.evaluation.evaluate_stream` evaluates its policies, and "
        "`sme_registry.make` makes an environment."
    )


def _resolve(task: SpecLike) -> ResolvedSpec:
    if not isinstance(task, str | os.PathLike):
        return ResolvedSpec(as_spec(task))
    name = str(task)
    if isinstance(task, os.PathLike) or is_path(name):
        return _of_env_data(read_json(name), name)
    short = _short(name)
    own = _registered(short, registered)
    if own is not None:
        return ResolvedSpec(own)
    if short.startswith(("sha256:", "sha256-")):
        return _by_content(short, known_specs())
    refuse_symmetric_name(short)
    registered_names = [env_id.removeprefix(f"{catalogue.NAMESPACE}/") for env_id in registered]
    others = [*registered_names, *catalogue.names(StreamFile)]
    return _of_file(catalogue.find(EnvFile, short, others))


def resolve_stream(stream: StreamLike) -> ResolvedStream:
    """The stream of a name, as `resolve` finds the spec of one."""
    if not isinstance(stream, str | os.PathLike):
        return ResolvedStream(as_stream(stream))
    name = str(stream)
    if isinstance(stream, os.PathLike) or is_path(name):
        return _of_stream_data(read_json(name), name)
    short = _short(name)
    own = _registered(short, registered_streams)
    if own is not None:
        return ResolvedStream(own)
    if short.startswith(("sha256:", "sha256-")):
        return _by_content(short, known_streams())
    refuse_symmetric_name(short)
    return _of_stream_file(catalogue.find(StreamFile, short.removeprefix(catalogue.STREAM)))


def resolve_document(name: SpecLike | StreamLike) -> ResolvedSpec | ResolvedStream:
    """The stream of a name, or the spec; see `resolve_stream` and `resolve`. Reads a file once."""
    if isinstance(name, os.PathLike) or (isinstance(name, str) and is_path(name)):
        data, source = read_json(name), str(name)
        of_data = _of_stream_data if _has_stream(data) else _of_env_data
        return of_data(data, source)
    if names_stream(name):
        return resolve_stream(cast("StreamLike", name))
    return resolve(cast("SpecLike", name))


def names_stream(value: Any) -> bool:
    """Whether a value is a stream, or the name, path or content of one, rather than of a task."""
    if not isinstance(value, str | os.PathLike):
        return isinstance(value, StreamSpec) or (isinstance(value, dict) and "phases" in value)
    name = str(value)
    if isinstance(value, os.PathLike) or is_path(name):
        return _has_stream(read_json(name))
    short = _short(name)
    if _registered(short, registered_streams) is not None:
        return True
    if short.startswith(("sha256:", "sha256-")):
        digits = short[len("sha256:") :].partition("-v")[0].lower()
        return len(digits) >= _HEX_DIGITS and any(
            digest.removeprefix("sha256:").startswith(digits) for digest in known_streams()
        )
    short = re.sub(r"-v\d+$", "", short).removesuffix(catalogue.SYMMETRIC)
    streams = {re.sub(r"-v\d+$", "", known) for known in catalogue.names(StreamFile)}
    return short in streams or short.removeprefix(catalogue.STREAM) in streams


def _short(name: str) -> str:
    """An id without the module and the namespace before it."""
    return name.removeprefix("sme_registry:").removeprefix(f"{catalogue.NAMESPACE}/")


def _registered(short: str, known: Mapping[str, _T]) -> _T | None:
    """What is registered in this process under an id, with or without its version."""
    full = f"{catalogue.NAMESPACE}/{short}"
    for env_id, document in known.items():
        if full in (env_id, env_id.rsplit("-v", 1)[0]):
            return document
    return None


def refuse_symmetric_name(name: str) -> None:
    """Raise UnknownNameError on the name of a symmetric id, such as `DefaultSymmetric`."""
    short = re.sub(r"-v\d+$", "", name)
    if short.endswith(catalogue.SYMMETRIC):
        task = short.removesuffix(catalogue.SYMMETRIC)
        if not names_stream(task):
            resolve(task)  # raises where this is unknown, too
        raise UnknownNameError(
            f"{name!r}: stands for environments of the task {task!r} with actions in [−1, 1], not "
            f"for a task. Use {task!r}, and action_range='symmetric' where actions are meant."
        )


def _of_file(file: EnvFile) -> ResolvedSpec:
    return ResolvedSpec(file.spec, file.fingerprint)


def is_path(name: str) -> bool:
    """Whether text is the path of a file rather than a name."""
    return name.endswith(".json") or (os.sep in name and Path(name).is_file())


def _has_stream(data: Any) -> bool:
    return isinstance(data, dict) and StreamFile.content in data


def _of_stream_data(data: Any, source: str) -> ResolvedStream:
    file = StreamFile.from_dict(data, source)
    return ResolvedStream(file.stream.named(file.name), file.fingerprints)


def _of_env_data(data: Any, source: str) -> ResolvedSpec:
    refuse_bare_spec(data, source)
    file = EnvFile.from_dict(data, source)
    return ResolvedSpec(file.spec.named(file.name), file.fingerprint)


def refuse_bare_spec(data: Any, source: str) -> None:
    """Raise MalformedDocumentError on a spec alone, such as `SMESpec.model_dump_json` writes."""
    if isinstance(data, dict) and data and data.keys() <= SMESpec.model_fields.keys():
        raise MalformedDocumentError(
            f"{source}: is a bare spec, without the digest and fingerprint of a task's file. "
            "To write the file, in Python: `sme_registry.save(SMESpec(**fields), path)`."
        )


def known_specs() -> dict[str, ResolvedSpec]:
    """Digest → spec: of the catalogue, of specs registered here, and of suites' instances."""
    known: dict[str, ResolvedSpec] = {}
    for file in catalogue.entries(EnvFile):
        known.setdefault(file.digest, _of_file(file))
    for spec in registered.values():
        known.setdefault(spec.digest, ResolvedSpec(spec))
    for suite in catalogue.entries(SuiteFile):
        for spec in suite.suite.instances:
            known.setdefault(spec.digest, ResolvedSpec(spec))
    return known


def known_streams() -> dict[str, ResolvedStream]:
    """Digest → stream: of the catalogue, of streams registered here, and of suites' instances."""
    known = {file.digest: _of_stream_file(file) for file in catalogue.entries(StreamFile)}
    for stream in registered_streams.values():
        known.setdefault(stream.digest, ResolvedStream(stream))
    return _draws_of_suites() | known


@functools.cache
def _draws_of_suites() -> dict[str, ResolvedStream]:
    suites = catalogue.entries(SuiteFile)
    streams = [stream for file in suites for stream in file.suite.stream_instances]
    return {stream.digest: ResolvedStream(stream) for stream in streams}


def _of_stream_file(file: StreamFile) -> ResolvedStream:
    return ResolvedStream(file.stream, file.fingerprints)


def _by_content(name: str, documents: Mapping[str, _T]) -> _T:
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
    known = {digest.removeprefix("sha256:"): each for digest, each in documents.items()}
    matches = [spec for digest, spec in known.items() if digest.startswith(digits)]
    if len(matches) == 1:
        return matches[0]
    prefixes = [digest[: len(digits)] for digest in known]
    near = difflib.get_close_matches(digits, prefixes, n=1, cutoff=0.8)
    hint = f" Did you mean 'sha256:{near[0]}'?" if near else ""
    raise UnknownNameError(
        f"{name!r}: no task in the catalogue or its suites has this digest.{hint} "
        "A digest cannot be turned back into a spec: load its file instead. On the tasks of a "
        "suite's file: `sme study new plan.json --suite FILE -a PPO`."
    )
