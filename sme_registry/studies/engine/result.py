"""`CellResult`: what a finished run of a study left, one file for each.

STUDY/plan.json               the plan, as a `StudyFile`
STUDY/cells/<64 hex>.json     results, by the cell's digest; renamed into place when whole
STUDY/failed/<64 hex>.json    cells that raised, with the error; a retry removes it
STUDY/locks/<64 hex>          held, by the operating system, while a cell runs
STUDY/models/<64 hex>.zip     trained models, where they are kept
STUDY/report/                 what `sme study report` writes
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sme_registry.evaluation import EvaluationReport
from sme_registry.spec import Digest, Integer, Real, SchemaVersion, StrictModel
from sme_registry.spec.study import Cell

_Numbers = Annotated[tuple[Real, ...], Field(strict=False)]


class LearningCurve(StrictModel):
    """Evaluations while training, evenly spaced; every list of one length.

    Attributes:
      steps: environment steps taken before the evaluation.
      episode_return: mean over its episodes, of at most T.
      regret: mean over all steps of its episodes of 1 − step reward.
      similarity: mean r̃ over all steps.
      length: mean length of its episodes.
    """

    steps: Annotated[tuple[Integer, ...], Field(strict=False)] = ()
    episode_return: _Numbers = ()
    regret: _Numbers = ()
    similarity: _Numbers = ()
    length: _Numbers = ()


class Timing(StrictModel):
    """Where the time of a run went, in seconds of one core; no part of what is reproducible."""

    total: Real
    training: Real
    environment: Real
    evaluation: Real
    steps_per_second: Real


class OfflineScores(StrictModel):
    """What a cell that learns from data adds: mean r̃ of who made the data, and of who learnt.

    Attributes:
      nu: ν of the behaviour policy.
      transitions: N of the data set.
      dataset: digest of its arrays.
      behaviour, behaviour_sd: mean and standard deviation of r̃ over the set's transitions.
      score, score_sd: the same over all steps of the last live episodes.
    """

    nu: Real
    transitions: Integer
    dataset: Digest
    behaviour: Real
    behaviour_sd: Real
    score: Real
    score_sd: Real


class CellResult(StrictModel):
    """A finished run.

    Attributes:
      key: the cell's digest.
      cell: the cell, whole.
      curve: its learning curve.
      report: its evaluation within and out of distribution, with the references.
      online_regret: mean regret over all steps of training; null where nothing was trained.
      offline: of a cell that learns from a data set; null where it learns by acting.
      timing: where the time went.
      versions: of the packages that the numbers depend on.
    """

    schema_version: SchemaVersion = 1
    key: Digest
    cell: Cell
    curve: LearningCurve
    report: EvaluationReport
    online_regret: Real | None = None
    offline: OfflineScores | None = None
    timing: Timing
    versions: dict[str, str]


class CellFailure(StrictModel):
    """A run that raised: what, and the last lines of where."""

    schema_version: SchemaVersion = 1
    key: Digest
    cell: Cell
    error: str
    traceback: str
    attempts: Annotated[Integer, Field(ge=1)] = 1
    versions: dict[str, str]
