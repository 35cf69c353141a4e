"""`Suite`: a list of classes; a class is one setting with its instances (seeds).

So a method is evaluated on a kind of task, not on one draw of it. A class of streams is one stream
with its draws.
"""

from __future__ import annotations

import os
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, field_validator, model_validator

from sme_registry.errors import SpecError, UnknownNameError
from sme_registry.spec.document import (
    Document,
    Integer,
    Name,
    SchemaVersion,
    refuse_repeated_names,
    short_repr,
)
from sme_registry.spec.sme_spec import Seed, Setting, SMESpec
from sme_registry.spec.stream import StreamSpec


class SuiteClass(Document):
    """One kind of task: a setting of the axes and the seeds of its instances.

    Attributes:
      name: of the class, unique in its suite.
      setting: every field of its tasks except the seed.
      seeds: of its instances, each once.
    """

    name: Name
    setting: Setting
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1, max_length=10_000, strict=False)]

    @model_validator(mode="after")
    def _seeds_differ(self) -> Self:
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(
                f"seeds={short_repr(list(self.seeds))}: must be distinct. Remove repeats."
            )
        return self

    @property
    def instances(self) -> tuple[SMESpec, ...]:
        """The specs of this class, in the order of its seeds."""
        fields = self.setting.to_dict()
        return tuple(SMESpec.from_dict({**fields, "seed": seed}) for seed in self.seeds)


class StreamClass(Document):
    """One kind of stream, and its instances.

    Attributes:
      name: of the class.
      stream: the stream. A name, id, digest or path of one is read as what it stands for.
      draws: the numbers of its instances; see `StreamSpec.draw`.
    """

    name: Name
    stream: StreamSpec
    draws: Annotated[
        tuple[Annotated[Integer, Field(ge=0, lt=2**32)], ...],
        Field(min_length=1, max_length=10_000, strict=False),
    ] = (0,)

    @field_validator("stream", mode="before")
    @classmethod
    def _name_to_stream(cls, value: Any) -> Any:
        if not isinstance(value, str | os.PathLike):
            return value
        from sme_registry.spec.resolve import resolve

        try:
            return resolve(value, StreamSpec).document.named("")
        except (UnknownNameError, SpecError) as error:
            raise ValueError(str(error)) from None

    @model_validator(mode="after")
    def _draws_differ(self) -> Self:
        if len(set(self.draws)) != len(self.draws):
            raise ValueError(
                f"draws={short_repr(list(self.draws))}: must be distinct. Remove repeats."
            )
        return self

    @property
    def instances(self) -> tuple[StreamSpec, ...]:
        """The streams of this class, in the order of its draws."""
        return tuple(self.stream.draw(number) for number in self.draws)


Classes = Annotated[tuple[SuiteClass, ...], Field(max_length=1000, strict=False)]
StreamClasses = Annotated[tuple[StreamClass, ...], Field(max_length=1000, strict=False)]


class Suite(Document):
    """Classes of tasks, of streams, or of both, under different names.

    Attributes:
      classes: kinds of tasks; at least one, unless there are streams.
      streams: kinds of streams.

    Examples:
      >>> from sme_registry.spec import Setting, Suite, SuiteClass
      >>> easy = SuiteClass(name="easy", setting=Setting(), seeds=[1, 2, 3])
      >>> deep = SuiteClass(name="deep", setting=Setting(complexity=20), seeds=[1, 2, 3])
      >>> len(Suite(classes=[easy, deep]).instances)
      6
    """

    fields_added_later: ClassVar[tuple[str, ...]] = ("streams",)

    schema_version: SchemaVersion = 1
    classes: Classes = ()
    streams: StreamClasses = ()

    @model_validator(mode="after")
    def _can_be_told_apart(self) -> Self:
        refuse_no_class(self.classes, self.streams)
        return self

    @property
    def instances(self) -> tuple[SMESpec, ...]:
        """Every spec of the suite, class by class; its streams are not among them."""
        return tuple(spec for member in self.classes for spec in member.instances)

    @property
    def stream_instances(self) -> tuple[StreamSpec, ...]:
        """Every stream of the suite, class by class."""
        return tuple(stream for member in self.streams for stream in member.instances)

    @property
    def runs(self) -> dict[str, int]:
        """Class → number of its instances, of tasks and of streams."""
        tasks = {member.name: len(member.seeds) for member in self.classes}
        return tasks | {member.name: len(member.draws) for member in self.streams}

    def refuse_streams(self, what: str) -> None:
        """Raise SpecError if the suite has streams."""
        if self.streams:
            names = ", ".join(member.name for member in self.streams)
            raise SpecError(
                f"suite: has streams ({names}), and {what} needs single tasks. Choose a suite "
                "without streams; studies run lives in streams: `sme study new --suite`."
            )


def refuse_no_class(classes: tuple[SuiteClass, ...], streams: tuple[StreamClass, ...]) -> None:
    """Raise ValueError, which Pydantic reports, without a class, or where names are equal."""
    if not classes and not streams:
        raise ValueError(
            "classes: must have at least 1 entry, unless there are streams. Add a class, or a "
            "stream."
        )
    refuse_repeated_names("classes", classes)
    refuse_repeated_names("streams", (*classes, *streams))
