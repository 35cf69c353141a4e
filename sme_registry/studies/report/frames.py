"""`load`, `load_streams`: a study's finished runs as tidy pandas frames, as the report uses them.

`results`: one row per run and region, ordered by class, algorithm, run, region.

    class_name, algorithm, run   the run's place in the plan; run is a number from 0
    region                       WD, OOD 1, OOD 2, …
    epsilon_low, epsilon_high    ε of the region's inner and outer face; 0 for WD
    states                       number of evaluation states in the region
    similarity, similarity_sd    mean r̃, in [0, 1], and its standard deviation over states
    mae                          mean |a − a*|, in [0, 1]
    normalised_regret            mean |a − a*| / mean |½ − a*|: 0 optimal, 1 the constant ½
    similarity_decay             (r̃_WD − r̃) / r̃_WD; 0 in WD, negative where r̃ is higher outside
    similarity_loss              100 (r̃_WD − r̃), in points of similarity
    clipped_share                share of action entries outside the action range, in [0, 1]
    linear_normalised_regret     of the linear policy fitted to the optimum, on the same states
    best_constant_normalised_regret, random_normalised_regret   of these references, likewise
    constant_similarity          mean r̃ of the constant ½, in [0, 1]

Columns of the run, repeated in each of its regions; NaN or NA where the run has no such number:

    wd_regret, ood_regret        normalised regret in WD, and its mean over the shells
    ood_decay                    the mean of similarity_decay over the shells
    final_return                 mean return of the last evaluations, in % of the optimum's; the sum
                                 of step rewards where more is paid (shaping, noise, a price)
    online_regret                mean of 1 − step reward over training, in [0, 1]
    uses, action_range, steps    the algorithm, its action range, its training steps
    state_dim, action_dim, k, r_min, D, complexity, horizon, hidden_width, policy_init, rotation,
    spec_seed, spec_digest, seed   fields of the task's spec, its seed and digest as text; the seed
                                 of training
    nu, transitions, dataset_digest   the data set of an offline run: ν in [0, 1], its size
    behaviour_similarity, behaviour_similarity_sd    r̃ of the behaviour policy over the data set
    offline_similarity, offline_similarity_sd        r̃ of the learner over its last episodes
    improvement                  offline_similarity − behaviour_similarity
    seconds, steps_per_second    CPU time of the run, and training speed
    key                          digest of the run's cell, which names its file

With shaping: its scale and discount; with noise: its reward and transition. With safety: tightness
τ of the limits, and compensated; online_cost, the mean over training; wd_cost and wd_safe_regret,
of the cube; cost, violating_share, safe_regret and price_of_safety, of the region. With
observation: distractors, dynamics, mixing, mixing_depth; distractor_regret, the mean over the
shells of d; wd_sensitivity, of the cube; sensitivity, of the region. The numbers of a team are
means over agents or channels. Those of each agent have its name: normalised_regret/agent_0 of the
region, wd_regret, ood_regret and online_regret of the run, and in `curves` regret/agent_0.

`curves`: one row per run and evaluation during training, ordered by class, algorithm, run, step.

    step                         training steps before the evaluation (offline: gradient steps)
    episode_return               mean return of its episodes, in [0, horizon] but for what is paid
                                 on top: shaping, noise and the price of the state
    regret                       mean of 1 − step reward over their steps, in [0, 1]
    similarity                   mean r̃ over their steps, in [0, 1]
    length                       mean length of the episodes, in steps

A life in a stream (`load_streams`) has its plasticity and learning transfer once the fresh agents
of its phases have finished; `evaluation.retention` has the formulas.

`lives`: one row per life and region, with the metrics at the end of the life.

    region                       WD, OOD 1, OOD 2, …, and OOD: the mean over the shells
    average_performance          mean of 1 − normalised regret over the phases; 1 optimal
    visited_regret               mean over visits of the normalised regret on the phase just visited
    backward_transfer            mean change of performance since each phase was last trained
    forgetting                   mean fall of performance on earlier phases below their best
    forward_transfer             mean gain on phases before their first visit
    relearning                   mean gain of the second visit of a phase on its first
    plasticity_ratio, plasticity_difference   of regret to a fresh agent's, mean over visits ≥ 1

Columns of the life, repeated in each of its regions; NaN where it has no such number:

    learning_transfer            1 − online regret / that of the fresh agents, mean over visits ≥ 1
    online_regret, dynamic_regret    mean of 1 − step reward over the life, in [0, 1]; its sum
    frozen_online_regret         its expectation if the same agent stops learning after visit 0
    state_dim, action_dim, horizon   of every phase
    stream_digest                the stream's digest
    fresh_agents                 number of its fresh agents that have finished

`visits`: one row per life, visit and region, with the metrics at the end of the visit.

    visit, cycle, phase          indices from 0; phase is that of the stream's document
    lifetime                     environment steps at the end of the visit
    normalised_regret, fresh_normalised_regret   on the phase just visited; its fresh agent's
    average_performance, backward_transfer, forgetting, plasticity_ratio, plasticity_difference
    online_regret, dynamic_regret, frozen_online_regret, fresh_online_regret, learning_transfer
                                 of the visit's training, repeated in each region

`retention`: the retention matrices, one row per life, region, visit and phase: `normalised_regret`
on the task of `phase` at the end of `visit`, which is NA for the initial policy.

`curves`: one row per life and evaluation during training, as in `load`: on the task in force.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from sme_registry.evaluation import EvaluationReport, StreamReport, retention
from sme_registry.evaluation.regions import RegionReport
from sme_registry.evaluation.retention import BY_VISIT, StreamRegion
from sme_registry.spec import Setting, SMESpec, StreamSpec, StudyPlan
from sme_registry.spec.cards import BLOCKS, fields_of_block, number_type
from sme_registry.spec.study import PlannedCell
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.report.design import metrics_of
from sme_registry.studies.result import CellResult, report_of_life
from sme_registry.task.draw import Array

RUN = ["class_name", "algorithm", "run"]
RUN_COLUMNS = "class_name:str algorithm:str run:int64 "  # columns of `RUN`, for `frame`


def _metric_columns(needs: str) -> str:
    return " ".join(metric.key for metric in metrics_of("run") if metric.needs == needs)


def _block_columns(block: str) -> str:
    """The fields of a block, of which runs without it have none."""
    fields = fields_of_block(block).items()
    return " ".join(
        f"{name}:{_OPTIONAL.get(number_type(field) or field.annotation, 'string')}"
        for name, field in fields
    )


_DTYPES: dict[type | None, str] = {int: "int64", float: "float64"}
_OPTIONAL: dict[Any, str] = {int: "Int64", float: "float64", bool: "boolean"}
_MEASURED = [name for name in RegionReport.model_fields if name not in ("name", "channels")]
_REGION = f"""region:str {" ".join(_MEASURED).replace("states", "states:int64")}
    linear_normalised_regret best_constant_normalised_regret random_normalised_regret
    constant_similarity """
_SPEC = " ".join(
    f"{name}:{_DTYPES.get(number_type(field), 'str')}"
    for name, field in Setting.model_fields.items()
    if name not in ("schema_version", *BLOCKS)
)
_RUN = f"""{_metric_columns("")} uses:str action_range:str steps:int64 {_SPEC}
    spec_seed:str spec_digest:str seed:int64 nu transitions:Int64 dataset_digest:string
    behaviour_similarity behaviour_similarity_sd offline_similarity offline_similarity_sd
    improvement seconds steps_per_second key:str"""
_OF_REGIONS = {
    "safety": "cost violating_share safe_regret price_of_safety",
    "observation": "sensitivity",
}
# Columns of a run, and of its regions, only where the plan has tasks with these fields.
_OF_TASKS = {
    block: (f"{_block_columns(block)} {_metric_columns(block)}", _OF_REGIONS.get(block, ""))
    for block in BLOCKS
    if block != "team"
}
CURVES = RUN_COLUMNS + "step:int64 episode_return regret similarity length"
# Columns of each agent of a team, as in `wd_regret/agent_0`.
AGENT_COLUMNS = ("normalised_regret", *(metric.key for metric in metrics_of("agent")))
_LIVES = f"""{RUN_COLUMNS} region:str epsilon_low epsilon_high states:int64 visited_regret
    {" ".join(retention.METRICS)} learning_transfer online_regret dynamic_regret
    frozen_online_regret uses:str action_range:str steps:int64 state_dim:int64 action_dim:int64
    horizon:int64 stream_digest:str seed:int64 fresh_agents:int64 seconds steps_per_second
    key:str"""
_VISITS = f"""{RUN_COLUMNS} region:str visit:int64 cycle:int64 phase:int64 lifetime:int64
    normalised_regret fresh_normalised_regret {" ".join(BY_VISIT)} online_regret dynamic_regret
    frozen_online_regret fresh_online_regret learning_transfer"""
_RETENTION = f"{RUN_COLUMNS} region:str visit:Int64 phase:int64 normalised_regret"
_REFERENCES = {
    "linear_normalised_regret": "linear",
    "best_constant_normalised_regret": "best_constant",
    "random_normalised_regret": "random",
}
_LONGEST_WINDOW = 10


class StudyFrames(NamedTuple):
    """A study's finished runs; the module's docstring lists the columns."""

    results: pd.DataFrame
    curves: pd.DataFrame


def load(folder: str | os.PathLike[str]) -> StudyFrames:
    """Load the finished runs of a study; frames without rows if there are none.

    Examples:
      >>> from sme_registry import studies
      >>> results, curves = studies.load("study")
      >>> sorted(results["algorithm"].unique())
      ['PPO', 'constant', 'linear']
    """
    return study_frames(*_study(folder))


def _study(folder: str | os.PathLike[str]) -> tuple[StudyPlan, dict[str, CellResult]]:
    ledger = Ledger(folder)
    plan = ledger.study_file().plan
    return plan, ledger.results(cell.cell.digest for cell in plan.cells)


def study_frames(plan: StudyPlan, results: Mapping[str, CellResult]) -> StudyFrames:
    """The frames of a plan's runs, from results by the digests of their cells."""
    runs = [run for run in finished_runs(plan, results) if not run[0].in_stream]
    rows = [row for run in runs for row in _result_rows(*run)]
    evaluations = [row for run in runs for row in _curve_rows(*run)]
    reports = [result.report for _, result in runs if result.report is not None]
    agents = list(dict.fromkeys(name for report in reports for name in report.agents))
    by_agent = " ".join(f" {column}/{name}" for column in AGENT_COLUMNS for name in agents)
    regrets = " ".join(f" regret/{name}" for name in agents)
    of_tasks = "".join(
        f" {of_run} {of_region}"
        for field, (of_run, of_region) in _OF_TASKS.items()
        if any(getattr(member.setting, field) is not None for member in plan.classes)
    )
    return StudyFrames(
        frame(rows, RUN_COLUMNS + _REGION + _RUN + of_tasks + by_agent),
        frame(evaluations, CURVES + regrets),
    )


def runs_of(results: pd.DataFrame) -> pd.DataFrame:
    """One row per run: `results` without the columns of its regions."""
    of_regions = _dtypes(" ".join((_REGION, *(columns for _, columns in _OF_TASKS.values()))))
    of_run = [
        name
        for name in results.columns
        if name not in of_regions and not name.startswith(f"{AGENT_COLUMNS[0]}/")
    ]
    return results.drop_duplicates(RUN)[of_run].reset_index(drop=True)


def finished_runs(
    plan: StudyPlan, results: Mapping[str, CellResult]
) -> list[tuple[PlannedCell, CellResult]]:
    """Those of the plan by class, then algorithm, then run; the plan itself has runs outermost."""
    names = [*(c.name for c in plan.classes), *(c.name for c in plan.streams)]
    classes = {name: i for i, name in enumerate(names)}
    algorithms = {algorithm.name: i for i, algorithm in enumerate(plan.algorithms)}
    cells = [cell for cell in plan.cells if cell.cell.digest in results]
    cells.sort(key=lambda c: (classes[c.class_name], algorithms[c.algorithm], c.run))
    return [(cell, results[cell.cell.digest]) for cell in cells]


def frame(rows: Sequence[Any], columns: str) -> pd.DataFrame:
    """A frame of tuples or dicts, with columns `name:dtype`, or `name` alone for float64."""
    dtypes = _dtypes(columns)
    return pd.DataFrame(rows, columns=list(dtypes)).astype(dtypes)


def _dtypes(columns: str) -> dict[str, str]:
    parts = (column.partition(":") for column in columns.split())
    return {name: dtype or "float64" for name, _, dtype in parts}


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a frame as plain data; NaN is None."""
    plain = table.astype(object).where(table.notna(), None)
    return [{str(name): value for name, value in row.items()} for row in plain.to_dict("records")]


def window(evaluations: int) -> int:
    """How many evaluations are averaged: the paper's 10 of its 400, fewer where there are few."""
    return min(_LONGEST_WINDOW, max(1, evaluations // 10))


def _result_rows(cell: PlannedCell, result: CellResult) -> Iterator[dict[str, Any]]:
    report = result.report
    assert report is not None  # it is on a single task
    run = place(cell) | _run_columns(result, report)
    references = report.references
    for index, region in enumerate(report.regions):
        regrets = {c: references[name][index].normalised_regret for c, name in _REFERENCES.items()}
        agents = {
            f"normalised_regret/{name}": agent.regions[index].normalised_regret
            for name, agent in report.agents.items()
        }
        yield {
            **run,
            **agents,
            **region.model_dump(exclude={"name", "channels"}),
            **report.task_scores(index),
            **regrets,
            "region": region.name,
            "constant_similarity": references["constant"][index].similarity,
        }


def _curve_rows(cell: PlannedCell, result: CellResult) -> Iterator[dict[str, Any]]:
    curve = result.curve
    columns = {
        "step": curve.steps,
        **{name: getattr(curve, name) for name in ("episode_return", "regret", "similarity")},
        "length": curve.length,
        **{f"regret/{name}": regrets for name, regrets in curve.agents_regret.items()},
    }
    for evaluation in zip(*columns.values(), strict=True):
        yield place(cell) | dict(zip(columns, evaluation, strict=True))


def place(cell: PlannedCell) -> dict[str, Any]:
    return {name: getattr(cell, name) for name in RUN}


def _run_columns(result: CellResult, report: EvaluationReport) -> dict[str, Any]:
    """The columns of `_RUN`; those of offline runs only where there are any."""
    cell = result.cell
    columns = {
        **cell.spec.every_field(),
        **_metrics(result, report),
        **_of_cell(result),
        "spec_seed": str(cell.spec.seed),
        "spec_digest": cell.spec.digest,
    }
    for block in _OF_TASKS:
        fields = getattr(cell.spec, block)
        columns |= {} if fields is None else fields.every_field()
    for name, agent in report.agents.items():
        wd, *shells = (region.normalised_regret for region in agent.regions)
        columns |= {
            f"wd_regret/{name}": wd,
            f"ood_regret/{name}": float(np.mean(shells)) if shells else math.nan,
            f"online_regret/{name}": result.agents_online_regret.get(name, math.nan),
        }
    if (offline := result.offline) is not None:
        columns |= offline.model_dump() | {
            "offline_similarity": offline.similarity,
            "offline_similarity_sd": offline.similarity_sd,
            "improvement": offline.similarity - offline.behaviour_similarity,
        }
    return columns


def _metrics(result: CellResult, report: EvaluationReport) -> dict[str, Any]:
    """Every metric of a run: a property of its report or result, or of the training cube."""
    inside = report.task_scores(0)
    metrics = {
        "final_return": _final_return(result),
        "wd_cost": inside.get("cost"),
        "wd_safe_regret": inside.get("safe_regret"),
        "wd_sensitivity": inside.get("sensitivity"),
    }
    for metric in metrics_of("run"):
        if metric.key not in metrics:
            source = report if hasattr(report, metric.key) else result
            metrics[metric.key] = getattr(source, metric.key)
    return metrics


def _of_cell(result: CellResult) -> dict[str, Any]:
    names = ("uses", "action_range", "steps", "seed")
    return {
        **{name: getattr(result.cell, name) for name in names},
        "seconds": result.timing.total,
        "steps_per_second": result.timing.steps_per_second,
        "key": result.key,
    }


def _final_return(result: CellResult) -> float:
    """Mean return over the last window of evaluations, in % of T; NaN without evaluations."""
    curve, spec = result.curve, result.cell.spec
    if not curve.steps:
        return math.nan
    returns = share_of_optimum(spec, curve.episode_return, curve.regret, curve.length)
    return float(np.mean(returns[-window(len(returns)) :]))


def share_of_optimum(
    document: SMESpec | StreamSpec,
    episode_return: npt.ArrayLike,
    regret: npt.ArrayLike,
    length: npt.ArrayLike,
) -> Array:
    """Returns in % of T, the optimum's; of step rewards alone where more than they is paid."""
    returns = np.asarray(episode_return, dtype=np.float64)
    if any(spec.shaping or spec.compensated or spec.noise for spec in document.specs):
        returns = (1.0 - np.asarray(regret)) * np.asarray(length)
    return 100.0 * returns / document.horizon


class StreamFrames(NamedTuple):
    """A study's finished lives in streams; the module's docstring lists the columns."""

    lives: pd.DataFrame
    visits: pd.DataFrame
    retention: pd.DataFrame
    curves: pd.DataFrame


class FinishedLife(NamedTuple):
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
    return stream_frames(finished_lives(*_study(folder)))


def finished_lives(plan: StudyPlan, results: Mapping[str, CellResult]) -> list[FinishedLife]:
    """The finished lives, from results by the digests of their cells."""
    lives = []
    for planned, result in finished_runs(plan, results):
        if result.stream_report is not None and planned.phase is None:
            fresh = sum(cell.digest in results for cell in planned.cell.fresh)
            lives.append(FinishedLife(planned, result, report_of_life(result, results), fresh))
    return lives


def stream_frames(lives: Sequence[FinishedLife]) -> StreamFrames:
    return StreamFrames(
        frame([row for life in lives for row in _life_rows(life)], _LIVES),
        frame([row for life in lives for row in _visit_rows(life)], _VISITS),
        frame([row for life in lives for row in _retention_rows(life)], _RETENTION),
        frame([row for life in lives for row in _curve_rows(life.planned, life.result)], CURVES),
    )


def _life_rows(life: FinishedLife) -> Iterator[dict[str, Any]]:
    regret, frozen = life.report.dynamic_regret, life.report.reference_regret.get("frozen_agent")
    of_life = {
        **place(life.planned),
        **life.report.stream.phases[0].spec.every_field(),
        **_of_cell(life.result),
        **_training(regret),
        "frozen_online_regret": None if frozen is None else frozen.online_regret,
        "stream_digest": life.report.stream_digest,
        "fresh_agents": life.fresh_agents,
    }
    for region in _regions(life.report):
        M = np.array(region.agent.normalised_regret)
        yield {
            **of_life,
            **{n: getattr(region, n) for n in ("epsilon_low", "epsilon_high", "states")},
            **{name: region.agent.final(name) for name in retention.METRICS},
            "region": region.name,
            "visited_regret": M[np.arange(len(M)), np.arange(len(M)) % M.shape[1]].mean(),
        }


def _visit_rows(life: FinishedLife) -> Iterator[dict[str, Any]]:
    report = life.report
    for visit in report.visits:
        v, j = visit.visit, visit.phase
        of_visit = {
            **place(life.planned),
            **visit.model_dump(),
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
    regret = report.dynamic_regret
    if regret is None or visit >= len(regret.visits):
        return {}
    alone, frozen = regret.fresh_online_regret, report.reference_regret.get("frozen_agent")
    return {
        **_training(regret.visits[visit]),
        "frozen_online_regret": None if frozen is None else frozen.visits[visit].online_regret,
        "fresh_online_regret": None if alone is None else alone[phase],
    }


def _training(regret: Any) -> dict[str, Any]:
    """The columns of a life's or visit's training; empty if its cost is unknown."""
    names = ("online_regret", "dynamic_regret", "learning_transfer")
    return {} if regret is None else {name: getattr(regret, name) for name in names}


def _retention_rows(life: FinishedLife) -> Iterator[tuple[Any, ...]]:
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
