"""`CellResult`: the result of one finished run of a study, one file each.

STUDY/plan.json               the plan, as a `StudyFile`
STUDY/requests/*.json         the selections of cells (`only`) that runs asked for
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

from typing import Annotated, Any, Self

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from sme_registry.evaluation import EvaluationReport, StreamReport
from sme_registry.spec import Digest, Integer, Real, SchemaVersion, StrictModel
from sme_registry.spec.document import without_empty
from sme_registry.spec.study import Cell

_Numbers = Annotated[tuple[Real, ...], Field(strict=False)]


class LearningCurve(StrictModel):
    """Evaluations during training, evenly spaced; all lists have the same length.

    Attributes:
      steps: training steps before the evaluation: environment steps, or gradient steps of an
        offline learner.
      episode_return: mean return of its episodes, in [0, T].
      regret: mean of 1 − step reward over all steps of its episodes, in [0, 1].
      similarity: mean r̃ over all steps of its episodes, in [0, 1].
      length: mean length of its episodes in steps, in [1, T].
      agents_regret: for a team, `regret` of each agent by its name; the other numbers are means
        over its agents. A single agent's JSON omits it.
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

    Of a lane of a program: the program's CPU seconds (on another device, its wall time) divided
    by its cells. `environment` is 0 there: environment and learner are one program.

    Attributes:
      total: of the whole run.
      training: of the learner.
      environment: of the environment's steps.
      evaluation: of the evaluations.
      steps_per_second: environment steps for each of these seconds without evaluations.
    """

    total: Real
    training: Real
    environment: Real
    evaluation: Real
    steps_per_second: Real


class ProgramResult(StrictModel):
    """In what program a cell of JAX was a lane: its bits depend on all of it.

    Attributes:
      device: its kind, such as "cpu" or "NVIDIA H200".
      lanes: their number.
      shape: S, A, L and H to which the tasks of all lanes were padded; H is 0 where L = 1.
    """

    device: str
    lanes: Annotated[Integer, Field(ge=1)]
    shape: Annotated[tuple[Integer, Integer, Integer, Integer], Field(strict=False)]


class OfflineResult(StrictModel):
    """What an offline cell adds: the similarity of the behaviour policy and of the learner.

    Attributes:
      nu: ν of the behaviour policy, in [0, 1].
      transitions: number of transitions in the data set.
      dataset_digest: digest of its arrays.
      behaviour_similarity: mean r̃ over the transitions of the data set, in [0, 1].
      behaviour_similarity_sd: its standard deviation over transitions.
      similarity: mean r̃ over all steps of the last evaluation's episodes, in [0, 1].
      similarity_sd: its standard deviation over steps.
    """

    nu: Real
    transitions: Integer
    dataset_digest: Digest
    behaviour_similarity: Real
    behaviour_similarity_sd: Real
    similarity: Real
    similarity_sd: Real


class CellResult(StrictModel):
    """A finished run.

    Attributes:
      key: the cell's digest.
      cell: the complete cell.
      curve: its learning curve.
      report: its evaluation in and out of distribution, with the references; None of a life in a
        stream, whose JSON omits it.
      stream_report: of a life in a stream what the agent retains, and its dynamic regret, still
        without fresh agents, which are cells of their own. Any other JSON omits it.
      online_regret: mean regret over all training steps, in [0, 1]; null for references and
        offline learners.
      online_cost: mean cost over them, in [0, 1]; the JSON of a task without `safety` omits it.
      agents_online_regret: the same of each agent of a team, by name. A single agent's JSON omits
        it.
      offline: similarities of an offline cell; null for all others.
      program: of a cell that uses `jax:…`. The JSON of any other omits it.
      timing: CPU seconds by task.
      versions: versions of the packages that the numbers depend on.
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
    offline: OfflineResult | None = None
    program: ProgramResult | None = None
    timing: Timing
    versions: dict[str, str]

    @model_validator(mode="after")
    def _has_the_report_of_its_kind(self) -> Self:
        has = {"report": self.report, "stream_report": self.stream_report}
        own = "report" if self.cell.stream is None else "stream_report"
        if [name for name, report in has.items() if report is not None] != [own]:
            raise ValueError(
                f"{own}: must be the only report, since the cell is "
                f"{'on one task' if own == 'report' else 'a life in a stream'}."
            )
        return self

    @property
    def any_report(self) -> EvaluationReport | StreamReport:
        """The report that it has."""
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

    def _repr_html_(self) -> str:
        """The report's table, for notebooks."""
        return self.any_report._repr_html_()


def report_field(report: EvaluationReport | StreamReport) -> dict[str, Any]:
    """The field of a `CellResult` that a report is."""
    return {"stream_report" if isinstance(report, StreamReport) else "report": report}


class CellFailure(StrictModel):
    """A run that raised an error: its message and the last lines of its traceback."""

    schema_version: SchemaVersion = 1
    key: Digest
    cell: Cell
    error: str
    traceback: str
    attempts: Annotated[Integer, Field(ge=1)] = 1
    versions: dict[str, str]
