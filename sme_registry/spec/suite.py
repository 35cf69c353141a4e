"""`Suite`, a list of classes, and `EvaluationProtocol`, the states to evaluate a policy in.

A class is one setting with its instances (seeds), so a method is evaluated on a kind of task, not
on one draw of it. Protocols: METHOD, section 3.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
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


def _check_distinct(field: str, values: Sequence[Any]) -> None:
    if len(set(values)) != len(values):
        raise ValueError(f"{field}={short_repr(list(values))}: must be distinct. Remove repeats.")


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
        _check_distinct("seeds", self.seeds)
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
    stream: Annotated[StreamSpec, BeforeValidator(partial(find_named, StreamSpec))]
    draws: Annotated[
        tuple[Annotated[Integer, Field(ge=0, lt=2**32)], ...],
        Field(min_length=1, max_length=10_000, strict=False),
    ] = (0,)

    @model_validator(mode="after")
    def _draws_differ(self) -> Self:
        _check_distinct("draws", self.draws)
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
        check_classes(self.classes, self.streams)
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
    def documents(self) -> tuple[SMESpec | StreamSpec, ...]:
        """Every spec of the suite, and then every stream."""
        return (*self.instances, *self.stream_instances)

    @property
    def places(self) -> list[tuple[str, str, int | str]]:
        """Of each of the documents the class, "seed" or "draw", and which."""
        seeds = [(member.name, "seed", seed) for member in self.classes for seed in member.seeds]
        draws = [(member.name, "draw", draw) for member in self.streams for draw in member.draws]
        return [*seeds, *draws]

    @property
    def runs(self) -> dict[str, int]:
        """Class → number of its instances, of tasks and of streams."""
        tasks = {member.name: len(member.seeds) for member in self.classes}
        return tasks | {member.name: len(member.draws) for member in self.streams}

    def check_no_streams(self, what: str) -> None:
        """Raise SpecError if the suite has streams."""
        if self.streams:
            names = ", ".join(member.name for member in self.streams)
            raise SpecError(
                f"suite: has streams ({names}), and {what} needs single tasks. Choose a suite "
                "without streams; studies run lives in streams: `sme study new --suite`."
            )


def check_classes(classes: tuple[SuiteClass, ...], streams: tuple[StreamClass, ...]) -> None:
    if not classes and not streams:
        raise ValueError(
            "classes: must have at least 1 entry, unless there are streams. Add a class, or a "
            "stream."
        )
    check_names("classes", classes)
    check_names("streams", (*classes, *streams))


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
