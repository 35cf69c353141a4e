"""Tables of the runs that learnt from data: how good the data were, and what was learnt from them.

The improvement of a run is its r̃ minus the r̃ of the policy that made its data: 0 for imitation.

`offline_runs` has one row per run: the columns of `frames`, `learner`, and `constant_similarity` in
WD. `offline` has one row per class × ν × learner:

    class_name, nu, learner      the learner's name is the same for every ν
    runs                         number of runs
    similarity, similarity_sd    mean over runs of `offline_similarity`, `offline_similarity_sd`
    improvement, low, high       mean over runs, and its 95 % interval from `OFFLINE_INTERVAL` runs
    verdict                      above, above_few, below, below_few, open: see `offline_verdict`
    behaviour_similarity, behaviour_similarity_sd    mean over the data sets
    data_sets                    number of data sets
    constant_similarity          mean r̃ of the constant ½ in WD, over runs
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from sme_registry import statistics
from sme_registry.spec import StudyAlgorithm
from sme_registry.statistics import Array
from sme_registry.studies.report.frames import RUN, frame
from sme_registry.studies.report.tables import ENOUGH_RUNS, Bootstrap

OFFLINE_INTERVAL = 4  # with fewer runs a mean improvement has no interval at all


def offline_runs(results: pd.DataFrame, algorithms: Sequence[StudyAlgorithm]) -> pd.DataFrame:
    """One row per run of an offline learner, ordered by class, ν, learner and run."""
    names = learner_names(algorithms)
    rows = results[results.nu.notna()].drop_duplicates(RUN)
    rows = rows.assign(learner=rows.algorithm.map(names))
    order = {"class_name": list(dict.fromkeys(rows.class_name)),
             "learner": list(dict.fromkeys(names.values()))}  # fmt: skip

    def key(column: pd.Series) -> pd.Series:
        return column.map(order[column.name].index) if column.name in order else column

    return rows.sort_values(["class_name", "nu", "learner", "run"], key=key, ignore_index=True)


def offline(runs: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """Each offline learner on each class at each ν, from `offline_runs`."""
    rows = []
    for (class_name, nu), same_data in runs.groupby(["class_name", "nu"], sort=False):
        data_sets = same_data.drop_duplicates("dataset_digest")  # however many runs learnt from one
        data = {
            "behaviour_similarity": data_sets.behaviour_similarity.to_numpy().mean(),
            "behaviour_similarity_sd": data_sets.behaviour_similarity_sd.to_numpy().mean(),
            "data_sets": len(data_sets),
            "constant_similarity": same_data.constant_similarity.to_numpy().mean(),
        }
        for learner, group in same_data.groupby("learner", sort=False):
            changes = group.improvement.to_numpy()
            low = high = math.nan
            if len(changes) >= OFFLINE_INTERVAL:
                place = "offline", learner, class_name, f"{nu:g}"
                low, high = bootstrap.interval(changes, *place, statistic=statistics.mean)
            rows.append({
                "class_name": class_name, "nu": nu, "learner": learner, "runs": len(group),
                "similarity": group.offline_similarity.to_numpy().mean(),
                "similarity_sd": group.offline_similarity_sd.to_numpy().mean(),
                "improvement": changes.mean(), "low": low, "high": high,
                "verdict": offline_verdict(changes, low, high), **data,
            })  # fmt: skip
    return frame(
        rows,
        "class_name:str nu learner:str runs:int64 similarity similarity_sd improvement low high "
        "verdict:str behaviour_similarity behaviour_similarity_sd data_sets:int64 "
        "constant_similarity",
    )


def offline_verdict(improvements: Array, low: float, high: float) -> str:
    """Whether a learner surpasses its data, from the improvements of its runs."""
    if len(improvements) >= ENOUGH_RUNS:
        return "above" if low > 0.0 else "below" if high < 0.0 else "open"
    if len(improvements) > 1 and improvements.min() > 0.0:
        return "above_few"
    return "below_few" if len(improvements) > 1 and improvements.max() < 0.0 else "open"


def learner_names(algorithms: Sequence[StudyAlgorithm]) -> dict[str, str]:
    """What each algorithm of a plan is apart from its ν: `IQL`, or `IQL (expectile = 0.9)`."""
    settings = {
        algorithm.name: {k: v for k, v in algorithm.hyperparameters.items() if k != "nu"}
        | ({} if algorithm.steps is None else {"steps": algorithm.steps})
        for algorithm in algorithms
    }
    names = {}
    for algorithm in algorithms:
        alike = [settings[other.name] for other in algorithms if other.uses == algorithm.uses]
        options = settings[algorithm.name]
        differing = [
            f"{key} = {options[key]}" if key in options else f"default {key}"
            for key in sorted({key for each in alike for key in each})
            if any(each.get(key) != alike[0].get(key) for each in alike)
        ]
        name = algorithm.uses.removeprefix("offline:").upper()
        names[algorithm.name] = f"{name} ({', '.join(differing)})" if differing else name
    return names
