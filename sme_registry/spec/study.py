"""`StudyPlan`: algorithms × classes of tasks × seeds, the budget of each run and its evaluation.

Cell i of an algorithm and a class trains with seed i on instance i of the class (modulo the number
of instances). On a stream an algorithm lives once, and for each phase a fresh agent trains on that
phase alone, with which its plasticity is compared.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, model_validator

from sme_registry.errors import OptionError, SpecError
from sme_registry.spec.document import (
    Digest,
    Document,
    Integer,
    Name,
    PlainJson,
    SchemaVersion,
    StrictModel,
    check_names,
    matching,
    short_repr,
)
from sme_registry.spec.sme_spec import ActionRange, Setting, SMESpec
from sme_registry.spec.stream import Phase, StreamSpec
from sme_registry.spec.suite import EvaluationProtocol, Suite, SuiteClass

_NAME = r"^[A-Za-z0-9 ._+()-]+$"  # of an algorithm
FRESH_EVALUATIONS = 10  # at most, of a fresh agent
Steps = Annotated[Integer, Field(ge=0, le=10**10)]


def _check_source(uses: str, source: str | None) -> None:
    if source is not None and not uses.startswith("train:"):
        raise ValueError(f"source={source!r}: is for uses='train:module:function'. Leave it out.")


class StudyAlgorithm(StrictModel):
    """An algorithm of a study.

    Attributes:
      name: its name in reports, unique in the plan.
      uses: an algorithm of Stable-Baselines3 ("PPO"), the same in a program of JAX ("jax:PPO"), an
        installed entry point of the group `sme_registry.algorithms`, `module:function`, which
        returns a model, `train:module:function`, which trains in any way and returns a policy, or
        `reference:constant`, `reference:linear`, `reference:random`, `reference:optimal`, which
        learn nothing. The agents of a team share one model; `independent:PPO` has one for each.
      hyperparameters: where they differ from the algorithm's defaults.
      action_range: of the environment it acts in: [−1, 1] ("symmetric") or [0, 1] ("unit").
      steps: its budget on single tasks; null takes the plan's.
      source: of `train:module:function`, the SHA-256 of the module's source. A run fills it in,
        and refuses another source than a plan states.
    """

    fields_added_later: ClassVar[tuple[str, ...]] = ("source",)

    name: Annotated[str, matching(_NAME, "letters, digits, spaces and . _ + ( ) -", max_length=64)]
    uses: Annotated[str, Field(min_length=1, max_length=200)]
    hyperparameters: PlainJson = Field(default_factory=dict)
    action_range: ActionRange = "symmetric"
    steps: Steps | None = None
    source: Digest | None = None

    @model_validator(mode="after")
    def _has_a_source(self) -> Self:
        _check_source(self.uses, self.source)
        return self


class Cell(Document):
    """One run of a study, by content: its digest is the key of its result.

    Neither the plan nor its names are part of a cell, so a plan may be renamed, cut or extended,
    and its results stay valid.

    Attributes:
      spec: the task; of a life in a stream that of its first phase.
      stream: the stream; None for a single task.
      uses: the algorithm, as in the plan.
      source: the SHA-256 of its module's source, as in the plan.
      hyperparameters: where they differ from the algorithm's defaults.
      action_range: of the environment that the agent acts in.
      seed: of training.
      steps: environment steps; of a life those of the stream.
      evaluations: evenly spaced over training, the last at its end; 0 for none.
      evaluation_episodes: in each of them.
      protocol: of the evaluation within and out of distribution at the end.
    """

    fields_added_later: ClassVar[tuple[str, ...]] = ("stream", "source")

    schema_version: SchemaVersion = 1
    spec: SMESpec
    stream: StreamSpec | None = None
    uses: str
    source: Digest | None = None
    hyperparameters: PlainJson
    action_range: ActionRange
    seed: Annotated[Integer, Field(ge=0, lt=2**32)]
    steps: Steps
    evaluations: Integer
    evaluation_episodes: Integer
    protocol: EvaluationProtocol

    @model_validator(mode="after")
    def _lives_in_its_stream(self) -> Self:
        _check_source(self.uses, self.source)
        if self.stream is None:
            return self
        if self.spec != self.stream.phases[0].spec or self.steps != self.stream.steps:
            raise ValueError(
                "stream: its first phase and its steps must be the cell's spec and steps."
            )
        return self

    @property
    def document(self) -> SMESpec | StreamSpec:
        """What the agent lives in: the stream, or the task."""
        return self.stream or self.spec

    @property
    def fresh(self) -> tuple[Cell, ...]:
        """Of a life, for each phase the run of an agent on that phase alone."""
        if self.stream is None:
            return ()
        documents = [_alone(phase) for phase in self.stream.phases]
        if documents == [self.stream]:
            return ()
        # A number that depends on the stream would give streams that share a phase different cells.
        evaluations = min(self.evaluations, FRESH_EVALUATIONS)
        return tuple(
            Cell(
                **dict(self)
                | _lived_in(document)
                | {"steps": phase.steps, "evaluations": evaluations}
            )
            for phase, document in zip(self.stream.phases, documents, strict=True)
        )

    @property
    def specs(self) -> tuple[SMESpec, ...]:
        """The task, or those of the stream's phases."""
        return self.document.specs


class PlannedCell(StrictModel):
    """A cell and its place in the plan.

    Attributes:
      class_name: of the class of tasks or streams.
      algorithm: its name in the plan.
      run: its number, from 0.
      phase: of a fresh agent, the index of the stream's phase on which alone it trains.
      cell: the cell. Different places may have the same one, such as fresh agents of two streams.
    """

    class_name: Name
    algorithm: str
    run: Integer
    phase: Integer | None = None
    cell: Cell

    @property
    def in_stream(self) -> bool:
        """Whether its class is one of streams: a life, or a fresh agent."""
        return self.phase is not None or self.cell.stream is not None


class StudyPlan(Suite):
    """A study: a suite, and what runs on it.

    Attributes:
      classes: kinds of tasks; the others are compared with the first.
      streams: kinds of streams.
      algorithms: those run on each class.
      seeds: runs of each algorithm on each class.
      steps: environment steps of a run; a life has the steps of its stream, and a fresh agent those
        of its phase.
      evaluations: evenly spaced over training, the last at its end; 0 for none.
      evaluation_episodes: in each of them.
      protocol: of the evaluation within and out of distribution at the end.

    Examples:
      >>> from sme_registry.spec import Setting, StudyAlgorithm, StudyPlan, SuiteClass
      >>> plan = StudyPlan(
      ...     classes=[SuiteClass(name="default", setting=Setting(), seeds=[1, 2])],
      ...     algorithms=[StudyAlgorithm(name="PPO", uses="PPO")],
      ...     seeds=5,
      ... )
      >>> len(plan.cells)
      5
    """

    algorithms: Annotated[
        tuple[StudyAlgorithm, ...], Field(min_length=1, max_length=100, strict=False)
    ]
    seeds: Annotated[Integer, Field(ge=1, le=10_000)] = 10
    steps: Steps = 100_000
    evaluations: Annotated[Integer, Field(ge=0, le=100_000)] = 400
    evaluation_episodes: Annotated[Integer, Field(ge=1, le=10_000)] = 5
    protocol: EvaluationProtocol = EvaluationProtocol()

    @model_validator(mode="after")
    def _can_be_run(self) -> Self:
        check_names("algorithms", self.algorithms)
        for i, algorithm in enumerate(self.algorithms):
            if not self.classes and algorithm.steps is not None:
                raise ValueError(
                    f"algorithms.{i}.steps={algorithm.steps:,}: must be null, since lives have the "
                    "steps of their streams, and the plan has no single tasks. Leave it out, or "
                    "make streams with other steps."
                )
        for i, member in enumerate(self.streams):
            try:
                member.stream.check_visits()
            except SpecError as error:
                raise ValueError(f"streams.{i}.stream: {error}") from None
        return self

    @property
    def cells(self) -> tuple[PlannedCell, ...]:
        """Every run: seeds outermost, so that a study that is cut short has whole comparisons."""
        instances_of = {member.name: member.instances for member in self.members}
        return tuple(
            planned
            for run in range(self.seeds)
            for name, instances in instances_of.items()
            for algorithm in self.algorithms
            for planned in self._runs(name, instances[run % len(instances)], algorithm, run)
        )

    def _runs(
        self, class_name: str, document: SMESpec | StreamSpec, algorithm: StudyAlgorithm, run: int
    ) -> Iterator[PlannedCell]:
        steps = self.steps if algorithm.steps is None else algorithm.steps
        if isinstance(document, StreamSpec):
            steps = document.steps
        cell = Cell(
            **_lived_in(document),
            uses=algorithm.uses,
            source=algorithm.source,
            hyperparameters=algorithm.hyperparameters,
            action_range=algorithm.action_range,
            seed=run,
            steps=steps,
            evaluations=self.evaluations,
            evaluation_episodes=self.evaluation_episodes,
            protocol=self.protocol,
        )
        cells: list[tuple[int | None, Cell]] = [(None, cell), *enumerate(cell.fresh)]
        place: dict[str, Any] = {"class_name": class_name, "algorithm": algorithm.name, "run": run}
        for phase, planned in cells:
            yield PlannedCell(**place, phase=phase, cell=planned)


def _lived_in(document: SMESpec | StreamSpec) -> dict[str, Any]:
    stream = document if isinstance(document, StreamSpec) else None
    return {"spec": document.specs[0], "stream": stream}


def _alone(phase: Phase) -> SMESpec | StreamSpec:
    """A phase by itself: its task, or the stream that drifts as it does."""
    return phase.spec if phase.drift is None else StreamSpec(phases=(phase,))


def sweep(
    spec: SMESpec, axes: Mapping[str, Sequence[Any]], *, name: str = "default", instances: int = 1
) -> tuple[SuiteClass, ...]:
    """The classes of a sweep: named settings that each differ from the task in one field.

    One class for each value of a single axis, such as `k-1`, `k-5`. With several axes, or none, the
    task itself comes first, and stands for its own value on each axis. Each class has `instances`
    draws, with the task's seed and those that follow it.

    Examples:
      >>> from sme_registry.studies import sweep
      >>> [member.name for member in sweep(sme_registry.SMESpec(), {"k": [1, 5, 10]})]
      ['k-1', 'k-5', 'k-10']
    """
    fields = spec.to_dict()
    seeds = _instance_seeds(fields.pop("seed"), instances)
    base = Setting.from_dict(fields)
    classes = [SuiteClass(name=name, setting=base, seeds=seeds)] if len(axes) != 1 else []
    for field, values in axes.items():
        _check_axis(field, values)
        settings = [
            Setting.from_dict(_with(fields, field, value), f"sweep {field}={_text(value)}")
            for value in values
        ]
        if any(setting in settings[:i] for i, setting in enumerate(settings)):
            raise OptionError(f"sweep {field}: has the same value twice. Remove one.")
        classes += [
            SuiteClass(name=class_name, setting=setting, seeds=seeds)
            for class_name, setting in zip(_class_names(field, values), settings, strict=True)
            if not classes or setting != classes[0].setting
        ]
    return tuple(classes)


def _instance_seeds(seed: int | str, instances: int) -> tuple[int | str, ...]:
    if instances == 1:
        return (seed,)
    if isinstance(seed, str):
        raise OptionError(
            f"instances={instances}: must be 1 for a task with the hexadecimal seed {seed}. "
            "Leave it out."
        )
    return tuple(range(seed, seed + instances))


def _check_axis(field: str, values: Sequence[Any]) -> None:
    if field == "seed":
        raise OptionError(
            "sweep seed: is no axis. Give the number of instances (--instances) for several draws "
            "of each class."
        )
    if not values:
        raise OptionError(f"sweep {field}: has no values. Give some, such as {field}=1,2,5.")


def _with(fields: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy of plain data with one value replaced; `path` is dotted, with places in lists."""
    changed: dict[str, Any] = copy.deepcopy(fields)
    place: Any = changed
    *outer, last = (int(part) if part.isdigit() else part for part in path.split("."))
    try:
        for part in outer:
            place = place[part]
        place[last] = value
    except (KeyError, IndexError, TypeError):
        raise OptionError(
            f"sweep {path}: this task has no such field. Start from a task that has it, such as a "
            "team for team.reward; an entry of a list is named by its place, from 0."
        ) from None
    return changed


def _class_names(field: str, values: Sequence[Any]) -> list[str]:
    """`k-5`, `r_min-0_5`, as in the catalogue; numbers from 0 where values are lists."""
    stem = field.replace(".", "-")
    texts = [re.sub(r"[^A-Za-z0-9]+", "_", _text(value)).strip("_") for value in values]
    plain = all(isinstance(value, str | int | float) for value in values)
    if not plain or len(set(texts)) < len(texts) or len(stem) + max(map(len, texts)) > 60:
        texts = [str(i) for i in range(len(values))]
    return [f"{stem[: 63 - len(text)]}-{text}" for text in texts]  # at most 64 characters


def _text(value: Any) -> str:
    return value if isinstance(value, str) else short_repr(value)
