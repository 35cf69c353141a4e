"""A study's frames as files: every number as CSV, and the tables that people read as LaTeX.

`text` has the building blocks of the latter. `tables` documents the columns of the CSV files.
"""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

from sme_registry.io.markup import fixed, signed
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.offline_tables import OFFLINE_INTERVAL
from sme_registry.studies.report.streams.texts import stream_csv, stream_tables
from sme_registry.studies.report.tables import AGENT_METRICS, ENOUGH_RUNS, Metric
from sme_registry.studies.report.text import (
    TextTable,
    change_text,
    level_text,
    slug,
    wide,
    with_interval,
)

CSV_TABLES = (
    "results", "curves", "counts", "missing", "contrasts", "levels", "regions", "aggregates",
    "profiles", "improvements", "differences", "learning_curves",
)  # fmt: skip
_STATISTICS = {"iqm": "IQM", "median": "median", "optimality_gap": "optimality gap"}
_REGIONS = {"wd_regret": "WD", "ood_regret": "OOD"}


def csv_tables(analysis: Analysis) -> dict[str, str]:
    """Every frame of the study as CSV, by name; floats read back as they are."""
    optional = {
        "offline": analysis.has_offline_runs,
        "agents": analysis.has_teams,
        "layers": not analysis.layers.empty,
    }
    names = [*CSV_TABLES, *(name for name, present in optional.items() if present)]
    frames = {name: getattr(analysis, name) for name in names if analysis.classes}
    if analysis.streams is not None:
        frames |= stream_csv(analysis.streams)
    return {name: f.to_csv(index=False, lineterminator="\n") for name, f in frames.items()}


def text_tables(analysis: Analysis) -> list[TextTable]:
    """What people read: settings down, algorithms across. Tables without rows are left out."""
    tables = [
        *(_task_tables(analysis) if analysis.algorithms else ()),
        *(stream_tables(analysis.streams) if analysis.streams is not None else ()),
    ]
    return [table for table in tables if not table.frame.empty]


def _task_tables(analysis: Analysis) -> list[TextTable]:
    return [
        *(offline_tables(analysis) if analysis.has_offline_runs else ()),
        *(_levels(analysis, metric) for metric in analysis.metrics),
        _layers(analysis),
        *(_agents(analysis, metric) for metric in AGENT_METRICS),
        *(_differences(analysis, metric) for metric in analysis.metrics),
        *(_contrasts(analysis, metric) for metric in analysis.metrics),
        *(_regions(analysis, name) for name in analysis.algorithms),
        _aggregates(analysis),
        _improvements(analysis),
        _counts(analysis),
    ]


def offline_tables(analysis: Analysis) -> list[TextTable]:
    """The behaviour policies next to the learners, and the differences."""
    rows = analysis.offline.assign(nu=analysis.offline.nu.map("{:g}".format))
    at = {"class_name": "class", "nu": "ν"}
    similarity = wide(
        rows, at, "learner", lambda row: _mean(row.similarity, row.similarity_sd, row.runs)
    )
    data = rows.drop_duplicates(["class_name", "nu"])
    constant = [fixed(row.constant_similarity, 3) for row in data.itertuples()]
    behaviour = [
        _mean(row.behaviour_similarity, row.behaviour_similarity_sd, row.data_sets)
        for row in data.itertuples()
    ]
    similarity.insert(2, "constant ½", constant)
    similarity.insert(3, "behaviour policy", behaviour)
    return [
        TextTable(
            "offline",
            "Learning from data: mean similarity r̃",
            "Mean over runs ± the standard deviation over steps (its mean over runs); in brackets "
            "the number of runs, or of the behaviour policy's data sets. The constant ½ is "
            "evaluated within distribution.",
            similarity,
            names=2,
        ),
        TextTable(
            "offline-improvement",
            "Learning from data: r̃ minus the behaviour policy's",
            f"Mean over runs, with its 95 % bootstrap interval from {OFFLINE_INTERVAL} runs on. "
            "†: above its data, *: below, by an interval that excludes 0 and rests on at least "
            f"{ENOUGH_RUNS} runs.",
            wide(rows, at, "learner", _improvement),
            names=2,
        ),
    ]


def _levels(analysis: Analysis, metric: Metric) -> TextTable:
    rows = analysis.levels[analysis.levels.metric == metric.key]

    return TextTable(
        f"levels-{metric.key.replace('_', '-')}",
        f"{metric.label[0].upper()}{metric.label[1:]} by class",
        "IQM over runs, with its 95 % bootstrap interval.",
        wide(
            rows, {"class_name": "class"}, "algorithm", lambda row: level_text(row, metric),
            analysis.algorithms,
        ),
    )  # fmt: skip


def _layers(analysis: Analysis) -> TextTable:
    layer = analysis.layers.layer.map(str).replace("0", "observation")
    return TextTable(
        "layers",
        "What the layers keep",
        "Held-out R² of a linear map from a layer's outputs to the state and, after the comma, to "
        "the distractors where there are any; IQM over runs, in the training cube.",
        wide(
            analysis.layers.assign(layer=layer), {"class_name": "class", "layer": "layer"},
            "algorithm", _kept, analysis.algorithms,
        ),
        names=2,
    )  # fmt: skip


def _kept(row: Any) -> str:
    kept = row.state_r2, row.distractor_r2
    return ", ".join(fixed(value) for value in kept if not math.isnan(value))


def _agents(analysis: Analysis, metric: Metric) -> TextTable:
    rows = analysis.agents[analysis.agents.metric == metric.key]

    return TextTable(
        f"agents-{metric.key.replace('_', '-')}",
        f"{metric.label[0].upper()}{metric.label[1:]} of each agent",
        "IQM over runs, with its 95 % bootstrap interval, over the action channels that the agent "
        "owns.",
        wide(
            rows, {"class_name": "class", "agent": "agent"}, "algorithm",
            lambda row: level_text(row, metric), analysis.algorithms,
        ),
        names=2,
    )  # fmt: skip


def _differences(analysis: Analysis, metric: Metric) -> TextTable:
    first = analysis.algorithms[0]
    rows = analysis.differences[analysis.differences["first"] == first]
    return difference_table(rows[rows.metric == metric.key], metric)


def difference_table(rows: pd.DataFrame, metric: Metric, *, levels: bool = False) -> TextTable:
    """Paired differences of one metric: classes down, pairs of algorithms across."""
    rows = rows.assign(pair=rows["first"] + " − " + rows["second"])
    pairs = list(dict.fromkeys(rows.pair))
    between = pairs[0] if len(pairs) == 1 else f"{''.join(rows['first'][:1])} minus each other"
    name = f"differences-{metric.key.replace('_', '-')}"
    frame = wide(
        rows, {"class_name": "class"}, "pair",
        lambda row: change_text(row, row.difference, metric.digits + 1),
    )  # fmt: skip
    for place, side in enumerate(("first", "second")) if levels else ():
        texts = [fixed(value, metric.digits + 1) for value in rows[f"{side}_level"]]
        frame.insert(1 + place, rows[side].iloc[0], texts)
    note = (
        "IQM over pairs of runs on the same instance with the same seed, with its 95 % bootstrap "
        "interval. *: the first algorithm is worse, †: better, by an interval that excludes 0 and "
        f"rests on at least {ENOUGH_RUNS} pairs."
    )
    return TextTable(
        name,
        f"Difference of {metric.label}, {between}",
        " ".join([note, *difference_caveats(rows)]),
        frame,
        label=f"{name}-{slug(pairs[0])}" if levels else "",
    )


def difference_caveats(rows: pd.DataFrame) -> list[str]:
    """A sentence for each reason why intervals of paired differences say less than 95 %."""
    caveats = []
    if not rows.enough_pairs.all():
        caveats.append(
            f"With fewer than {ENOUGH_RUNS} pairs on a class, an interval covers the true "
            "difference in far fewer than 95 % of cases: it is an indication only."
        )
    if (rows.pairs > rows.instances).any():
        caveats.append(
            "Several pairs share an instance: such runs are not independent draws of the task, so "
            "the interval is too narrow for other instances."
        )
    return caveats


def _contrasts(analysis: Analysis, metric: Metric) -> TextTable:
    rows = analysis.contrasts[analysis.contrasts.metric == metric.key]
    frame = wide(
        rows, {"class_name": "class"}, "algorithm",
        lambda row: change_text(row, row.change, metric.digits), analysis.algorithms,
    )  # fmt: skip
    frame.insert(1, "setting", [analysis.classes[name].label for name in frame["class"]])
    return TextTable(
        f"contrasts-{metric.key.replace('_', '-')}",
        f"Change of {metric.label}, from the class {analysis.base}",
        "IQM over pairs of runs, with the 95 % bootstrap interval of the change. "
        "*: worse, †: better, by an interval that excludes 0 and rests on enough pairs.",
        frame,
        names=2,
    )


def _regions(analysis: Analysis, algorithm: str) -> TextTable:
    rows = analysis.regions[analysis.regions.algorithm == algorithm]
    return TextTable(
        f"regions-{slug(algorithm)}",
        f"Similarity r̃ of {algorithm} by region",
        "IQM over runs; 1 is the optimum. In brackets the normalised regret: 0 for the optimum, 1 "
        "for the constant ½.",
        wide(
            rows,
            {"class_name": "class"},
            "region",
            lambda row: f"{row.similarity:.3f} ({row.normalised_regret:.2f})",
        ),
    )


def _aggregates(analysis: Analysis) -> TextTable:
    rows = analysis.aggregates.replace({"metric": _REGIONS, "statistic": _STATISTICS})
    at = {"group": "classes", "metric": "region", "statistic": "statistic"}
    return TextTable(
        "aggregates",
        "Aggregates of 1 − normalised regret",
        "Means over classes of a statistic over runs, with 95 % stratified bootstrap intervals. "
        "For the optimality gap less is better.",
        wide(rows, at, "algorithm", lambda row: with_interval(row.value, row)),
        names=3,
    )


def _improvements(analysis: Analysis) -> TextTable:
    rows = analysis.improvements.replace({"metric": _REGIONS})
    rows = rows.assign(comparison=rows["first"] + " over " + rows["second"])
    at = {"group": "classes", "comparison": "comparison"}
    return TextTable(
        "improvements",
        "Probability of improvement",
        "That a run of the first algorithm beats one of the second, on a class drawn at random.",
        wide(rows, at, "metric", lambda row: with_interval(row.probability, row)),
        names=2,
    )


def _counts(analysis: Analysis) -> TextTable:
    def entry(row: Any) -> str:
        failed = f", {row.failed} failed" if row.failed else ""
        return f"{row.done} of {row.planned}{failed}"

    return TextTable(
        "counts",
        "Finished runs",
        "Missing runs are part of no other number.",
        wide(analysis.counts, {"class_name": "class"}, "algorithm", entry),
    )


def _improvement(row: Any) -> str:
    count = "" if row.runs >= ENOUGH_RUNS else f" (n = {row.runs})"
    mark = {"above": " †", "below": " *"}.get(row.verdict, "")
    return with_interval(row.improvement, row, 3, signed) + count + mark


def _mean(value: float, sd: float, runs: int) -> str:
    return f"{fixed(value, 3)} ± {fixed(sd, 3)} ({runs})"
