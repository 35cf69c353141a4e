"""The tables of a study's streams that people read, and those that are written as CSV."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pandas as pd

from sme_registry.evaluation.retention import LABELS
from sme_registry.io.markup import fixed
from sme_registry.studies.report.streams.analysis import StreamAnalysis
from sme_registry.studies.report.streams.tables import (
    BY_VISIT,
    METRICS,
    OF_TRAINING,
    OUTSIDE,
    SCHEDULE,
    WITHIN,
)
from sme_registry.studies.report.tables import ENOUGH_RUNS, Metric
from sme_registry.studies.report.text import (
    TextTable,
    change_text,
    level_text,
    slug,
    wide,
)

CSV_TABLES = (
    "metrics", "visit_metrics", "matrices", "contrasts", "differences", "references", "regret",
    "reference_regret", "learning_curves", "counts", "missing",
)  # fmt: skip
_METRIC = {metric.key: metric for metric in (*METRICS, *BY_VISIT)}
# The same numbers in all regions.
_OF_TRAINING = tuple(metric.key for metric in OF_TRAINING)
_SHOWN_BY_VISIT = ("normalised_regret", "forgetting", "plasticity_ratio", *_OF_TRAINING)


def stream_csv(streams: StreamAnalysis) -> dict[str, pd.DataFrame]:
    """Every frame of the streams, by the name of its CSV file."""
    tables = {name: getattr(streams, name) for name in CSV_TABLES}
    return {f"stream_{name}": f for name, f in (streams.frames._asdict() | tables).items()}


def stream_tables(streams: StreamAnalysis) -> Iterator[TextTable]:
    """Metrics of each stream, differences, contrasts, and metrics by visit."""
    for name in streams.classes:
        yield _metrics(streams, name)
    for name in streams.classes:
        yield _retention(streams, name)
    for key in _SHOWN_BY_VISIT:
        yield _by_visit(streams, _METRIC[key])
    yield _differences(streams)
    yield _contrasts(streams)
    yield _counts(streams)


def _metrics(streams: StreamAnalysis, name: str) -> TextTable:
    rows = streams.metrics
    rows = rows[(rows.class_name == name) & rows.region.isin((WITHIN, OUTSIDE))]
    everywhere = rows.metric.isin(_OF_TRAINING)
    rows = rows[~everywhere | (rows.region == WITHIN)]
    rows = rows.assign(region=rows.region.mask(everywhere, ""))
    order = list(_METRIC)
    rows = rows.sort_values("metric", kind="stable", key=lambda keys: keys.map(order.index))
    labels = {key: metric.label for key, metric in _METRIC.items()}
    frame = wide(
        rows.assign(label=rows.metric.map(labels)), {"label": "metric", "region": "region"},
        "algorithm", lambda row: level_text(row, _METRIC[row.metric]), streams.algorithms,
    )  # fmt: skip
    found = streams.references[streams.references.class_name == name]
    cells = {
        (
            labels[row.metric],
            "" if row.metric in _OF_TRAINING else row.region,
            row.reference,
        ): fixed(row.value, _METRIC[row.metric].digits)
        for row in found.itertuples()
    }
    for reference in dict.fromkeys(found.reference):
        places = zip(frame["metric"], frame["region"], strict=True)
        frame[LABELS[reference]] = [cells.get((*place, reference), "") for place in places]
    return TextTable(
        f"stream-metrics-{slug(name)}",
        f"Lives in {name}",
        "IQM over lives, with its 95 % bootstrap interval, at the end of the life; the regret on "
        "the visited phase is a mean over visits, plasticity and learning transfer over those "
        "after visit 0, in which a life is a fresh agent itself. Performance is 1 − normalised "
        "regret: 1 for the optimum, 0 for the constant ½. A ratio below 1 is better than a "
        "fresh agent’s. The last columns are agents that need no training.",
        frame,
        names=2,
    )


def _retention(streams: StreamAnalysis, name: str) -> TextTable:
    rows = streams.matrices
    rows = rows[(rows.class_name == name) & (rows.region == WITHIN)]
    phases = len(streams.classes[name].stream.phases)
    after = rows.visit.map(
        lambda visit: "initial" if pd.isna(visit) else f"visit {visit} (phase {visit % phases})"
    )
    rows = rows.assign(after=after, column="phase " + rows.phase.astype(str))
    regret = Metric("normalised_regret", "", 1)
    return TextTable(
        f"stream-retention-{slug(name)}",
        f"Retention in {name}",
        "Normalised regret within distribution on the task of each phase, of the policy before "
        "training and at the end of each visit. IQM over lives, with its 95 % bootstrap interval.",
        wide(rows, {"algorithm": "algorithm", "after": "policy"}, "column",
             lambda row: level_text(row, regret)),
        names=2,
    )  # fmt: skip


def _by_visit(streams: StreamAnalysis, metric: Metric) -> TextTable:
    rows = streams.visit_metrics
    rows = rows[(rows.region == WITHIN) & (rows.metric == metric.key)]
    at = rows.visit.astype(str) + " (phase " + rows.phase.astype(str) + ")"
    return TextTable(
        f"stream-visits-{metric.key.replace('_', '-')}",
        f"{metric.label[0].upper()}{metric.label[1:]} by visit",
        "IQM over lives, with its 95 % bootstrap interval"
        + ("." if metric.key in _OF_TRAINING else ", within distribution."),
        wide(
            rows.assign(at=at), {"class_name": "stream", "at": "visit"}, "algorithm",
            lambda row: level_text(row, metric), streams.algorithms,
        ),
        names=2,
    )  # fmt: skip


def _differences(streams: StreamAnalysis) -> TextTable:
    rows = streams.differences
    rows = rows.assign(
        pair=rows["first"] + " − " + rows["second"],
        label=rows.metric.map({metric.key: metric.label for metric in METRICS}),
    )
    return TextTable(
        "stream-differences",
        "Differences between algorithms in streams",
        "IQM over pairs of lives in the same draw of the stream with the same seed, within "
        "distribution, with its 95 % bootstrap interval. *: the first algorithm is worse, †: "
        f"better, by an interval that excludes 0 and rests on at least {ENOUGH_RUNS} pairs.",
        wide(
            rows, {"class_name": "stream", "label": "metric"}, "pair",
            lambda row: change_text(row, row.difference, _METRIC[row.metric].digits),
        ),
        names=2,
    )  # fmt: skip


def _contrasts(streams: StreamAnalysis) -> TextTable:
    rows = streams.contrasts
    label = rows.metric.map({metric.key: metric.label for metric in METRICS})
    note = (
        "IQM over pairs of lives with the same number, within distribution, with the 95 % "
        "bootstrap interval of the change. *: worse, †: better, by an interval that excludes 0 and "
        "rests on enough pairs."
    )
    others = [name for name, info in streams.classes.items() if info.axis == SCHEDULE]
    if others:
        note += (
            f" The schedule of {', '.join(others)} differs from that of {streams.base}, so the "
            "change is not one of the tasks alone."
        )
    return TextTable(
        "stream-contrasts",
        f"Change from the stream {streams.base}",
        note,
        wide(
            rows.assign(label=label), {"class_name": "stream", "label": "metric"}, "algorithm",
            lambda row: change_text(row, row.change, _METRIC[row.metric].digits),
            streams.algorithms,
        ),
        names=2,
    )  # fmt: skip


def _counts(streams: StreamAnalysis) -> TextTable:
    def entry(row: Any) -> str:
        failed = f", {row.failed} failed" if row.failed else ""
        lives = f"{row.lives} of {row.planned_lives}"
        return f"{lives}, {row.fresh_agents} of {row.planned_fresh_agents}{failed}"

    return TextTable(
        "stream-counts",
        "Finished lives and fresh agents",
        "Lives, then the fresh agents with which their plasticity is compared. A life whose fresh "
        "agents are missing has no plasticity and no learning transfer, and all other numbers.",
        wide(streams.counts, {"class_name": "stream"}, "algorithm", entry),
    )
