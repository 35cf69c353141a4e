"""`StudyPlan`: algorithms × classes of tasks × seeds, the budget of each run and its evaluation.

A plan holds everything that its results depend on, so a colleague can run a study from one file.
Its cells are its runs: cell i of an algorithm and a class trains with seed i on instance i of the
class (modulo the number of instances); in the paper, too, a seed determines both.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, JsonValue, model_validator

from sme_registry.spec.document import (
    Document,
    Integer,
    Name,
    SchemaVersion,
    StrictModel,
    refuse_repeated_names,
)
from sme_registry.spec.protocol import EvaluationProtocol
from sme_registry.spec.sme_spec import ActionRange, Setting, SMESpec
from sme_registry.spec.suite import SuiteClass

Steps = Annotated[Integer, Field(ge=0, le=10**10)]


OFFLINE = "offline:"  # the beginning of a `uses` that learns from data
INDEPENDENT = "independent:"  # of one with a model for each agent of a team
JAX = "jax:"  # of one that runs with its environment in a program of JAX


def in_jax(uses: str) -> bool:
    """Whether an algorithm runs in a program of JAX."""
    return uses.startswith(JAX)


def _check_task(uses: str, setting: Setting, field: str) -> None:
    """Raise ValueError, which Pydantic reports, if an algorithm cannot learn a task."""
    if uses.startswith(OFFLINE) and setting.team is not None:
        raise ValueError(
            f"{field}={uses!r}: cannot learn a task for {len(setting.team.agents)} agents, because "
            "data sets are collected for a single agent. Use an algorithm that learns online, such "
            "as PPO."
        )
    if uses.startswith(INDEPENDENT) and setting.team is None:
        raise ValueError(
            f"{field}={uses!r}: needs a team, and this task has a single agent. Use "
            f"{uses.removeprefix(INDEPENDENT)!r}."
        )
    if in_jax(uses) and setting.team is not None:
        raise ValueError(
            f"{field}={uses!r}: cannot learn a task for {len(setting.team.agents)} agents. Use an "
            f"algorithm of Stable-Baselines3, such as {uses.removeprefix(JAX)!r}."
        )


class StudyAlgorithm(StrictModel):
    """An algorithm of a study.

    Attributes:
      name: its name in reports, unique in the plan.
      uses: an algorithm of Stable-Baselines3 ("PPO"), the same in a program of JAX ("jax:PPO"), an
        installed entry point of the group `sme_registry.algorithms`, `module:function`, or
        `reference:constant`, `reference:linear`, `reference:random`, `reference:optimal`, which
        learn nothing. The agents of a team share one model; `independent:PPO` has one for each.
      hyperparameters: where they differ from the algorithm's defaults.
      action_range: of the environment it acts in: [−1, 1] ("symmetric") or [0, 1] ("unit").
      steps: its budget; null takes the plan's.
    """

    name: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9 ._+()-]+$")]
    uses: Annotated[str, Field(min_length=1, max_length=200)]
    hyperparameters: dict[str, JsonValue] = Field(default_factory=dict)
    action_range: ActionRange = "symmetric"
    steps: Steps | None = None


class Cell(Document):
    """One run of a study, by content: its digest is the key of its result.

    Neither the plan nor its names are part of a cell, so a plan may be renamed, cut or extended,
    and its results stay valid.
    """

    schema_version: SchemaVersion = 1
    spec: SMESpec
    uses: str
    hyperparameters: dict[str, JsonValue]
    action_range: ActionRange
    seed: Annotated[Integer, Field(ge=0, lt=2**32)]
    steps: Steps
    evaluations: Integer
    evaluation_episodes: Integer
    protocol: EvaluationProtocol

    @model_validator(mode="after")
    def _task_suits_the_algorithm(self) -> Self:
        _check_task(self.uses, self.spec, "uses")
        return self


class PlannedCell(StrictModel):
    """A cell and its place in the plan."""

    class_name: Name
    algorithm: str
    run: Integer
    cell: Cell


class StudyPlan(Document):
    """A study.

    Attributes:
      classes: kinds of tasks; the others are compared with the first.
      algorithms: those run on each class.
      seeds: runs of each algorithm on each class.
      steps: environment steps of a run.
      evaluations: evenly spaced over training, the last at its end; 0 for none.
      evaluation_episodes: in each of them.
      protocol: of the evaluation within and out of distribution at the end.
    """

    schema_version: SchemaVersion = 1
    classes: Annotated[tuple[SuiteClass, ...], Field(min_length=1, max_length=1000, strict=False)]
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
        refuse_repeated_names("classes", self.classes)
        refuse_repeated_names("algorithms", self.algorithms)
        for i, algorithm in enumerate(self.algorithms):
            for member in self.classes:
                _check_task(algorithm.uses, member.setting, f"algorithms.{i}.uses")
        return self

    @property
    def cells(self) -> tuple[PlannedCell, ...]:
        """Every run: seeds outermost, so that a study that is cut short has whole comparisons."""
        instances = {member.name: member.instances for member in self.classes}
        return tuple(
            PlannedCell(
                class_name=member.name,
                algorithm=algorithm.name,
                run=run,
                cell=Cell(
                    spec=instances[member.name][run % len(instances[member.name])],
                    uses=algorithm.uses,
                    hyperparameters=algorithm.hyperparameters,
                    action_range=algorithm.action_range,
                    seed=run,
                    steps=self.steps if algorithm.steps is None else algorithm.steps,
                    evaluations=self.evaluations,
                    evaluation_episodes=self.evaluation_episodes,
                    protocol=self.protocol,
                ),
            )
            for run in range(self.seeds)
            for member in self.classes
            for algorithm in self.algorithms
        )
