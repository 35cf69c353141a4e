"""`analyse`: the tables of a study, from the runs that have finished; equal for equal results."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import pandas as pd

from sme_registry import statistics
from sme_registry.spec import StudyFile, StudyPlan
from sme_registry.studies.engine.result import CellResult
from sme_registry.studies.report import frames, offline_tables, tables
from sme_registry.studies.report.classes import ClassInfo, Group, class_infos, groups
from sme_registry.studies.report.streams.analysis import StreamAnalysis, analyse_streams


@dataclass(frozen=True, eq=False)
class Analysis:
    """A study's runs and tables; `frames` and `tables` document the columns of each frame.

    Attributes:
      file: the plan.
      cells: finished cells of the plan, by digest.
      classes: every class of the plan, by name; the first one first.
      algorithms: those with a finished run on a single task, in the plan's order.
      learners: those of the algorithms that learn.
      groups: classes that are compared with each other.
      streams: the lives in streams; None where the plan has no streams. All other fields are about
        single tasks.
    """

    file: StudyFile
    cells: Mapping[str, CellResult]
    classes: Mapping[str, ClassInfo]
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
    layers: pd.DataFrame
    agents: pd.DataFrame
    contrasts: pd.DataFrame
    aggregates: pd.DataFrame
    profiles: pd.DataFrame
    improvements: pd.DataFrame
    differences: pd.DataFrame
    offline_runs: pd.DataFrame
    offline: pd.DataFrame
    streams: StreamAnalysis | None

    @property
    def base(self) -> str:
        """The name of the first class; "" where the plan has none."""
        return next(iter(self.classes), "")

    @property
    def seconds(self) -> float:
        """CPU time of all finished runs."""
        of_streams = self.streams.seconds if self.streams else 0.0
        return float(self.runs.seconds.sum()) + of_streams

    @property
    def finished(self) -> int:
        """How many runs have finished, lives and fresh agents included."""
        return len(self.runs) + (self.streams.finished if self.streams else 0)

    @property
    def requested(self) -> int:
        """How many runs have finished or are missing; `--only` may have left out others."""
        of_streams = self.streams.requested if self.streams else 0
        return len(self.runs) + len(self.missing) + of_streams

    @property
    def state_dims(self) -> list[int]:
        """The different state dimensions of the runs, in rising order."""
        return sorted(set(self.results.state_dim))

    @property
    def metrics(self) -> tuple[tables.Metric, ...]:
        """The metrics of runs on single tasks."""
        return tables.metrics_of(self.runs)

    @property
    def has_teams(self) -> bool:
        """Whether any run is of a team."""
        return not self.agents.empty

    @property
    def has_offline_runs(self) -> bool:
        """Whether any run learnt from a data set."""
        return not self.offline_runs.empty


def analyse(
    file: StudyFile,
    finished: Mapping[str, CellResult],
    errors: Mapping[str, str] | None = None,
    *,
    requested: Collection[str] | None = None,
    draws: int = statistics.DRAWS,
) -> Analysis:
    """Every table of a study."""
    plan = file.plan
    results, curves = frames.study_frames(plan, finished)
    runs = frames.runs(results)
    classes = class_infos(plan)
    present = [a for a in plan.algorithms if a.name in set(runs.algorithm)]
    names = tuple(algorithm.name for algorithm in present)
    compared = groups(classes, names, set(tables.by_place(runs)))
    missing = tables.missing(plan, runs, errors or {}, requested)
    offline_runs = offline_tables.offline_runs(results, plan.algorithms)
    bootstrap = tables.Bootstrap(file.digest, draws)
    return Analysis(
        file=file,
        cells={key: finished[key] for key in _finished_keys(plan, runs, finished)},
        classes=classes,
        algorithms=names,
        learners=tuple(a.name for a in present if not a.uses.startswith("reference:")),
        groups=compared,
        results=results,
        curves=curves,
        runs=runs,
        counts=tables.counts(plan, runs, missing),
        missing=missing,
        learning_curves=tables.learning_curves(curves, runs),
        regions=tables.regions(results),
        levels=tables.levels(results, bootstrap),
        layers=tables.layers(frames.probes(plan, finished)),
        agents=tables.agents(runs, bootstrap),
        contrasts=tables.contrasts(runs, {n: c.axis for n, c in classes.items()}, bootstrap),
        aggregates=tables.aggregates(runs, compared, names, bootstrap),
        profiles=tables.profiles(runs, compared, names, bootstrap),
        improvements=tables.improvements(runs, compared, names, bootstrap),
        differences=tables.differences(runs, itertools.combinations(names, 2), draws=draws),
        offline_runs=offline_runs,
        offline=offline_tables.offline(offline_runs, bootstrap),
        streams=analyse_streams(file, finished, errors or {}, requested=requested, draws=draws)
        if plan.streams
        else None,
    )


def _finished_keys(
    plan: StudyPlan, runs: pd.DataFrame, finished: Mapping[str, CellResult]
) -> Iterable[str]:
    """Digests of the finished cells: on single tasks in the order of the runs, then in streams."""
    yield from runs.key
    yield from (p.cell.digest for p in plan.cells if p.in_stream and p.cell.digest in finished)
