"""`Suite`, a list of classes, and `EvaluationProtocol`, the states to evaluate a policy in.

A class is one setting with its instances (seeds), so a method is evaluated on a kind of task, not
on one draw of it. Protocols: METHOD, section 3.
"""

from __future__ import annotations

import itertools
import os
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

from pydantic import BeforeValidator, Field, model_validator

from sme_registry.errors import SpecError
from sme_registry.spec.blocks import Seed
from sme_registry.spec.document import (
    Document,
    Integer,
    Name,
    Real,
    SchemaVersion,
    check_names,
    find_named,
    short_repr,
)
from sme_registry.spec.sme_spec import Setting, SMESpec
from sme_registry.spec.stream import StreamSpec


class _Class(Document):
    """A kind of task or stream, whose instances are told apart by a number.

    Attributes:
      name: of the class, unique in its suite.
    """

    kind: ClassVar[str]  # of the numbers, which are the field of that name and an s

    name: Name

    @property
    def numbers(self) -> tuple[int | str, ...]:
        """The seeds or draws, each once."""
        return tuple(getattr(self, f"{self.kind}s"))

    @model_validator(mode="after")
    def _numbers_differ(self) -> Self:
        if len(set(self.numbers)) != len(self.numbers):
            given = short_repr(list(self.numbers))
            raise ValueError(f"{self.kind}s={given}: must be distinct. Remove repeats.")
        return self


class SuiteClass(_Class):
    """One kind of task: a setting of the axes and the seeds of its instances.

    Attributes:
      setting: every field of its tasks except the seed.
      seeds: of its instances, each once.
    """

    kind = "seed"

    setting: Setting
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1, max_length=10_000, strict=False)]

    @property
    def instances(self) -> tuple[SMESpec, ...]:
        """The specs of this class, in the order of its seeds."""
        fields = self.setting.to_dict()
        return tuple(SMESpec.from_dict({**fields, "seed": seed}) for seed in self.seeds)


class StreamClass(_Class):
    """One kind of stream, and its instances.

    Attributes:
      stream: the stream. A name, id, digest or path of one is read as what it stands for.
      draws: the numbers of its instances; see `StreamSpec.draw`.
    """

    kind = "draw"

    stream: Annotated[StreamSpec, BeforeValidator(partial(find_named, StreamSpec))]
    draws: Annotated[
        tuple[Annotated[Integer, Field(ge=0, lt=2**32)], ...],
        Field(min_length=1, max_length=10_000, strict=False),
    ] = (0,)

    @property
    def instances(self) -> tuple[StreamSpec, ...]:
        """The streams of this class, in the order of its draws."""
        return tuple(self.stream.draw(number) for number in self.draws)


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
    classes: Annotated[tuple[SuiteClass, ...], Field(max_length=1000, strict=False)] = ()
    streams: Annotated[tuple[StreamClass, ...], Field(max_length=1000, strict=False)] = ()

    @model_validator(mode="after")
    def _can_be_told_apart(self) -> Self:
        if not self.members:
            raise ValueError(
                "classes: must have at least 1 entry, unless there are streams. Add a class, or a "
                "stream."
            )
        check_names("classes", self.classes)
        check_names("streams", self.members)
        return self

    @property
    def members(self) -> tuple[SuiteClass | StreamClass, ...]:
        """The classes of tasks, and then those of streams."""
        return (*self.classes, *self.streams)

    @property
    def instances(self) -> tuple[SMESpec, ...]:
        """Every spec of the suite, class by class; its streams are not among them."""
        return tuple(spec for member in self.classes for spec in member.instances)

    @property
    def documents(self) -> dict[tuple[str, str, int | str], SMESpec | StreamSpec]:
        """Every spec, and then every stream, by its class, "seed" or "draw", and which."""
        documents: dict[tuple[str, str, int | str], SMESpec | StreamSpec] = {}
        for member in self.members:
            places = [(member.name, member.kind, number) for number in member.numbers]
            documents.update(zip(places, member.instances, strict=True))
        return documents

    @property
    def runs(self) -> dict[str, int]:
        """Class → number of its instances, of tasks and of streams."""
        return {member.name: len(member.numbers) for member in self.members}

    def check_no_streams(self, what: str) -> None:
        """Raise SpecError if the suite has streams."""
        if self.streams:
            names = ", ".join(member.name for member in self.streams)
            raise SpecError(
                f"suite: has streams ({names}), and {what} needs single tasks. Choose a suite "
                "without streams; studies run lives in streams: `sme study new --suite`."
            )


class EvaluationProtocol(Document):
    """How many states, in which regions, with which auxiliary inputs, from which seed.

    Attributes:
      states_per_region: states drawn in the cube, and in each shell around it.
      epsilons: outer ε of each shell, increasing: shell m is between the cubes ε_{m−1} and ε_m.
      sampling: how states are drawn: uniformly by volume in each region.
      time_input: the entry t/T of an observation: uniform over the steps of an episode.
      accumulated_reward_input: the entry r_cum/k of an observation: 0.
      seed: of the states and times.

    Examples:
      >>> from sme_registry import EvaluationProtocol
      >>> EvaluationProtocol(states_per_region=1000, epsilons=[0.5, 1.0]).edges
      ((0.0, 0.0), (0.0, 0.5), (0.5, 1.0))
    """

    schema_version: SchemaVersion = 1
    states_per_region: Annotated[Integer, Field(ge=2, le=10**8)] = 50_000
    epsilons: Annotated[
        tuple[Real, ...],
        Field(strict=False, min_length=1, max_length=1000),
    ] = (0.2, 0.4, 0.6, 0.8, 1.0)
    sampling: Literal["volume_uniform"] = "volume_uniform"
    time_input: Literal["uniform_over_steps"] = "uniform_over_steps"
    accumulated_reward_input: Literal["zero"] = "zero"
    seed: Annotated[Integer, Field(ge=0, lt=2**53)] = 0

    @model_validator(mode="after")
    def _shells_are_nested(self) -> Self:
        levels = (0.0, *self.epsilons)
        if any(outer <= inner for inner, outer in itertools.pairwise(levels)):
            raise ValueError(
                f"epsilons={short_repr(list(self.epsilons))}: must increase, from above 0. "
                "Sort them and remove repeats and zeros."
            )
        return self

    @property
    def edges(self) -> tuple[tuple[float, float], ...]:
        """`(ε_low, ε_high)` of each region, WD first: (0, 0), (0, ε_1), (ε_1, ε_2), …"""
        levels = (0.0, *self.epsilons)
        return ((0.0, 0.0), *itertools.pairwise(levels))


ProtocolLike: TypeAlias = EvaluationProtocol | dict[str, Any] | str | os.PathLike[str]
"""A protocol: itself, its fields, its name in the catalogue, or the path of its file."""
