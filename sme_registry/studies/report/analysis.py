"""`analyse`: the tables of a study, from the runs that have finished. Nothing is drawn or written.

The same results give the same numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from sme_registry import statistics
from sme_registry.spec import StudyFile
from sme_registry.studies.engine.result import CellResult
from sme_registry.studies.report import tables
from sme_registry.studies.report.classes import ClassInfo, Group, class_infos, groups
from sme_registry.studies.report.frames import study_frames


@dataclass(frozen=True, eq=False)
class Analysis:
    """A study's runs and tables; `frames` and `tables` document the columns of each frame.

    Attributes:
      file: the plan.
      cells: finished cells of the plan, by digest.
      classes: every class of the plan, by name; the first one first.
      base: the name of the first class.
      algorithms: those with a finished run, in the plan's order.
      learners: those of them that learn.
      groups: classes that are compared with each other.
      results: one row per run and region.
      curves: one row per run and evaluation.
      runs: one row per run.
      offline_runs: one row per run of an offline learner.
    """

    file: StudyFile
    cells: Mapping[str, CellResult]
    classes: Mapping[str, ClassInfo]
    base: str
    algorithms: tuple[str, ...]
    learners: tuple[str, ...]
    groups: tuple[Group, ...]
    results: pd.DataFrame
    curves: pd.DataFrame
    runs: pd.DataFrame
    counts: pd.DataFrame
    missing: pd.DataFrame
    learning_curves: pd.DataFrame
    regions: pd.DataFrame
    levels: pd.DataFrame
    contrasts: pd.DataFrame
    aggregates: pd.DataFrame
    profiles: pd.DataFrame
    improvements: pd.DataFrame
    offline_runs: pd.DataFrame
    offline: pd.DataFrame

    @property
    def has_offline_runs(self) -> bool:
        """Whether any run learnt from a data set."""
        return not self.offline_runs.empty


def analyse(
    file: StudyFile,
    results: Mapping[str, CellResult],
    errors: Mapping[str, str] | None = None,
    *,
    draws: int = statistics.DRAWS,
) -> Analysis:
    """Every table of a study.

    Args:
      file: the plan.
      results: finished runs by the digests of their cells; other cells are ignored.
      errors: of failed runs, likewise.
      draws: bootstrap samples of each interval.
    """
    plan = file.plan
    planned = [cell.cell.digest for cell in plan.cells]
    frames = study_frames(plan, results)
    runs = tables.runs(frames.results)
    classes = class_infos(plan)
    present = [a for a in plan.algorithms if a.name in set(runs.algorithm)]
    names = tuple(algorithm.name for algorithm in present)
    compared = groups(classes, names, set(tables.by_place(runs)))
    missing = tables.missing(plan, runs, errors or {})
    offline_runs = tables.offline_runs(frames.results, plan.algorithms)
    bootstrap = tables.Bootstrap(file.digest, draws)
    return Analysis(
        file=file,
        cells={key: results[key] for key in planned if key in results},
        classes=classes,
        base=plan.classes[0].name,
        algorithms=names,
        learners=tuple(a.name for a in present if not a.uses.startswith("reference:")),
        groups=compared,
        results=frames.results,
        curves=frames.curves,
        runs=runs,
        counts=tables.counts(plan, missing),
        missing=missing,
        learning_curves=tables.learning_curves(frames.curves, runs),
        regions=tables.regions(frames.results),
        levels=tables.levels(frames.results, bootstrap),
        contrasts=tables.contrasts(runs, classes, bootstrap),
        aggregates=tables.aggregates(runs, compared, names, bootstrap),
        profiles=tables.profiles(runs, compared, names, bootstrap),
        improvements=tables.improvements(runs, compared, names, bootstrap),
        offline_runs=offline_runs,
        offline=tables.offline(offline_runs, bootstrap),
    )
