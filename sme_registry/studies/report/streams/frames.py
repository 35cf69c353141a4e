"""`load_streams`: a study's finished lives in streams as four tidy pandas frames.

A life is one agent's training through a whole stream. Fresh agents, which train on one phase alone,
are joined to it: a life has its plasticity and learning transfer once all of its fresh agents have
finished. All frames are ordered by class, algorithm and run; `continual.metrics` has the formulas.

`lives`: one row per life and region, with the metrics at the end of the life.

    class_name, algorithm, run   the life's place in the plan; run is a number from 0
    region                       WD, OOD 1, OOD 2, …, and OOD: the mean over the shells
    epsilon_low, epsilon_high    ε of the region's inner and outer face; 0 for WD
    states                       number of evaluation states in the region
    average_performance          mean of 1 − normalised regret over the phases; 1 optimal
    visited_regret               mean over visits of the normalised regret on the phase just visited
    backward_transfer            mean change of performance since each phase was last trained
    forgetting                   mean fall of performance on earlier phases below their best
    forward_transfer             mean gain on phases before their first visit
    relearning                   mean gain of the second visit of a phase on its first
    plasticity_ratio, plasticity_difference   of the visited phase's regret to a fresh agent's,
                                 mean over visits ≥ 1: in visit 0 a life is a fresh agent itself

Columns of the life, repeated in each of its regions; NaN where it has no such number:

    learning_transfer            1 − online regret / that of the fresh agents, mean over visits ≥ 1
    online_regret                mean of 1 − step reward over the life, in [0, 1]
    dynamic_regret               its sum
    frozen_online_regret         online regret of the same agent if it stops learning after visit 0,
                                 in expectation
    uses, action_range, steps    the algorithm, its action range, environment steps of the life
    state_dim, action_dim, horizon   of every phase
    stream_digest, seed          the stream's digest; the seed of training
    fresh_agents                 number of its fresh agents that have finished; a life of one phase
                                 that drifts is a fresh agent itself, and has none
    seconds, steps_per_second    CPU time of the life, and training speed
    key                          digest of the life's cell, which names its file

`visits`: one row per life, visit and region, with the metrics at the end of the visit.

    class_name, algorithm, run, region   as above
    visit, cycle, phase          indices from 0; phase is that of the stream's document
    lifetime                     environment steps at the end of the visit
    normalised_regret            on the phase just visited
    fresh_normalised_regret      that of the phase's fresh agent
    average_performance, backward_transfer, forgetting, plasticity_ratio, plasticity_difference
    online_regret, dynamic_regret, frozen_online_regret, fresh_online_regret, learning_transfer
                                 of the visit's training, repeated in each region

`retention`: the retention matrices, one row per life, region, visit and phase.

    class_name, algorithm, run, region   as above
    visit                        NA for the initial policy
    phase                        on whose task the policy at the end of the visit is evaluated
    normalised_regret            0 optimal, 1 the constant ½

`curves`: one row per life and evaluation during training, as in `load`: on the task in force.

    class_name, algorithm, run, step, episode_return, regret, similarity, length
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sme_registry.evaluation import StreamReport
from sme_registry.evaluation.retention import BY_VISIT, METRICS
from sme_registry.evaluation.stream_report import StreamRegion
from sme_registry.spec import PlannedCell, StudyPlan
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.engine.result import CellResult
from sme_registry.studies.report.frames import (
    CURVES,
    RUN_COLUMNS,
    curve_rows,
    frame,
    ordered,
    place,
    plan_file,
)

_LIVES = f"""{RUN_COLUMNS} region:str epsilon_low epsilon_high states:int64 visited_regret
    {" ".join(METRICS)} learning_transfer online_regret dynamic_regret frozen_online_regret
    uses:str action_range:str steps:int64 state_dim:int64 action_dim:int64 horizon:int64
    stream_digest:str seed:int64 fresh_agents:int64 seconds steps_per_second key:str"""
_VISITS = f"""{RUN_COLUMNS} region:str visit:int64 cycle:int64 phase:int64 lifetime:int64
    normalised_regret fresh_normalised_regret {" ".join(BY_VISIT)} online_regret dynamic_regret
    frozen_online_regret fresh_online_regret learning_transfer"""
_RETENTION = f"{RUN_COLUMNS} region:str visit:Int64 phase:int64 normalised_regret"


class StreamFrames(NamedTuple):
    """A study's finished lives in streams; the module's docstring lists the columns."""

    lives: pd.DataFrame
    visits: pd.DataFrame
    retention: pd.DataFrame
    curves: pd.DataFrame


class Life(NamedTuple):
    """A finished life."""

    planned: PlannedCell
    result: CellResult
    report: StreamReport
    fresh_agents: int


def load_streams(folder: str | os.PathLike[str]) -> StreamFrames:
    """Load the finished lives of a study with streams; frames without rows if there are none.

    Examples:
      >>> from sme_registry import studies
      >>> len(studies.load_streams("study").retention)  # a study without streams
      0
    """
    ledger = Ledger(folder)
    plan = plan_file(ledger).plan
    return stream_frames(lives(plan, ledger.results(cell.cell.digest for cell in plan.cells)))


def lives(plan: StudyPlan, results: Mapping[str, CellResult]) -> list[Life]:
    """The finished lives, from results by the digests of their cells."""
    found = []
    for planned in ordered(plan):
        result = results.get(planned.cell.digest)
        if planned.phase is None and result is not None and result.stream_report is not None:
            alone = [results.get(cell.digest) for cell in planned.cell.fresh]
            finished = [one for one in alone if one is not None]
            report = result.stream_report
            if alone and len(finished) == len(alone):
                report = _with_fresh(report, finished)
            found.append(Life(planned, result, report, len(finished)))
    return found


def stream_frames(lives: list[Life]) -> StreamFrames:
    """The frames of lives."""
    return StreamFrames(
        frame([row for life in lives for row in _life_rows(life)], _LIVES),
        frame([row for life in lives for row in _visit_rows(life)], _VISITS),
        frame([row for life in lives for row in _retention_rows(life)], _RETENTION),
        frame([row for life in lives for row in curve_rows(life.planned, life.result)], CURVES),
    )


def _with_fresh(report: StreamReport, fresh: Sequence[CellResult]) -> StreamReport:
    """The report with its fresh agents, one for each phase."""
    costs = [result.online_regret for result in fresh if result.online_regret is not None]
    known = len(costs) == len(fresh) and report.dynamic_regret is not None
    return report.with_fresh([result.any_report for result in fresh], costs if known else None)


def _life_rows(life: Life) -> Iterator[dict[str, Any]]:
    cell, result, regret = life.result.cell, life.result, life.report.dynamic_regret
    frozen = life.report.reference_regret.get("frozen_agent")
    of_life = {
        **place(life.planned),
        **{name: getattr(cell, name) for name in ("uses", "action_range", "steps", "seed")},
        **{
            name: None if regret is None else getattr(regret, name)
            for name in ("learning_transfer", "online_regret", "dynamic_regret")
        },
        **{
            name: getattr(life.report.stream, name)
            for name in ("state_dim", "action_dim", "horizon")
        },
        "frozen_online_regret": None if frozen is None else frozen.online_regret,
        "stream_digest": life.report.stream_digest,
        "fresh_agents": life.fresh_agents,
        "seconds": result.timing.total,
        "steps_per_second": result.timing.steps_per_second,
        "key": result.key,
    }
    for region in _regions(life.report):
        M = np.array(region.agent.normalised_regret)
        yield {
            **of_life,
            **region.model_dump(include={"epsilon_low", "epsilon_high", "states"}),
            **{name: region.agent.final(name) for name in METRICS},
            "region": region.name,
            "visited_regret": M[np.arange(len(M)), np.arange(len(M)) % M.shape[1]].mean(),
        }


def _visit_rows(life: Life) -> Iterator[dict[str, Any]]:
    report = life.report
    for visit in report.visits:
        v, j = visit.visit, visit.phase
        of_visit = {
            **place(life.planned),
            **visit.model_dump(include={"visit", "cycle", "phase", "lifetime"}),
            **_visit_regret(report, v, j),
        }
        for region in _regions(report):
            agent, alone = region.agent, region.agent.fresh_normalised_regret
            yield {
                **of_visit,
                **{name: getattr(agent, name)[v] for name in BY_VISIT},
                "region": region.name,
                "normalised_regret": agent.normalised_regret[v][j],
                "fresh_normalised_regret": None if alone is None else alone[j],
            }


def _visit_regret(report: StreamReport, visit: int, phase: int) -> dict[str, Any]:
    """What the training of a visit cost."""
    regret = report.dynamic_regret
    if regret is None or visit >= len(regret.visits):
        return {}
    alone, frozen = regret.fresh_online_regret, report.reference_regret.get("frozen_agent")
    names = ("online_regret", "dynamic_regret", "learning_transfer")
    return {
        **{name: getattr(regret.visits[visit], name) for name in names},
        "frozen_online_regret": None if frozen is None else frozen.visits[visit].online_regret,
        "fresh_online_regret": None if alone is None else alone[phase],
    }


def _retention_rows(life: Life) -> Iterator[tuple[Any, ...]]:
    at = place(life.planned).values()
    for region in _regions(life.report):
        initial = region.agent.initial_normalised_regret
        rows = [] if initial is None else [(None, initial)]
        for visit, row in [*rows, *enumerate(region.agent.normalised_regret)]:
            for phase, value in enumerate(row):
                yield (*at, region.name, visit, phase, value)


def _regions(report: StreamReport) -> Iterator[StreamRegion]:
    yield from report.regions
    yield report.ood
