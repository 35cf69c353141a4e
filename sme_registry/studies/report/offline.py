"""Learning from data in a study's report: the table of offline learners, and its findings.

offline           nu, learner (the same for every ν): runs; similarity and similarity_sd, means
                  over runs of `offline_similarity` and `offline_similarity_sd`; improvement,
                  the mean of r̃ minus that of the policy that made the data (0 for imitation),
                  low, high from `OFFLINE_INTERVAL` runs; verdict: above, above_few, below,
                  below_few, open; behaviour_similarity and behaviour_similarity_sd, means over
                  the data_sets; constant_similarity: of the constant ½ in WD, over runs
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import pandas as pd

from sme_registry import statistics
from sme_registry.io.markup import plural, signed
from sme_registry.spec import StudyAlgorithm
from sme_registry.statistics import Array
from sme_registry.studies.report.analysis import (
    ENOUGH_RUNS,
    OFFLINE_INTERVAL,
    Analysis,
    summary,
    table,
    training_data,
)
from sme_registry.studies.report.design import Metric
from sme_registry.studies.report.findings import THRESHOLDS, Found, Rows, finder, finding
from sme_registry.studies.report.frames import RUN
from sme_registry.training.algorithms import parse_uses

_NEAR = THRESHOLDS["near"]


@table(
    "offline",
    "class_name:str nu learner:str runs:int64 similarity similarity_sd improvement low high "
    "verdict:str behaviour_similarity behaviour_similarity_sd data_sets:int64 constant_similarity",
    optional=True,
)
def _offline(analysis: Analysis) -> Iterator[dict[str, Any]]:
    runs = analysis.offline_runs
    intervals = summary(
        runs, ["nu"], [Metric("improvement", "improvement", -1, "run")], analysis.bootstrap,
        lambda name, learner, _, nu: ("offline", learner, name, f"{nu:g}"),
        place=["class_name", "learner"], statistic=statistics.mean, fewest=OFFLINE_INTERVAL,
    )  # fmt: skip
    known = {row[:3]: row[4:] for row in intervals}
    for (name, nu), same_data in runs.groupby(["class_name", "nu"], sort=False):
        data_sets = same_data.drop_duplicates("dataset_digest")  # however many runs learnt from one
        data = {
            "behaviour_similarity": data_sets.behaviour_similarity.to_numpy().mean(),
            "behaviour_similarity_sd": data_sets.behaviour_similarity_sd.to_numpy().mean(),
            "data_sets": len(data_sets),
            "constant_similarity": same_data.constant_similarity.to_numpy().mean(),
        }
        for learner, group in same_data.groupby("learner", sort=False):
            count, improvement, low, high = known[name, learner, nu]
            yield {
                "class_name": name, "nu": nu, "learner": learner, "runs": count,
                "similarity": group.offline_similarity.to_numpy().mean(),
                "similarity_sd": group.offline_similarity_sd.to_numpy().mean(),
                "improvement": improvement, "low": low, "high": high,
                "verdict": offline_verdict(group.improvement.to_numpy(), low, high), **data,
            }  # fmt: skip


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
            for key in sorted({key for setting in alike for key in setting})
            if any(setting.get(key) != alike[0].get(key) for setting in alike)
        ]
        name = parse_uses(algorithm.uses)[1].upper()
        names[algorithm.name] = f"{name} ({', '.join(differing)})" if differing else name
    return names


@finder
def _offline_findings(analysis: Analysis) -> Found:
    """Whether each learner reaches or surpasses the policy that made its data."""
    about = functools.partial(finding, "offline")
    if analysis.tables["offline"].empty:
        return
    rows = list(analysis.tables["offline"].itertuples())
    data = training_data(analysis.runs)
    example, nu = next((name, source[0]) for name, source in data.items() if source)
    yield about(
        "example", "nu",
        f"An algorithm here is a learner with its data: {example} learnt from data of ν = {nu:g}. "
        "The behaviour policy that makes the data takes (1 − α) a* + α ã, where α is drawn from "
        "U(0, ν) at each step and ã is the action of a second network.",
        algorithm=example, value=nu,
    )  # fmt: skip
    yield _behaviour(rows)
    for name in dict.fromkeys(row.learner for row in rows):
        of_learner = [row for row in rows if row.learner == name]
        yield _imitation(name, of_learner)
        yield from _improvement(name, of_learner)
        yield from _depth(analysis, name, of_learner)
    few, most = min(row.runs for row in rows), max(row.runs for row in rows)
    verdict = "few" if few < ENOUGH_RUNS else "enough"
    text = (
        "Each result rests on its own interval, and one in twenty intervals excludes 0 by chance."
    )
    if few < ENOUGH_RUNS:
        text = f"With fewer than {ENOUGH_RUNS} runs a result is an indication at most, and with "
        text += f"fewer than {OFFLINE_INTERVAL} it has no interval."
    count = (f"{few} to " if few < most else "") + plural(most, "run")
    text = f"Each learner has {count} per class and ν. “Close” means within {_NEAR} of r̃. {text}"
    yield about("offline runs", verdict, text, runs=few)


def _behaviour(rows: Rows) -> dict[str, Any]:
    """The behaviour policies compared with 1 − ν/6, which independent uniform actions give."""
    places = list({(row.class_name, row.nu): row for row in reversed(rows)}.values())[::-1]
    off = [row.behaviour_similarity - (1.0 - row.nu / 6.0) for row in places]
    far = [row for row, difference in zip(places, off, strict=True) if abs(difference) > _NEAR]
    value, worst = max(zip(off, places, strict=True), key=lambda pair: abs(pair[0]))
    verdict, text = "near", "everywhere."
    if far:
        verdict, text = "far", (
            f"in {len(places) - len(far)} of {len(places)} cases, but not at {_places(far)}. A "
            "single second network may be closer to the optimum, or further away, than "
            "independent uniform actions are."
        )  # fmt: skip
    text = f"The behaviour policies are close to 1 − ν/6 {text}"
    largest = f"The largest difference is {signed(value, 3)} ({_at(worst)})."
    return finding("offline", "behaviour", verdict, f"{text} {largest}", value=value)


def _imitation(name: str, rows: Rows) -> dict[str, Any]:
    near = [row for row in rows if abs(row.improvement) <= _NEAR]
    farthest = max(rows, key=lambda row: abs(row.improvement))
    verdict, text = "near_at_none", f"{name} is close to the behaviour policy nowhere."
    if len(near) == len(rows):
        verdict = "imitates"
        text = f"{name} imitates: its mean is close to the behaviour policy's everywhere."
    elif near:
        verdict = "near_at_some"
        text = f"{name} is close to the behaviour policy at {_places(near)}."
    largest = f"The largest difference is {signed(farthest.improvement, 3)} ({_at(farthest)})."
    return finding(
        "offline", "imitation", verdict, f"{text} {largest}", farthest,
        algorithm=name, value=farthest.improvement,
    )  # fmt: skip


def _improvement(name: str, rows: Rows) -> Found:
    """Where a learner surpasses its data, and where it falls behind them."""
    hint, few = "A single run, which is only a hint, is", "There are indications (all of few runs)"
    begins = {
        "above": "It surpasses", "above_few": f"{few} that it surpasses",
        "below": "It falls behind", "below_few": f"{few} that it falls behind",
        "single_above": f"{hint} above",
    }  # fmt: skip
    by_verdict: dict[str, list[Any]] = {}
    for row in rows:
        if row.runs > 1:
            by_verdict.setdefault(row.verdict, []).append(row)
        elif row.improvement > _NEAR:
            by_verdict.setdefault("single_above", []).append(row)
    if not by_verdict.keys() & {"above", "above_few"}:
        text = "It was not shown to surpass its data at any ν."
        yield finding("offline", "improvement", "none", text, algorithm=name)
    for verdict, places in by_verdict.items():
        low, high = (signed(f(row.improvement for row in places), 3) for f in (min, max))
        by = low if low == high else f"{low} to {high}"
        text = f"Whether it is above or below its data is open at {_places(places)}."
        if verdict in begins:
            text = f"{begins[verdict]} its data at {_places(places)}, by {by}."
        yield finding("offline", "improvement", verdict, text, algorithm=name)


def _depth(analysis: Analysis, name: str, rows: Rows) -> Found:
    """Whether a learner collapses on the deepest class, if classes differ in depth."""
    classes = dict.fromkeys(analysis.tables["offline"].class_name)
    depth = {c: float(analysis.classes[c].setting["complexity"]) for c in classes}
    if len(set(depth.values())) < 2:
        return
    deepest = max(depth, key=lambda name: depth[name])
    about = functools.partial(finding, "offline", "depth", algorithm=name, class_name=deepest)
    rows = [row for row in rows if row.class_name == deepest]
    if not rows:
        yield about("no_runs", f"{name} has no finished run on the deepest class, {deepest}.")
        return
    collapse, reasons = THRESHOLDS["collapse"], []
    constant = [row for row in rows if row.similarity <= row.constant_similarity + _NEAR]
    below = [row for row in rows if row.improvement <= -collapse and row not in constant]
    if constant:
        reasons.append(f"at ν = {_nus(constant)} it is at most {_NEAR} better than the constant ½")
    if below:
        text = "it is better than the constant ½, but"
        reasons.append(f"at ν = {_nus(below)} {text} {collapse} or more below its data")
    lowest, runs = min(rows, key=lambda row: row.improvement), sum(row.runs for row in rows)
    verdict, does, text = "collapses", "collapses", f"{', and '.join(reasons)}."
    if any(row.runs < ENOUGH_RUNS for row in (*constant, *below)):
        text += " With so few runs this is an indication."
    if not reasons:
        verdict, does = "holds", "does not collapse"
        text = f"its mean is more than {_NEAR} above that of the constant ½ everywhere; compared "
        text += (
            f"with its data, it is {signed(lowest.improvement, 3)} at the lowest ({_at(lowest)})."
        )
    of = f"{plural(len(rows), 'value')} of ν, {plural(runs, 'run')}"
    text = f"{name} {does} on the deepest class, {deepest} ({of}): {text}"
    yield about(verdict, text, value=lowest.improvement, runs=runs)


def _at(row: Any) -> str:
    return f"{row.class_name}, ν = {row.nu:g}"


def _nus(rows: Rows) -> str:
    return ", ".join(f"{row.nu:g}" for row in rows)


def _places(rows: Rows) -> str:
    """`shallow (ν = 0, 0.5), deep (ν = 1)`."""
    grouped = itertools.groupby(rows, key=lambda row: row.class_name)
    return ", ".join(f"{name} (ν = {_nus(list(at))})" for name, at in grouped)
