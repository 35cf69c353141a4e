"""Files, and the catalogue: the files under `specs/`, by name, with no other list of them.

A file is a document in an envelope of name, version, description, tags and digest. The digest is of
the document alone, so renaming a file or describing it better changes nothing; a file with another
digest is refused.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar, cast

from pydantic import Field, model_validator

from sme_registry.errors import DigestMismatchError, SpecError, UnknownNameError, did_you_mean
from sme_registry.io import read_json, to_json, write_atomically
from sme_registry.spec.document import Digest, Integer, Name, StrictModel
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
    """

    fields_added_later = ("limit", "next_distractors", "seen")

    optimal_action: _ROWS
    next_state: _ROWS
    limit: _ROWS | None = None
    next_distractors: _ROWS | None = None
    seen: _ROWS | None = None


class Envelope(StrictModel):
    """The fields of every file next to its document.

    Attributes:
      name: a short name, as in ids.
      version: of the dynamics. A released name and version never change their numbers.
      description: one or two sentences.
      tags: short words, to find it by.
      digest: of the document alone; a file with another one is refused.
    """

    # The field that holds the document.
    content: ClassVar[str]
    # How to write a changed document, or a bare one, as a file; `{source}` is its path.
    remedy: ClassVar[str] = (
        "write the changed {content} as a new file, in Python "
        "`sme_registry.spec.{kind}(name=…, digest={content}.digest, {content}={content})"
        ".write(path)`"
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
        document: Any = cls.model_fields[cls.content].annotation
        if isinstance(data, dict) and data and "digest" not in data:
            is_bare_document = data.keys() <= document.model_fields.keys()
            if is_bare_document or cls.content in data:
                raise SpecError(
                    f"{name}: digest: missing: must be the digest of the {cls.content}. To add "
                    f"it, {remedy}."
                )
        _check_kind(cls, data, name)
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
    remedy = "save the changed spec as a new file, in Python `sme_registry.save(spec, path)`"

    spec: SMESpec
    fingerprint: Fingerprint


class StreamFile(Envelope):
    """A stream's file: `specs/streams/*.json`, or what `sme_registry.save` writes.

    Attributes:
      stream: the stream.
      fingerprints: of each phase's spec, in order.
    """

    content = "stream"
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


class SuiteFile(Envelope):
    """A suite's file: `specs/suites/*.json`.

    Attributes:
      suite: the suite.
    """

    content = "suite"

    suite: Suite


class StudyFile(Envelope):
    """A study's file: `specs/studies/*.json`.

    Attributes:
      plan: the study plan.
    """

    content = "plan"
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

    protocol: EvaluationProtocol


def _check_kind(kind: type[Envelope], data: Any, source: str) -> None:
    """Say that a file is a suite, say, and not a task, rather than which fields it lacks."""
    words = {"spec": "task", "plan": "study plan"}
    if isinstance(data, dict) and kind.content not in data:
        for other in Envelope.__subclasses__():
            if other.content in data:
                actual, expected = (words.get(each.content, each.content) for each in (other, kind))
                raise SpecError(f"{source}: is the file of a {actual}, not of a {expected}.")


NAMESPACE = "SME"
SYMMETRIC = "Symmetric"
"""Ends the name in an id of the same task with actions in [−1, 1]: `SME/DefaultSymmetric-v1`."""

STREAM = "Stream"
"""May begin the name of a stream in an id: `SME/StreamSwitch5-v1` is `SME/Switch5-v1`."""

_E = TypeVar("_E", bound=Envelope)
_FOLDERS: dict[type[Envelope], str] = {
    EnvFile: "envs",
    StreamFile: "streams",
    SuiteFile: "suites",
    ProtocolFile: "protocols",
    StudyFile: "studies",
}
_VERSION = re.compile(r"-v(\d+)$")


def spec_folder() -> Path:
    """The folder of the catalogue: inside the installed package, or next to it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "specs"
    return installed if installed.is_dir() else package.parent / "specs"


def paths(kind: type[Envelope]) -> list[Path]:
    """The catalogue's files of one kind, in natural order (`StateDim4` before `StateDim16`)."""

    def natural(path: Path) -> list[Any]:
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.stem)]

    return sorted((spec_folder() / _FOLDERS[kind]).glob("*.json"), key=natural)


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
    """Every file of one kind, read and checked."""
    return [_read(kind, path) for path in paths(kind)]


def find(kind: type[_E], name: str, others: Iterable[str] = ()) -> _E:
    """The file of a name, with or without its version (then the newest)."""
    known = names(kind)
    if name in known:
        return cast(_E, _read(kind, spec_folder() / _FOLDERS[kind] / f"{name}.json"))
    versions = [
        (int(match[1]), full)
        for full in known
        if (match := _VERSION.search(full)) and full[: match.start()] == name
    ]
    if versions:
        return find(kind, max(versions)[1])
    known += others
    short = [_VERSION.sub("", full) for full in known]
    raise UnknownNameError(
        f"{name!r}: no {kind.content} has this name."
        + (did_you_mean(name, known) or did_you_mean(name, short))
        + " `sme list` shows the names."
    )


def unique_name(document: SMESpec | StreamSpec) -> str:
    """The name of a task or a stream in the catalogue (`Default-v1`), else its name by content."""
    kind = StreamFile if isinstance(document, StreamSpec) else EnvFile
    released = {file.digest: file.versioned_name for file in entries(kind)}
    return released.get(document.digest, document.content_name)


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
