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
from typing import Annotated, Any, ClassVar, Generic, NamedTuple, Self, TypeVar, cast, overload

from pydantic import Field, model_validator

from sme_registry.errors import (
    DigestMismatchError,
    MalformedDocumentError,
    SpecError,
    StreamError,
    UnknownNameError,
    did_you_mean,
)
from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.spec.document import (
    Digest,
    Integer,
    Name,
    NamedDocument,
    StrictModel,
    finders,
    short_repr,
)
from sme_registry.spec.sme_spec import SMESpec
from sme_registry.spec.stream import StreamSpec
from sme_registry.spec.study import StudyPlan
from sme_registry.spec.suite import EvaluationProtocol, Suite

_ROW = Annotated[tuple[float, ...], Field(strict=False)]
_ROWS = Annotated[tuple[_ROW, ...], Field(strict=False, min_length=1, max_length=64)]


class Fingerprint(StrictModel):
    """A drawn task's numbers at fixed probes.

    Attributes:
      optimal_action: `[P, A]` π*(s).
      next_state: `[P, S]` T(s, a).
      limit: `[P, A]` ℓ(s); None, and left out of the JSON, without `safety`.
      next_distractors: `[P, m]` T_d(d, a); None, likewise, where they have no transition.
      seen: `[P, S + m]` M(s, d); None, likewise, without a mixing.
      potential: `[P, 1]` P_0(s); None, likewise, without `shaping`.
    """

    fields_added_later = ("limit", "next_distractors", "seen", "potential")

    optimal_action: _ROWS
    next_state: _ROWS
    limit: _ROWS | None = None
    next_distractors: _ROWS | None = None
    seen: _ROWS | None = None
    potential: _ROWS | None = None


class Envelope(StrictModel):
    """The fields of every file next to its document.

    Attributes:
      name: a short name, as in ids.
      version: of the dynamics. A released name and version never change their numbers.
      description: one or two sentences.
      tags: short words, to find it by.
      digest: of the document alone; a file with another one is refused.
    """

    # The field that holds the document, and the folder of the kind in the catalogue.
    content: ClassVar[str]
    folder: ClassVar[str]
    # How to write a changed or a bare document as a file, `{source}`.
    remedy: ClassVar[str] = (
        "write the changed {content} as a new file, in Python `sme_registry.spec.{kind}"
        "(name=…, digest={content}.digest, {content}={content}).write(path)`"
    )

    name: Name
    version: Annotated[Integer, Field(ge=1, le=10**6)] = 1
    description: Annotated[str, Field(max_length=2000)] = ""
    tags: Annotated[tuple[Name, ...], Field(strict=False, max_length=64)] = ()
    digest: Digest

    @property
    def versioned_name(self) -> str:
        """`Default-v1`: the name in files and ids."""
        return f"{self.name}-v{self.version}"

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """Validate plain data; another digest than the document's is a `DigestMismatchError`."""
        name = source or cls.__name__
        remedy = cls.remedy.format(source=name, kind=cls.__name__, content=cls.content)
        if isinstance(data, dict) and data:
            _check_is_file(cls, data, name, remedy)
        envelope = super().from_dict(data, source)
        expected = getattr(envelope, cls.content).digest
        if envelope.digest != expected:
            raise DigestMismatchError(
                f"{name}: digest={envelope.digest!r}: its {cls.content} has {expected!r}. The "
                f"{cls.content} or the digest was changed after the file was written: take the "
                f"file again from its source, or {remedy}."
            )
        return envelope

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read and validate a file."""
        return cls.from_dict(read_json(path), str(path))

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file completely or not at all."""
        write_atomically(path, to_json(self.to_dict()))


class EnvFile(Envelope):
    """A task's file: `specs/envs/*.json`, or what `sme_registry.save` writes.

    Attributes:
      spec: the task.
      fingerprint: its numbers at fixed probes, compared when the file is read.
    """

    content = "spec"
    folder = "envs"
    remedy = "save the changed spec as a new file, in Python `sme_registry.save(spec, path)`"

    spec: SMESpec
    fingerprint: Fingerprint

    @property
    def published(self) -> Resolved[SMESpec]:
        """The task, with its fingerprint."""
        return Resolved(self.spec, (self.fingerprint,))


class StreamFile(Envelope):
    """A stream's file: `specs/streams/*.json`, or what `sme_registry.save` writes.

    Attributes:
      stream: the stream.
      fingerprints: of each phase's spec, in order.
    """

    content = "stream"
    folder = "streams"
    remedy = "save the changed stream as a new file, in Python `sme_registry.save(stream, path)`"

    stream: StreamSpec
    fingerprints: Annotated[tuple[Fingerprint, ...], Field(strict=False, max_length=1000)]

    @model_validator(mode="after")
    def _every_phase_has_one(self) -> Self:
        if len(self.fingerprints) != len(self.stream.phases):
            raise ValueError(
                f"fingerprints: has {len(self.fingerprints)} of them: must be one for each of the "
                f"{len(self.stream.phases)} phases. Take the file again from its source."
            )
        return self

    @property
    def published(self) -> Resolved[StreamSpec]:
        """The stream, with the fingerprint of each phase."""
        return Resolved(self.stream, self.fingerprints)


class SuiteFile(Envelope):
    """A suite's file: `specs/suites/*.json`.

    Attributes:
      suite: the suite.
    """

    content = "suite"
    folder = "suites"

    suite: Suite


class StudyFile(Envelope):
    """A study's file: `specs/studies/*.json`.

    Attributes:
      plan: the study plan.
    """

    content = "plan"
    folder = "studies"
    remedy = "write the changed plan as a new file: `sme study new NEW.json --from {source}`"

    plan: StudyPlan

    @classmethod
    def with_digest(cls, data: Any, source: str, **fields: Any) -> Self:
        """The file of an edited or bare plan, with the plan's present digest."""
        is_file = isinstance(data, dict) and cls.content in data
        plan = StudyPlan.from_dict(data[cls.content] if is_file else data, source)
        fields = {**(data if is_file else {}), **fields}
        return cls.from_dict({**fields, "digest": plan.digest, "plan": plan.to_dict()}, source)


class ProtocolFile(Envelope):
    """A protocol's file: `specs/protocols/*.json`.

    Attributes:
      protocol: the protocol.
    """

    content = "protocol"
    folder = "protocols"

    protocol: EvaluationProtocol


def _check_is_file(kind: type[Envelope], data: dict[str, Any], source: str, remedy: str) -> None:
    """Say that data is a bare document, or the file of another kind, not which fields it lacks."""
    document: Any = kind.model_fields[kind.content].annotation
    is_bare = data.keys() <= document.model_fields.keys()
    if f"{kind.content}_digest" in data:
        raise MalformedDocumentError(
            f"{source}: is a report, or the record of a run, on the {_word(kind)} "
            f"{data[f'{kind.content}_digest']!r:.90}. Give the file or the name of the "
            f"{_word(kind)} itself."
        )
    if "digest" not in data and (is_bare or kind.content in data):
        raise MalformedDocumentError(
            f"{source}: {'is a bare ' + kind.content + ': ' if is_bare else ''}digest: missing: "
            f"must be the digest of the {kind.content}. To add it, {remedy}."
        )
    others = [other for other in Envelope.__subclasses__() if other.content in data]
    if others and kind.content not in data:
        raise SpecError(f"{source}: is the file of a {_word(others[0])}, not of a {_word(kind)}.")


def _word(kind: type[Envelope]) -> str:
    """What people call a kind."""
    return {"spec": "task", "plan": "study plan"}.get(kind.content, kind.content)


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


def find(kind: type[_E], name: str, others: Iterable[str] = ()) -> _E:
    """The file of a name, with or without its version (then the newest)."""
    if newest := _newest(kind, name):
        return cast(_E, _read(kind, spec_folder() / kind.folder / f"{newest}.json"))
    if Path(name).suffix in POLICY_SUFFIXES:
        raise UnknownNameError(
            f"{name!r}: is the file of a policy, not of a {_word(kind)}. To evaluate it: "
            f"sme evaluate {name} TASK."
        )
    for other in Envelope.__subclasses__():
        if _newest(other, name):
            raise UnknownNameError(
                f"{name!r}: is the name of a {_word(other)}, not of a {_word(kind)}. "
                + _USES.get((other.content, kind.content), "See `sme show {0}`.").format(name)
            )
    known = [*names(kind), *others]
    near = did_you_mean(name, known)
    near = near or did_you_mean(name, [_VERSION.sub("", full) for full in known])
    message = f"{name!r}: no {_word(kind)} has this name.{near} `sme list` shows the names."
    raise UnknownNameError(message)


POLICY_SUFFIXES = (".zip", ".onnx", ".npz", ".pt", ".pth")
_USES = {  # of a name of one kind where another is wanted
    (
        "suite",
        "spec",
    ): "To train on all of its tasks: sme train --suite {0}; for one of them, give "
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


class Resolved(NamedTuple, Generic[_D]):
    """A spec or a stream, and what its file publishes about the numbers drawn from it."""

    document: _D
    fingerprints: tuple[Fingerprint, ...] = ()  # of each phase's spec; none where there is no file


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
        document, fingerprints = file.published
        resolved = Resolved(document.named(file.name), fingerprints)
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
    return [document for file in entries(SuiteFile) for document in file.suite.documents]


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
