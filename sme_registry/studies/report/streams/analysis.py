"""`analyse_streams`: the tables of a study's streams; equal for equal results."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import pandas as pd

from sme_registry import statistics
from sme_registry.spec import StudyFile
from sme_registry.studies.engine.result import CellResult
from sme_registry.studies.report.streams import frames, tables
from sme_registry.studies.report.tables import Bootstrap, contrasts, differences, learning_curves


@dataclass(frozen=True, eq=False)
class StreamAnalysis:
    """A study's lives in streams; `streams.frames` and `streams.tables` document the columns.

    Attributes:
      lives: the finished ones.
      classes: every class of streams of the plan, by name; the first one first.
      algorithms: those with a finished life, in the plan's order.
      finished: how many different cells of the plan's streams have finished, fresh agents included.
      requested: how many have finished or are missing.
      planned: how many there are.
      seconds: CPU time of those that have finished.
    """

    lives: tuple[frames.Life, ...]
    classes: Mapping[str, tables.StreamInfo]
    algorithms: tuple[str, ...]
    finished: int
    requested: int
    planned: int
    seconds: float
    frames: frames.StreamFrames
    metrics: pd.DataFrame
    visit_metrics: pd.DataFrame
    matrices: pd.DataFrame
    contrasts: pd.DataFrame
    differences: pd.DataFrame
    references: pd.DataFrame
    regret: pd.DataFrame
    reference_regret: pd.DataFrame
    learning_curves: pd.DataFrame
    counts: pd.DataFrame
    missing: pd.DataFrame

    @property
    def base(self) -> str:
        """The name of the first class."""
        return next(iter(self.classes))


def analyse_streams(
    file: StudyFile,
    finished: Mapping[str, CellResult],
    errors: Mapping[str, str],
    *,
    requested: Collection[str] | None = None,
    draws: int = statistics.DRAWS,
) -> StreamAnalysis:
    """Every table of a study's streams; arguments as of `analysis.analyse`."""
    plan, bootstrap = file.plan, Bootstrap(file.digest, draws)
    lives = frames.lives(plan, finished)
    found, costs = frames.stream_frames(lives), tables.reference_costs(lives)
    within = tables.within(found)
    classes = tables.stream_infos(plan)
    names = tuple(each.name for each in plan.algorithms if each.name in set(within.algorithm))
    missing = tables.missing(plan, finished, errors, requested)
    keys = {cell.cell.digest for cell in plan.cells if cell.in_stream}
    done = [finished[key] for key in sorted(keys & finished.keys())]
    axes = {name: info.axis for name, info in classes.items()}
    return StreamAnalysis(
        lives=tuple(lives),
        classes=classes,
        algorithms=names,
        finished=len(done),
        requested=len(done) + missing.key.nunique(),
        planned=len(keys),
        seconds=sum(result.timing.total for result in done),
        frames=found,
        metrics=tables.metrics(found.lives, bootstrap),
        visit_metrics=tables.visit_metrics(found.visits, bootstrap),
        matrices=tables.matrices(found.retention, bootstrap),
        contrasts=contrasts(within, axes, bootstrap, tables.METRICS),
        differences=differences(
            within, itertools.combinations(names, 2), tables.METRICS, draws, "stream_digest"
        ),
        references=tables.references(lives, costs),
        regret=tables.regret(lives),
        reference_regret=tables.reference_curves(costs),
        learning_curves=learning_curves(found.curves, within, lambda evaluations: 1),
        counts=tables.counts(plan, finished, missing),
        missing=missing,
    )
