"""`load`: a study's finished runs as two tidy pandas frames, which the report also uses.

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
    ood_decay                    ood_regret − wd_regret
    final_return                 mean return of the last evaluations, in % of the optimum's
    online_regret                mean of 1 − step reward over training, in [0, 1]
    uses, action_range, steps    the algorithm, its action range, its training steps
    state_dim, action_dim, k, r_min, D, complexity, horizon, hidden_width, policy_init, rotation,
    spec_seed                    fields of the task's spec; spec_seed as text
    spec_digest, seed            the task's digest; the seed of training
    nu, transitions, dataset_digest   the data set of an offline run: ν in [0, 1], its size
    behaviour_similarity, behaviour_similarity_sd    r̃ of the behaviour policy over the data set
    offline_similarity, offline_similarity_sd        r̃ of the learner over its last episodes
    improvement                  offline_similarity − behaviour_similarity
    seconds, steps_per_second    CPU time of the run, and training speed
    key                          digest of the run's cell, which names its file

`curves`: one row per run and evaluation during training, ordered by class, algorithm, run, step.

    class_name, algorithm, run   as above
    step                         training steps before the evaluation (offline: gradient steps)
    episode_return               mean return of its episodes, in [0, horizon]
    regret                       mean of 1 − step reward over their steps, in [0, 1]
    similarity                   mean r̃ over their steps, in [0, 1]
    length                       mean length of the episodes, in steps

Where the plan has teams, whose other numbers are means over agents or channels, there are columns
for each agent, NaN for tasks without it:

    results: normalised_regret/<agent>                                    of the region
             wd_regret/<agent>, ood_regret/<agent>, online_regret/<agent> of the run
    curves:  regret/<agent>                                               of the evaluation

Where the plan has tasks with safety or with observation, `results` has these columns of them, NaN
or NA for the other tasks:

    tightness                                             of the task's limits, τ
    online_cost                                           of the run: mean cost over training
    wd_cost, wd_safe_regret                               of the run: those of the cube
    cost, violating_share, safe_regret, price_of_safety   of the region
    distractors, dynamics, mixing, mixing_depth           fields of the task's observation
    distractor_regret                                     of the run: mean over the shells of d
    wd_invariance                                         of the run: that of the cube
    invariance                                            of the region
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport
from sme_registry.spec import PlannedCell, StudyFile, StudyPlan
from sme_registry.studies.engine.ledger import Ledger
from sme_registry.studies.engine.result import CellResult

RUN = ["class_name", "algorithm", "run"]
RUN_COLUMNS = "class_name:str algorithm:str run:int64 "  # columns of `RUN`, for `frame`
_REGION = """region:str epsilon_low epsilon_high states:int64 similarity similarity_sd mae
    normalised_regret similarity_decay similarity_loss clipped_share linear_normalised_regret
    best_constant_normalised_regret random_normalised_regret constant_similarity """
_RUN = """wd_regret ood_regret ood_decay final_return online_regret uses:str action_range:str
    steps:int64 state_dim:int64 action_dim:int64 k:int64 r_min D complexity:int64 horizon:int64
    hidden_width:int64 policy_init:str rotation spec_seed:str spec_digest:str seed:int64 nu
    transitions:Int64 dataset_digest:string behaviour_similarity behaviour_similarity_sd
    offline_similarity offline_similarity_sd improvement seconds steps_per_second key:str"""
# Columns of a run, and of its regions, where the plan has tasks with these fields.
_EXTENSIONS = {
    "safety": (
        "tightness online_cost wd_cost wd_safe_regret",
        "cost violating_share safe_regret price_of_safety",
    ),
    "observation": (
        "distractors:Int64 dynamics:string mixing:string mixing_depth:Int64 distractor_regret "
        "wd_invariance",
        "invariance",
    ),
}
CURVES = RUN_COLUMNS + "step:int64 episode_return regret similarity length"
_PROBES = RUN_COLUMNS + "layer:int64 units:int64 state_r2 distractor_r2"
# Columns of each agent of a team, as in `wd_regret/agent_0`.
AGENT_COLUMNS = ("normalised_regret", "wd_regret", "ood_regret", "online_regret")
_RUN_OF_AGENT = tuple(f"{column}/" for column in AGENT_COLUMNS[1:])
_REFERENCES = {
    "linear_normalised_regret": "linear_least_squares",
    "best_constant_normalised_regret": "best_constant",
    "random_normalised_regret": "uniform_random",
}
_LONGEST_WINDOW = 10


class StudyFrames(NamedTuple):
    """A study's finished runs; the module's docstring lists the columns."""

    results: pd.DataFrame
    curves: pd.DataFrame

    def __repr__(self) -> str:
        return f"<StudyFrames: results {self.results.shape}, curves {self.curves.shape}>"

    def _repr_html_(self) -> str:
        """Both frames, for notebooks; pandas abbreviates long ones."""
        frames = self._asdict().items()
        return "".join(f"<h4>{name}</h4>{frame.to_html(max_rows=10)}" for name, frame in frames)


def load(folder: str | os.PathLike[str]) -> StudyFrames:
    """Load the finished runs of a study; frames without rows if there are none.

    Examples:
      >>> from sme_registry import studies
      >>> results, curves = studies.load("study")
      >>> sorted(results["algorithm"].unique())
      ['PPO', 'constant', 'linear']
    """
    ledger = Ledger(folder)
    file = plan_file(ledger)
    return study_frames(file.plan, ledger.results(cell.cell.digest for cell in file.plan.cells))


def plan_file(ledger: Ledger) -> StudyFile:
    """The plan in a study's folder; raises the errors of `load`."""
    file = ledger.plan_file()
    if file is None:
        raise OptionError(
            f"folder={str(ledger.folder)!r}: holds no study. Give the folder of `sme study run`."
        )
    return file


def study_frames(plan: StudyPlan, results: Mapping[str, CellResult]) -> StudyFrames:
    """The frames of a plan's runs, from results by the digests of their cells."""
    planned = [(cell, results.get(cell.cell.digest)) for cell in ordered(plan)]
    finished = [
        (cell, result, result.report)
        for cell, result in planned
        if result is not None and result.report is not None and not cell.in_stream
    ]
    rows = [row for each in finished for row in _result_rows(*each)]
    evaluations = [row for cell, result, _ in finished for row in curve_rows(cell, result)]
    agents = list(dict.fromkeys(name for *_, report in finished for name in report.agents))
    by_agent = " ".join(f" {column}/{name}" for column in AGENT_COLUMNS for name in agents)
    regrets = " ".join(f" regret/{name}" for name in agents)
    extensions = "".join(
        f" {of_run} {of_region}"
        for field, (of_run, of_region) in _EXTENSIONS.items()
        if any(getattr(each.setting, field) is not None for each in plan.classes)
    )
    return StudyFrames(
        frame(rows, RUN_COLUMNS + _REGION + _RUN + extensions + by_agent),
        frame(evaluations, CURVES + regrets),
    )


def probes(plan: StudyPlan, results: Mapping[str, CellResult]) -> pd.DataFrame:
    """One row per run and probed layer; see `evaluation.LayerProbe`. Empty without any."""
    rows = [
        place(planned) | probe.model_dump()
        for planned in ordered(plan)
        if (result := results.get(planned.cell.digest)) is not None
        and (report := result.report) is not None
        and report.observation is not None
        for probe in report.observation.probes
    ]
    return frame(rows, _PROBES)


def runs(results: pd.DataFrame) -> pd.DataFrame:
    """One row per run: `results` without the columns of its regions."""
    by_agent = [name for name in results.columns if name.startswith(_RUN_OF_AGENT)]
    extensions = _dtypes(" ".join(of_run for of_run, _ in _EXTENSIONS.values()))
    present = [name for name in extensions if name in results.columns]
    columns = [*RUN, *_dtypes(_RUN), *present, *by_agent]
    return results.drop_duplicates(RUN)[columns].reset_index(drop=True)


def ordered(plan: StudyPlan) -> list[PlannedCell]:
    """The plan's cells by class, then algorithm, then run; the plan itself has runs outermost."""
    names = [*(each.name for each in plan.classes), *(each.name for each in plan.streams)]
    classes = {name: i for i, name in enumerate(names)}
    algorithms = {algorithm.name: i for i, algorithm in enumerate(plan.algorithms)}
    return sorted(plan.cells, key=lambda c: (classes[c.class_name], algorithms[c.algorithm], c.run))


def frame(rows: Sequence[Any], columns: str) -> pd.DataFrame:
    """A frame of tuples or dicts, with columns `name:dtype`, or `name` alone for float64."""
    dtypes = _dtypes(columns)
    return pd.DataFrame(rows, columns=list(dtypes)).astype(dtypes)


def _dtypes(columns: str) -> dict[str, str]:
    parts = (column.partition(":") for column in columns.split())
    return {name: dtype or "float64" for name, _, dtype in parts}


def window(evaluations: int) -> int:
    """How many evaluations are averaged: the paper's 10 of its 400, fewer where there are few."""
    return min(_LONGEST_WINDOW, max(1, evaluations // 10))


def _result_rows(
    cell: PlannedCell, result: CellResult, report: EvaluationReport
) -> Iterator[dict[str, Any]]:
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
            **report.extensions(index),
            **regrets,
            "region": region.name,
            "constant_similarity": references["constant_half"][index].similarity,
        }


def curve_rows(cell: PlannedCell, result: CellResult) -> Iterator[dict[str, Any]]:
    """The rows of `curves` of one run."""
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
    """The columns `RUN` of a cell."""
    return {name: getattr(cell, name) for name in RUN}


def _run_columns(result: CellResult, report: EvaluationReport) -> dict[str, Any]:
    """The columns of `_RUN`; those of offline runs only where there are any."""
    cell, offline = result.cell, result.offline
    columns = {
        **{
            name: value
            for name, value in cell.spec.every_field().items()
            if name not in ("schema_version", "seed", "team", *_EXTENSIONS)
        },
        **{name: getattr(report, name) for name in ("wd_regret", "ood_regret", "ood_decay")},
        **{name: getattr(cell, name) for name in ("uses", "action_range", "steps", "seed")},
        "final_return": _final_return(result),
        "online_regret": math.nan if result.online_regret is None else result.online_regret,
        "spec_seed": str(cell.spec.seed),
        "spec_digest": cell.spec.digest,
        "seconds": result.timing.total,
        "steps_per_second": result.timing.steps_per_second,
        "key": result.key,
    }
    for field in ("safety", "observation"):
        block = getattr(cell.spec, field)
        columns |= {} if block is None else block.to_dict()
    if cell.spec.safety is not None:
        columns["online_cost"] = math.nan if result.online_cost is None else result.online_cost
    if report.safety is not None:
        inside = report.safety.regions[0]
        columns |= {"wd_cost": inside.cost, "wd_safe_regret": inside.safe_regret}
    if report.observation is not None:
        columns["distractor_regret"] = report.distractor_regret
    if report.observation is not None and report.observation.invariance:
        columns["wd_invariance"] = report.observation.invariance[0].invariance
    for name, agent in report.agents.items():
        wd, *shells = (region.normalised_regret for region in agent.regions)
        columns |= {
            f"wd_regret/{name}": wd,
            f"ood_regret/{name}": float(np.mean(shells)) if shells else math.nan,
            f"online_regret/{name}": result.agents_online_regret.get(name, math.nan),
        }
    if offline is not None:
        columns |= offline.model_dump(exclude={"similarity", "similarity_sd"}) | {
            "offline_similarity": offline.similarity,
            "offline_similarity_sd": offline.similarity_sd,
            "improvement": offline.similarity - offline.behaviour_similarity,
        }
    return columns


def _final_return(result: CellResult) -> float:
    """Mean return over the last window of evaluations, in % of T; NaN without evaluations."""
    returns = result.curve.episode_return
    if not returns:
        return math.nan
    return 100.0 * float(np.mean(returns[-window(len(returns)) :])) / result.cell.spec.horizon
