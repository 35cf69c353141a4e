"""Files, the catalogue, and from a name (an id, a path, a digest) to its `SMESpec` or `StreamSpec`.

A file is a document in an envelope. Its digest is of the document alone, so renaming a file or
describing it better changes nothing. The catalogue is the files under `specs/`.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast, overload

from sme_registry.errors import (
    SpecError,
    StreamError,
    UnknownNameError,
    did_you_mean,
)
from sme_registry.io import read_json
from sme_registry.spec.document import (
    NamedDocument,
    finders,
    short_repr,
)
from sme_registry.spec.files import (
    Envelope,
    EnvFile,
    Fingerprint,
    Resolved,
    StreamFile,
    SuiteFile,
    word_of,
)
from sme_registry.spec.sme_spec import SMESpec
from sme_registry.spec.stream import StreamSpec

NAMESPACE = "SME"
DYNAMICS_VERSION = 1  # of ids without another version, and of the names of random streams
SYMMETRIC = "Symmetric"
"""Ends the name in an id of the same task with actions in [−1, 1]: `SME/DefaultSymmetric-v1`."""

STREAM = "Stream"
"""May begin the name of a stream in an id: `SME/StreamSwitch5-v1` is `SME/Switch5-v1`."""

_E = TypeVar("_E", bound=Envelope)
_FILES: dict[type[NamedDocument], Any] = {SMESpec: EnvFile, StreamSpec: StreamFile}
_VERSION = re.compile(r"-v(\d+)$")


def spec_folder() -> Path:
    """Inside the installed package, or next to it in a checkout."""
    installed = Path(__file__).resolve().parents[1] / "specs"
    return installed if installed.is_dir() else installed.parents[1] / "specs"


def paths(kind: type[Envelope]) -> list[Path]:
    """The catalogue's files of one kind, in natural order (`StateDim4` before `StateDim16`)."""
    files = (spec_folder() / kind.folder).glob("*.json")
    return sorted(files, key=lambda path: [*map(_number, re.split(r"(\d+)", path.stem))])


def _number(text: str) -> int | str:
    return int(text) if text.isdigit() else text


def names(kind: type[Envelope]) -> list[str]:
    """The versioned names of one kind: `Default-v1`, …"""
    return [path.stem for path in paths(kind)]


@functools.cache
def _read(kind: type[_E], path: Path) -> _E:
    return kind.read(path)


def completion(*kinds: type[Envelope]) -> Callable[[str], list[str]]:
    """What completes a name of these kinds in a shell: ids after `SME/`, else short names."""

    def complete(incomplete: str) -> list[str]:
        known = [_VERSION.sub("", name) for kind in kinds for name in names(kind)]
        if incomplete.startswith(f"{NAMESPACE}/") and EnvFile in kinds:
            known = [f"{NAMESPACE}/{name}" for name in names(EnvFile)]
        return [name for name in dict.fromkeys(known) if name.startswith(incomplete)]

    return complete


def entries(kind: type[_E]) -> list[_E]:
    return [_read(kind, path) for path in paths(kind)]


def find(kind: type[_E], name: str | os.PathLike[str], others: Iterable[str] = ()) -> _E:
    """The file of a path, or of a name, with or without its version (then the newest)."""
    if isinstance(name, os.PathLike) or is_path(name):
        return kind.read(name)
    if newest := _newest(kind, name):
        return cast(_E, _read(kind, spec_folder() / kind.folder / f"{newest}.json"))
    if name.endswith(POLICY_SUFFIXES):
        raise UnknownNameError(
            f"{name!r}: is the file of a policy, not of a {word_of(kind)}. To evaluate it: "
            f"sme evaluate {name} TASK."
        )
    for other in Envelope.__subclasses__():
        if _newest(other, name):
            raise UnknownNameError(
                f"{name!r}: is the name of a {word_of(other)}, not of a {word_of(kind)}. "
                + _USES.get((other.content, kind.content), "See `sme show {0}`.").format(name)
            )
    known = [*names(kind), *others]
    near = did_you_mean(name, known)
    near = near or did_you_mean(name, [_VERSION.sub("", full) for full in known])
    message = f"{name!r}: no {word_of(kind)} has this name.{near} `sme list` shows the names."
    raise UnknownNameError(message)


POLICY_SUFFIXES = (".zip", ".onnx", ".npz", ".pt", ".pth")
_USES = {  # of a name of one kind where another is wanted
    ("suite", "spec"): "To train on all of its tasks: sme train --suite {0}; for one of them, give "
    "its digest from `sme show {0}`.",
    ("spec", "suite"): "To train on it alone: sme train {0}, without --suite. In a suite of your "
    "own: sme new suite.json -t {0}.",
}


def _newest(kind: type[Envelope], name: str) -> str:
    """The newest version of a name, or the version that it states; empty if there is none."""
    versions = [full for full in names(kind) if name in (full, _VERSION.sub("", full))]
    return max(versions, key=lambda full: int(full.rpartition("-v")[2]), default="")


def unique_name(document: SMESpec | StreamSpec) -> str:
    """The name of a task or a stream in the catalogue (`Default-v1`), else its name by content."""
    for file in entries(_FILES[type(document)]):
        if file.digest == document.digest:
            return cast(str, file.versioned_name)
    return document.content_name


def content_id(document: SMESpec | StreamSpec) -> str:
    """`SME/sha256-<first 12 hex of the digest>-v1`."""
    return f"{NAMESPACE}/{document.content_name}-v{DYNAMICS_VERSION}"


def title(document: SMESpec | StreamSpec) -> str:
    """What tables and figures call a task or a stream.

    `SME/Default-v1` in the catalogue; else the name of its file or registration; else `SME/` and
    its name by content. Another task's file with a catalogue name: `Default (sha256-…)`.
    """
    unique = unique_name(document)
    if unique != document.content_name or not document.name:
        return f"{NAMESPACE}/{unique}"
    known = [*names(EnvFile), *names(StreamFile)]
    released = {short for name in known for short in (name, _VERSION.sub("", name))}
    return f"{document.name} ({unique})" if document.name in released else document.name


def titles(specs: Iterable[SMESpec]) -> dict[str, str]:
    """Digest → title; different tasks of one name are told apart by their names by content."""
    tasks = {spec.digest: spec for spec in specs}
    plain = {digest: title(spec) for digest, spec in tasks.items()}
    shared = [*plain.values()]
    return {
        digest: text if shared.count(text) == 1 else f"{text} ({tasks[digest].content_name})"
        for digest, text in plain.items()
    }


def symmetric_name(versioned_name: str) -> str:
    """`Default-v1` → `DefaultSymmetric-v1`."""
    return _VERSION.sub(lambda version: SYMMETRIC + version[0], versioned_name)


def released() -> Iterator[tuple[str, str, str]]:
    """`(kind, versioned name, name by content)` of every environment, not validated."""
    for path in [*paths(EnvFile), *paths(StreamFile)]:
        file = read_json(path)
        content_name = file["digest"].replace(":", "-")[: len("sha256-") + 12]
        kind = "stream" if "stream" in file else "team" if file["spec"]["team"] else "spec"
        yield kind, path.stem, content_name


_HEX_DIGITS = 12  # fewest digits that name a document
_D = TypeVar("_D", bound=NamedDocument)

registered: dict[str, SMESpec | StreamSpec] = {}
"""What is registered in this process, by id; see `registration.register`."""


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
        return Resolved(as_document(name, kind))
    if isinstance(name, os.PathLike) or is_path(name):
        data = read_json(name)
        is_stream = kind is StreamSpec or (isinstance(data, dict) and StreamFile.content in data)
        file: Any = (StreamFile if is_stream else EnvFile).from_dict(data, str(name))
        document, fingerprints, _ = file.published
        resolved = Resolved(document.named(file.name), fingerprints, f"{name}: ")
    else:
        short = name.removeprefix("sme_registry:").removeprefix(f"{NAMESPACE}/")
        resolved = _of_name(short, kind)
    _check_kind(resolved.document, str(name), kind)
    return resolved


def _check_kind(document: SMESpec | StreamSpec, name: Any, kind: Any) -> None:
    if kind is SMESpec and isinstance(document, StreamSpec):
        raise StreamError(
            f"{short_repr(name)}: is a stream, and this needs a single task. Use that of a phase, "
            "in Python `sme_registry.load(STREAM).phases[0].spec`, for the command line saved as a "
            "file. Whole streams are for `sme train`, `sme_registry.make` and "
            "`sme_registry.evaluation.evaluate_stream`."
        )


finders[SMESpec] = lambda name: resolve(name, SMESpec).document
finders[StreamSpec] = lambda name: resolve(name, StreamSpec).document


def file_of(
    document: SMESpec | StreamSpec, fingerprints: Sequence[Fingerprint], source: str, **fields: Any
) -> EnvFile | StreamFile:
    """The file of a document with the fingerprint of each of its specs; errors name `source`."""
    kind: Any = _FILES[type(document)]
    numbers = [fingerprint.to_dict() for fingerprint in fingerprints]
    fields |= {kind.content: document.to_dict(), "digest": document.digest}
    fields |= {"fingerprint": numbers[0]} if kind is EnvFile else {"fingerprints": numbers}
    return cast("EnvFile | StreamFile", kind.from_dict(fields, source))


def as_document(value: Any, kind: Any = None) -> Any:
    """A spec or a stream from itself or from its fields; with a `kind`, no other."""
    is_stream = isinstance(value, StreamSpec) or (isinstance(value, dict) and "phases" in value)
    model: type[SMESpec | StreamSpec] = StreamSpec if is_stream or kind is StreamSpec else SMESpec
    if not isinstance(value, dict | model):
        article = "an" if model is SMESpec else "a"
        raise SpecError(
            f"{short_repr(value)}: must be {article} {model.__name__} or a mapping of its fields."
        )
    document = model.from_dict(value) if isinstance(value, dict) else value
    _check_kind(document, value, kind)
    return document


def known(kind: type[NamedDocument]) -> dict[str, Resolved[Any]]:
    """Digest → document: of the catalogue, registered here, and of the suites' instances."""
    published = {file.digest: file.published for file in entries(_FILES[kind])}
    others = [*registered.values(), *_instances()]
    return {
        document.digest: Resolved(document) for document in others if isinstance(document, kind)
    } | published


@functools.cache
def _instances() -> list[SMESpec | StreamSpec]:
    return [each for file in entries(SuiteFile) for each in file.suite.documents.values()]


def is_path(name: str) -> bool:
    return name.endswith(".json") or (os.sep in name and Path(name).is_file())


def _of_name(short: str, kind: Any) -> Resolved[Any]:
    """The document of a name; an error is about tasks, or about the kind."""
    kinds = (StreamSpec,) if kind is StreamSpec else (SMESpec, StreamSpec)
    if short.startswith(("sha256:", "sha256-")):
        return _of_digest(short, kinds)
    for env_id, document in registered.items():
        is_named = f"{NAMESPACE}/{short}" in (env_id, _VERSION.sub("", env_id))
        if is_named and isinstance(document, kinds):
            return Resolved(document)
    for one in kinds:
        name = short.removeprefix(STREAM) if one is StreamSpec else short
        if _newest(_FILES[one], name):
            return cast(Resolved[Any], find(_FILES[one], name).published)
    task = _VERSION.sub("", short).removesuffix(SYMMETRIC)
    if task != _VERSION.sub("", short):
        _of_name(task, kind)  # raises where it is unknown, too
        raise UnknownNameError(
            f"{short!r}: stands for environments of the task {task!r} with actions in [−1, 1], not "
            f"for a task. Use {task!r}, and action_range='symmetric' where actions are meant."
        )
    others = [env_id.removeprefix(f"{NAMESPACE}/") for env_id in registered] + names(StreamFile)
    return cast(Resolved[Any], find(_FILES[kinds[0]], short, others).published)  # raises


def _of_digest(name: str, kinds: tuple[type[NamedDocument], ...]) -> Resolved[Any]:
    """The only known document whose digest begins with the digits of `sha256:…`, of any version."""
    digits, _, version = name[len("sha256:") :].lower().partition("-v")
    if len(digits) < _HEX_DIGITS:
        raise UnknownNameError(f"{name!r}: give at least {_HEX_DIGITS} hex digits of the digest.")
    if version in ("", *(str(file.version) for file in entries(EnvFile))):
        for kind in kinds:
            matches = [r for d, r in known(kind).items() if d.startswith(f"sha256:{digits}")]
            if len(matches) == 1:
                return matches[0]
    raise UnknownNameError(
        f"{name!r}: no task in the catalogue or its suites has this digest, or several have. "
        "A digest cannot be turned back into a spec: load its file instead. On the tasks of a "
        "suite's file: `sme study new plan.json --suite FILE -a PPO`."
    )
