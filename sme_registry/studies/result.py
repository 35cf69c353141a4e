"""`CellResult`: the result of one finished run of a study, one file each; and its `Record`.

STUDY/plan.json               the plan, as a `StudyFile`
STUDY/cells/<64 hex>.json     results, by the cell's digest; renamed into place when complete
STUDY/failed/<64 hex>.json    cells that failed, with the error; a successful retry removes it
STUDY/locks/<64 hex>          locked by the operating system while a cell runs
STUDY/models/<64 hex>.zip     trained models, if they are kept
STUDY/models/<64 hex>/        of a life in a stream: initial.zip, and visit-00.zip, … at the ends of
                              its visits
STUDY/states/<16 hex>.npz     states of programs of JAX that run, or were killed
STUDY/report/                 what `sme study report` writes
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from sme_registry.evaluation import EvaluationReport, StreamReport, evaluate_stream
from sme_registry.evaluation.dynamic_regret import DynamicRegret, RegretBlocks, reference_regret
from sme_registry.evaluation.policies import stream_policy
from sme_registry.io import Arrays
from sme_registry.spec.document import (
    Digest,
    Integer,
    Real,
    SchemaVersion,
    StoredModel,
    StrictModel,
    without_empty,
)
from sme_registry.spec.study import Cell
from sme_registry.training.record import versions_for

CPU = "cpu"
Report = Callable[[int, int], None]  # called with the steps done, and those in all
_Numbers = Annotated[tuple[Real, ...], Field(strict=False)]


class LearningCurve(StrictModel):
    """Evaluations during training, evenly spaced; all lists have the same length.

    `steps` are gradient steps of an offline learner. `episode_return` is in [0, T], but for what is
    paid on top (shaping, noise, the price of a state); `length` in steps. `regret`, the mean of
    1 − step reward, and `similarity` are means over all steps of the episodes, in [0, 1].
    `agents_regret` is of each agent of a team.
    """

    steps: Annotated[tuple[Integer, ...], Field(strict=False)] = ()
    episode_return: _Numbers = ()
    regret: _Numbers = ()
    similarity: _Numbers = ()
    length: _Numbers = ()
    agents_regret: dict[str, _Numbers] = Field(default_factory=dict)

    @model_serializer(mode="wrap")
    def _omit_no_agents(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return without_empty(handler(self), "agents_regret")


class Timing(StrictModel):
    """CPU seconds of a run, by task; the only part of a result that is not reproducible.

    Of a run of a program: the program's CPU seconds (on another device, its wall time) divided by
    its cells. `environment` is 0 there: environment and learner are one program.
    `steps_per_second` counts environment steps and the seconds without evaluations.
    """

    total: Real
    training: Real
    environment: Real
    evaluation: Real
    steps_per_second: Real


class ProgramResult(StrictModel):
    """In what program a cell of JAX ran, with so many runs as `lanes`: its bits depend on it all.

    `shape` is S, A, L and H of the tasks, of a stream the greatest; H is 0 where L = 1.
    """

    device: str
    lanes: Annotated[Integer, Field(ge=1)]
    shape: Annotated[tuple[Integer, Integer, Integer, Integer], Field(strict=False)]


class OfflineCell(StrictModel):
    """What an offline cell adds: its data set, and the mean r̃ of behaviour and learner, in [0, 1].

    That of the learner is over all steps of the last evaluation's episodes.
    """

    nu: Real
    transitions: Integer
    dataset_digest: Digest
    behaviour_similarity: Real
    behaviour_similarity_sd: Real
    similarity: Real
    similarity_sd: Real


class CellResult(StoredModel):
    """A finished run.

    Attributes:
      key: the digest of its cell.
      cell: what it ran.
      curve: its evaluations during training.
      report: None of a life in a stream.
      stream_report: of a life in a stream, still without fresh agents, which are cells of their
        own; None of any other run.
      online_regret: mean over all steps of training, in [0, 1]; None of references and offline
        learners.
      online_cost: likewise, of a task with `safety`.
      agents_online_regret: the regret of each agent of a team.
      offline: of an offline cell.
      program: of a cell in JAX.
      timing: CPU seconds by task.
      versions: of the packages that the numbers depend on.
    """

    schema_version: SchemaVersion = 1
    key: Digest
    cell: Cell
    curve: LearningCurve
    report: EvaluationReport | None = None
    stream_report: StreamReport | None = None
    online_regret: Real | None = None
    online_cost: Real | None = None
    agents_online_regret: dict[str, Real] = Field(default_factory=dict)
    offline: OfflineCell | None = None
    program: ProgramResult | None = None
    timing: Timing
    versions: dict[str, str]

    @model_validator(mode="after")
    def _has_the_report_of_its_kind(self) -> Self:
        in_stream = self.cell.stream is not None
        if (self.report is None, self.stream_report is None) != (in_stream, not in_stream):
            raise ValueError(
                f"{'stream_report' if in_stream else 'report'}: must be the only report, since the "
                f"cell is {'a life in a stream' if in_stream else 'on one task'}."
            )
        return self

    @property
    def any_report(self) -> EvaluationReport | StreamReport:
        report = self.report or self.stream_report
        assert report is not None  # validated
        return report

    @model_serializer(mode="wrap")
    def _omit_empty(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        young = ("agents_online_regret", "program", "report", "stream_report")
        fields = without_empty(handler(self), *young)
        if self.online_cost is None:  # 0 is a cost
            del fields["online_cost"]
        return fields


def report_of_life(life: CellResult, results: Mapping[str, CellResult]) -> StreamReport:
    """The report of a life, with its fresh agents once all of them have finished."""
    report = life.stream_report
    assert report is not None
    fresh = [results[cell.digest] for cell in life.cell.fresh if cell.digest in results]
    if not fresh or len(fresh) < len(life.cell.fresh):
        return report
    costs = [result.online_regret for result in fresh if result.online_regret is not None]
    known = len(costs) == len(fresh) and report.dynamic_regret is not None
    return report.with_fresh([result.any_report for result in fresh], costs if known else None)


class CellFailure(StoredModel):
    """A run that raised an error: its message and the last lines of its traceback."""

    schema_version: SchemaVersion = 1
    key: Digest
    cell: Cell
    error: str
    traceback: str
    attempts: Annotated[Integer, Field(ge=1)] = 1
    versions: dict[str, str]


@dataclass(frozen=True)
class SharedProgram:
    """How the cells of a job run as runs of one program.

    Runs without a cell repeat the first. Programs go on from states with the same `build_key`.
    `cells` are those of such a state, which another job may go on from; empty for the job's.
    """

    runs: int
    device: str | None = None
    state: Path | None = None
    build_key: Mapping[str, Any] = field(default_factory=dict)
    cells: tuple[Cell, ...] = ()


@dataclass(frozen=True)
class Job:
    """Cells that run together: any number as runs of a program, or a single one by itself."""

    cells: tuple[Cell, ...]
    program: SharedProgram | None = None


class Outcome(NamedTuple):
    """How a cell ended, with its model and the snapshots of a life, where these are kept."""

    entry: CellResult | CellFailure
    model: bytes | None = None
    snapshots: Mapping[str, bytes] = {}


def failed(cell: Cell, error: BaseException | str, details: str = "") -> Outcome:
    """A cell's failure, with the end of its traceback or output."""
    if isinstance(error, BaseException):
        error = f"{type(error).__name__}: {error}"
    failure = CellFailure(
        key=cell.digest,
        cell=cell,
        error=error,
        traceback=details[-TRACEBACK_CHARACTERS:],
        versions=versions_for(cell.uses),
    )
    return Outcome(failure)


TRACEBACK_CHARACTERS = 4000  # kept of a failed cell's traceback or output
TRAINING, EVALUATION = 0, 1  # what time is for


class Record:
    """Evaluations, regret, lives and times of the runs of a program, all on tasks of one form.

    One of Stable-Baselines3 is a program with one run. The k-th evaluation follows
    round(steps · k / evaluations) steps, the last one the end of training: on-policy algorithms
    finish their last rollout, so it can be later.
    The last axis of `arrays` is runs; of a team's only run, `regret` is by agent.
    """

    def __init__(
        self,
        cells: Sequence[Cell],
        runs: int,
        evaluations: int,
        clock: Callable[[], float],
        agents: Sequence[str] = (),
    ) -> None:
        cell, n = cells[0], evaluations
        self._cells, self._agents = cells, agents
        self.due = [round(cell.steps * k / n) for k in range(1, n + 1)]
        self.evaluated = 0
        self.arrays: Arrays = {
            "rows": np.zeros((n, 5, runs)),  # the fields of a `LearningCurve`
            "regret": np.zeros(len(agents) or runs),  # over all steps of training
            "failed_at": np.full(runs, -1),  # the step at which a run was seen to have failed
            "seconds": np.zeros(2),
        }
        if agents:
            self.arrays["agents_rows"] = np.zeros((n, len(agents)))
        if cell.spec.safety is not None:
            self.arrays["cost"] = np.zeros(runs)  # as the regret
        self.blocks = None if cell.stream is None else RegretBlocks(cell.stream, runs)
        if self.blocks is not None:
            self.arrays |= {"block_steps": self.blocks.steps, "block_regret": self.blocks.regret}
        self._clock, self._mark = clock, clock()

    def restore(self, arrays: Arrays) -> None:
        self.arrays = arrays
        if self.blocks is not None:
            self.blocks.steps = arrays["block_steps"]
            self.blocks.regret = arrays["block_regret"]

    def add(self, end: int, regret: Any, cost: Any = None, phase: Any = None) -> None:
        """Add the steps of training before step `end` of all runs, or of a team's agents.

        `phase` is that in force in each step of a life; None where it follows from the step.
        """
        sums = {"regret": regret} if cost is None else {"regret": regret, "cost": cost}
        for name, values in sums.items():
            total = self.arrays[name]
            total += np.reshape(values, (-1, len(total))).sum(axis=0)
        if self.blocks is not None:
            self.blocks.add(end, np.reshape(regret, (-1, len(self.arrays["regret"]))), phase)

    def evaluation(self, k: int, rows: Any, agents_regret: Any = None) -> None:
        """Store the k-th evaluation: the fields of a `LearningCurve`, by run."""
        self.arrays["rows"][k] = rows
        if agents_regret is not None:
            self.arrays["agents_rows"][k] = agents_regret
        self.evaluated = k + 1

    def spend(self, purpose: int) -> None:
        """Count the time since the last call."""
        now = self._clock()
        self.arrays["seconds"][purpose] += now - self._mark
        self._mark = now

    def result(
        self,
        run: int,
        steps: int,
        report: EvaluationReport | StreamReport,
        timing: Timing,
        **fields: Any,
    ) -> CellResult:
        """The result of a run after so many steps of training; 0 where nothing was learned."""
        cell = self._cells[run]
        return CellResult(
            key=cell.digest,
            cell=cell,
            curve=self._curve(run),
            report=report if isinstance(report, EvaluationReport) else None,
            stream_report=report if isinstance(report, StreamReport) else None,
            **(self._online(run, steps) if steps else {}),
            timing=timing,
            versions=versions_for(cell.uses),
            **fields,
        )

    def _curve(self, run: int) -> LearningCurve:
        if not self.due:
            return LearningCurve()
        steps, *others = self.arrays["rows"][:, :, run].T.tolist()
        names = [name for name in LearningCurve.model_fields if name != "steps"]
        columns: dict[str, Any] = dict(zip(names, others, strict=False))
        if self._agents:
            by_agent = self.arrays["agents_rows"].T.tolist()
            columns["agents_regret"] = dict(zip(self._agents, by_agent, strict=True))
        return LearningCurve(steps=tuple(int(step) for step in steps), **columns)

    def _online(self, run: int, steps: int) -> dict[str, Any]:
        """Means over all steps of training: the regret, the cost, and the regret of each agent."""
        regret, cost = self.arrays["regret"], self.arrays.get("cost")
        means = (regret / steps).tolist()
        return {
            "online_regret": float(regret.mean() if self._agents else regret[run]) / steps,
            "online_cost": None if cost is None else float(cost[run]) / steps,
            "agents_online_regret": dict(zip(self._agents, means, strict=False)),
        }

    def timing(
        self, steps: int, at_the_end: float = 0.0, *, cells: int = 1, environment: float = 0.0
    ) -> Timing:
        """A cell's share of the time, and that of its evaluation at the end.

        `environment` is the part of training that was spent in steps of the environment.
        """
        training, evaluation = (self.arrays["seconds"] / cells).tolist()
        return Timing(
            total=training + evaluation + at_the_end,
            training=training - environment,
            environment=environment,
            evaluation=evaluation + at_the_end,
            steps_per_second=steps / training if steps and training else 0.0,
        )


def life_report(
    cell: Cell, policies: Sequence[Any], initial: Any, regret: DynamicRegret
) -> StreamReport:
    """The report of a life with the reference agents, still without fresh agents.

    `policies` are those at the ends of the visits, `initial` the one before training.
    """
    assert cell.stream is not None
    stream, range_ = cell.stream, cell.action_range
    report = evaluate_stream(
        policies, stream, cell.protocol, initial=initial, action_range=range_, name=cell.uses
    )
    frozen = stream_policy(policies[0], stream, "visit 0", range_)
    references = reference_regret(stream, frozen=frozen, training=regret)
    return report.with_dynamic_regret(regret).with_reference_regret(references)
