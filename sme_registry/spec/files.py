"""The files of the catalogue: a document, and what its release promises of it."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Generic, NamedTuple, Self, TypeVar

from pydantic import Field, model_validator

from sme_registry.errors import MalformedDocumentError, SpecError
from sme_registry.spec.document import (
    Digest,
    Integer,
    Name,
    NamedDocument,
    StoredModel,
    StrictModel,
    check_digest,
)
from sme_registry.spec.sme_spec import SMESpec
from sme_registry.spec.stream import StreamSpec
from sme_registry.spec.study import StudyPlan
from sme_registry.spec.suite import EvaluationProtocol, Suite

_D = TypeVar("_D", bound=NamedDocument)
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


class Envelope(StoredModel):
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
    def document(self) -> Any:
        """What it holds: a spec, a stream, a suite, a plan or a protocol."""
        return getattr(self, self.content)

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
        remedy = f"Take the file again from its source, or {remedy}."
        check_digest(envelope.digest, envelope.document, f"{name}: digest", remedy)
        return envelope


class Resolved(NamedTuple, Generic[_D]):
    """A spec or a stream, and what its file publishes about the numbers drawn from it."""

    document: _D
    fingerprints: tuple[Fingerprint, ...] = ()  # of each phase's spec; none where there is no file
    source: str = ""  # of the file of a path, as errors begin


class EnvFile(Envelope):
    """A task's file: one of the package, or what `sme_registry.save` writes.

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
    """A stream's file: one of the package, or what `sme_registry.save` writes.

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
    """A suite's file, such as `sme new --task` writes.

    Attributes:
      suite: the suite.
    """

    content = "suite"
    folder = "suites"

    suite: Suite


class StudyFile(Envelope):
    """A study's file, such as `sme study new` writes.

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
    """A protocol's file.

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
            f"{source}: is a report, or the record of a run, on the {word_of(kind)} "
            f"{data[f'{kind.content}_digest']!r:.90}. Give the file or the name of the "
            f"{word_of(kind)} itself."
        )
    drawn = {"digest", "fingerprint", "fingerprints"} & kind.model_fields.keys()
    if (is_bare or kind.content in data) and (missing := drawn - data.keys()):
        name = min(missing)
        raise MalformedDocumentError(
            f"{source}: {'is a bare ' + kind.content + ': ' if is_bare else ''}{name}: missing: "
            f"must be the {name} of the {kind.content}. To add it, {remedy}."
        )
    others = [other for other in Envelope.__subclasses__() if other.content in data]
    if others and kind.content not in data:
        raise SpecError(
            f"{source}: is the file of a {word_of(others[0])}, not of a {word_of(kind)}."
        )


def word_of(kind: type[Envelope]) -> str:
    """What people call a kind."""
    return {"spec": "task", "plan": "study plan"}.get(kind.content, kind.content)
