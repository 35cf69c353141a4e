"""`StreamSpec`: tasks in order, each for a number of environment steps; METHOD, section 7.

A stream is piecewise constant: in each *segment* one spec is in force, so optimum and regret are
exact. A phase is one segment, or n short ones whose `rotation` moves in equal increments (drift).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import lru_cache, partial
from itertools import accumulate
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

from pydantic import BeforeValidator, Field, model_validator

from sme_registry.errors import SpecError
from sme_registry.io import integer_in
from sme_registry.spec.blocks import MAX_SEED
from sme_registry.spec.document import (
    Digest,
    Integer,
    NamedDocument,
    Real,
    SchemaVersion,
    StrictModel,
    find_named,
)
from sme_registry.spec.sme_spec import FULL_TURN, Segment, SegmentTimes, SMESpec

MAX_SEGMENTS = 10_000  # of one cycle
MAX_VISITS = 1_000  # of a life that is evaluated
BETWEEN_DRAWS = 10**6  # of the seeds of a stream, so that its draws have no task in common
_SHARED = ("state_dim", "action_dim", "horizon")


class Drift(StrictModel):
    """A rotation that moves during a phase, from its spec's angle, in equal increments.

    Attributes:
      rotation: the angle θ towards which it moves, radians; 2π is a full turn from 0.
      increments: n. Segment i of n has the angle θ₀ + i (θ − θ₀)/n, so that the first one is the
        phase's own spec, and the next phase may go on at θ.
    """

    rotation: Annotated[Real, Field(ge=0, le=FULL_TURN)]
    increments: Annotated[Integer, Field(ge=2, le=MAX_SEGMENTS)]


class Phase(StrictModel):
    """A task for a number of environment steps.

    Attributes:
      spec: the task. A name, id, digest or path of one is read as the spec that it stands for.
      digest: of the spec; filled in, and refused where it is another's.
      steps: environment steps, counted across episodes.
      drift: how the spec's rotation moves within the phase; None where it does not.
    """

    spec: Annotated[SMESpec, BeforeValidator(partial(find_named, SMESpec))]
    digest: Digest | None = None
    steps: Annotated[Integer, Field(ge=1, le=10**12)]
    drift: Drift | None = None

    @model_validator(mode="before")
    @classmethod
    def _digest_names_the_spec(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "spec" in data or "digest" not in data:
            return data
        return {"spec": data["digest"], **data}

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.digest is None:
            object.__setattr__(self, "digest", self.spec.digest)
        if self.digest != self.spec.digest:
            raise ValueError(
                f"digest={self.digest!r}: this spec has {self.spec.digest!r}. One of them was "
                "changed later. Remove the digest to keep the spec, or the spec to take the one "
                "with this digest."
            )
        if self.drift is None:
            return self
        if self.drift.increments > self.steps:
            raise ValueError(
                f"drift.increments={self.drift.increments}: must be at most steps={self.steps}. "
                "Use fewer increments or more steps."
            )
        if self.drift.rotation == self.spec.rotation:
            raise ValueError(
                f"drift.rotation={self.drift.rotation}: is the angle of the spec. Choose another "
                "one, or leave drift out."
            )
        try:
            self.spec.derive(rotation=1.0)
        except SpecError as error:
            raise ValueError(f"drift: {str(error).removeprefix('SMESpec: ')}") from None
        return self


class StreamSpec(NamedDocument):
    """Phases in order, gone through `cycles` times.

    The *lifetime* counts environment steps across episodes. After the last cycle, the last phase
    goes on. Phases have the same state and action dimensions and horizon, so that one agent can
    live through all of them.

    Attributes:
      phases: in order.
      cycles: how often the phases are gone through.
      switch: when a phase that is over is left: at the next reset ("episode"), or at once ("step");
        then the state and r_cum carry over.
      observes_phase: whether the observation ends with the phase's index, one-hot.

    Examples:
      >>> from sme_registry import StreamSpec
      >>> phases = [{"spec": "Default", "steps": 500}, {"spec": "Complexity10", "steps": 500}]
      >>> stream = StreamSpec(phases=phases, cycles=2)
      >>> stream.steps, stream.visits
      (2000, 4)
    """

    kind: ClassVar[str] = "stream"

    schema_version: SchemaVersion = 1
    phases: Annotated[tuple[Phase, ...], Field(min_length=1, max_length=1000, strict=False)]
    cycles: Annotated[Integer, Field(ge=1, le=10**6)] = 1
    switch: Literal["episode", "step"] = "episode"
    observes_phase: bool = False

    @model_validator(mode="after")
    def _phases_fit_together(self) -> Self:
        first = self.phases[0].spec
        for index, phase in enumerate(self.phases):
            if phase.spec.team is not None:
                raise ValueError(
                    f"phases.{index}.spec: is for a team of {len(phase.spec.team.agents)} agents, "
                    "and streams are for a single one. Remove its team."
                )
            for field in ("safety", "observation"):
                if getattr(phase.spec, field) is not None:
                    raise ValueError(
                        f"phases.{index}.spec: has {field}, which streams do not support yet. "
                        f"Remove its {field}."
                    )
            for field in _SHARED:
                one, other = getattr(first, field), getattr(phase.spec, field)
                if one != other:
                    raise ValueError(
                        f"phases.0 and phases.{index}: their specs have {field}={one} and {other}: "
                        "must be equal, since one agent lives through both. Change one of them."
                    )
        segments = sum(phase.drift.increments if phase.drift else 1 for phase in self.phases)
        if segments > MAX_SEGMENTS:
            raise ValueError(
                f"phases: have {segments:,} segments: must be at most {MAX_SEGMENTS:,}. Use fewer "
                "increments."
            )
        return self

    @property
    def state_dim(self) -> int:
        """S of every phase."""
        return self.phases[0].spec.state_dim

    @property
    def action_dim(self) -> int:
        """A of every phase."""
        return self.phases[0].spec.action_dim

    @property
    def horizon(self) -> int:
        """T of every phase."""
        return self.phases[0].spec.horizon

    @property
    def observed_phases(self) -> int:
        """P, of whose one-hot an observation ends with; 0 where the agent does not observe it."""
        return len(self.phases) if self.observes_phase else 0

    @property
    def observation_dim(self) -> int:
        """S + 2, and one for each phase where the agent observes it."""
        return self.state_dim + 2 + self.observed_phases

    @property
    def cycle_steps(self) -> int:
        """Environment steps of one cycle."""
        return sum(phase.steps for phase in self.phases)

    @property
    def visits(self) -> int:
        """How often the stream visits a phase: phases times cycles."""
        return self.cycles * len(self.phases)

    @property
    def steps(self) -> int:
        """Environment steps of the whole stream."""
        return self.cycles * self.cycle_steps

    @property
    def specs(self) -> tuple[SMESpec, ...]:
        """The spec of each phase, as it begins."""
        return tuple(phase.spec for phase in self.phases)

    @property
    def segments(self) -> tuple[Segment, ...]:
        """The segments of one cycle, in order."""
        return _segments(self.phases)

    @property
    def times(self) -> SegmentTimes:
        """Which of them is in force after how many environment steps."""
        starts = [segment.start for segment in self.segments]
        return SegmentTimes(starts, self.cycle_steps, self.cycles)

    @property
    def switches(self) -> tuple[Any, ...]:
        """When its tasks change, and how: equal for all draws of a stream, whatever its tasks."""
        segments = tuple((segment.phase, segment.start) for segment in self.segments)
        return segments, self.cycle_steps, self.cycles, self.switch, self.observes_phase

    def visit_ends(self) -> Iterator[tuple[int, int]]:
        """The index v of each visit, of phase v mod P, and the lifetime at its end."""
        steps = (phase.steps for _ in range(self.cycles) for phase in self.phases)
        return enumerate(accumulate(steps))

    def draw(self, number: int) -> StreamSpec:
        """The same stream with other tasks: number · 10⁶ is added to the seed of every phase.

        Phases with equal seeds have equal seeds in each draw, so what relates them is kept.
        """
        number = integer_in("number", number, 0, 2**32 - 1)
        return self if number == 0 else self._moved(number * BETWEEN_DRAWS)

    @property
    def family(self) -> StreamSpec:
        """This stream with its first seed moved to 0, and all others as far: equal for all draws.

        Runs of streams of one family can be compared as runs of one stream.
        """
        return self._moved(-int(str(self.phases[0].spec.seed), 0))

    @property
    def kinds(self) -> set[SMESpec]:
        """The tasks of the phases, but for their seeds and rotations."""
        return {phase.spec.derive(rotation=0.0, seed=0) for phase in self.phases}

    def check_visits(self) -> None:
        """Raise SpecError if a life has more visits than are evaluated."""
        if self.visits > MAX_VISITS:
            raise SpecError(
                f"cycles × phases={self.visits:,}: must be at most {MAX_VISITS:,}, since a life is "
                "evaluated on every phase at the end of each visit. Use fewer cycles or phases."
            )

    def _moved(self, by: int) -> StreamSpec:
        phases = [
            Phase(
                spec=one.spec.derive(seed=_moved(one.spec.seed, by)),
                steps=one.steps,
                drift=one.drift,
            )
            for one in self.phases
        ]
        return StreamSpec(**{**dict(self), "phases": phases})


StreamLike: TypeAlias = StreamSpec | dict[str, Any] | str | os.PathLike[str]
"""A stream: itself, its fields, an id, a digest, or the path of its file."""


def _moved(seed: int | str, by: int) -> int | str:
    moved = (int(str(seed), 0) + by) % 2**256
    return moved if moved < MAX_SEED else hex(moved)


@lru_cache(maxsize=32)
def _segments(phases: tuple[Phase, ...]) -> tuple[Segment, ...]:
    begins = accumulate((phase.steps for phase in phases), initial=0)
    return tuple(
        Segment(index, spec, begin + offset)
        for index, (phase, begin) in enumerate(zip(phases, begins, strict=False))
        for spec, offset in _segments_of(phase)
    )


def _segments_of(phase: Phase) -> list[tuple[SMESpec, int]]:
    """The specs of a phase's segments, and the steps of the phase before each."""
    if phase.drift is None:
        return [(phase.spec, 0)]
    n, begin = phase.drift.increments, phase.spec.rotation
    move = phase.drift.rotation - begin
    return [
        (phase.spec.derive(rotation=begin + move * i / n), phase.steps * i // n) for i in range(n)
    ]
