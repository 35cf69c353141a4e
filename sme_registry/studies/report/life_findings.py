"""Findings of a study's streams: what is forgotten, is plasticity lost, and what transfers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sme_registry.io.markup import fixed, plural
from sme_registry.studies.report.analysis import ENOUGH_RUNS, Analysis
from sme_registry.studies.report.classes import TASKS
from sme_registry.studies.report.lives import WITHIN
from sme_registry.studies.report.sentences import (
    THRESHOLDS,
    Found,
    between,
    change_text,
    ends_text,
    few_runs,
    finding,
    lives_text,
    missing_runs,
    numbers_of,
)

_CONTRASTED = {
    "forgetting": "forgetting",
    "plasticity_ratio": "the plasticity ratio",
    "forward_transfer": "forward transfer",
    "learning_transfer": "learning transfer",
}

Rows = Sequence[Any]  # of a table, as named tuples


def stream_findings(analysis: Analysis) -> Found:
    """What is found in each stream, what its relatedness changes, and what limits that."""
    yield from _lives(analysis)
    yield from _changes(analysis)
    yield from _caveats(analysis)


def _lives(analysis: Analysis) -> Found:
    rows = analysis.tables["stream_metrics"]
    rows = rows[rows.region == WITHIN]
    for name, info in analysis.streams.items():
        lives: dict[str, dict[str, Any]] = {}
        for row in rows[rows.class_name == name].itertuples():
            lives.setdefault(row.algorithm, {})[row.metric] = row
        if not lives:
            continue
        metrics = [of_life["forgetting"] for of_life in lives.values() if "forgetting" in of_life]
        metrics.sort(key=lambda row: row.iqm, reverse=True)
        unlearnt = [
            of_life["visited_regret"].iqm >= THRESHOLDS["unlearnt"] for of_life in lives.values()
        ]
        yield from _forgets(analysis, name, metrics, unlearnt=all(unlearnt))
        order = [row.algorithm for row in metrics] or list(lives)
        for algorithm in order:
            yield from _life(analysis, lives[algorithm], single_visit=info.stream.visits == 1)
        incomplete = sum(
            life.planned.class_name == name and life.fresh_agents < len(life.planned.cell.fresh)
            for life in analysis.lives
        )
        if incomplete:
            have = plural(incomplete, "life has", "lives have")
            yield finding(
                "streams", "fresh agents", "missing", class_name=name, value=incomplete, lives=have
            )


def _forgets(analysis: Analysis, name: str, metrics: Rows, *, unlearnt: bool) -> Found:
    """Whether any agent forgets in a stream, and whether one forgets most."""
    if not metrics:
        yield finding("streams", "forgets", "single_visit", class_name=name)
        return
    verdict, first = _forgetting(metrics, unlearnt=unlearnt)
    rivals = list(_rivals_in(analysis, name, metrics))
    certain = first is metrics[0] and rivals and all(r["verdict"] == "more" for r in rivals)
    yield finding(
        "streams", "forgets", verdict, **numbers_of(first), most=" most" if certain else "",
        interval=lives_text(first),
    )  # fmt: skip
    if verdict in ("forgets", "indication"):
        if first is not metrics[0]:
            about = numbers_of(metrics[0])
            yield finding(
                "streams", "largest forgetting", "open", **about, interval=lives_text(metrics[0])
            )
        yield from rivals


def _forgetting(metrics: Rows, *, unlearnt: bool) -> tuple[str, Any]:
    """The verdict on a stream, and the agent of which its sentence speaks."""
    above = [row for row in metrics if row.low > 0.0]
    if above:
        certain = [row for row in above if row.runs >= ENOUGH_RUNS]
        return ("forgets", certain[0]) if certain else ("indication", above[0])
    if unlearnt:
        return "unlearnt", metrics[0]
    # Shown for each of them: the whole interval is not above 0.
    none = all(
        row.runs >= ENOUGH_RUNS and (row.high < 0.0 or row.low == row.high == 0.0)
        for row in metrics
    )
    return "none" if none else "open", metrics[0]


def _rivals_in(analysis: Analysis, name: str, metrics: Rows) -> Found:
    """The paired differences of the agent that forgets most from each other one."""
    rows = analysis.tables["stream_differences"]
    rows = rows[(rows.class_name == name) & (rows.metric == "forgetting")]
    most = metrics[0].algorithm
    for other in metrics[1:]:
        for row in rows.itertuples():
            if {row.first, row.second} != {most, other.algorithm}:
                continue
            numbers = {"value": row.difference, "low": row.low, "high": row.high}
            if row.first != most:
                numbers = {"value": -row.difference, "low": -row.high, "high": -row.low}
            enough = "more" if row.enough_pairs else "indication"
            yield finding(
                "streams", "forgets more", enough if numbers["low"] > 0.0 else "open",
                algorithm=most, class_name=name, runs=row.pairs, **numbers, other=other.algorithm,
                interval=between(**numbers),
            )  # fmt: skip


def _life(analysis: Analysis, metrics: dict[str, Any], *, single_visit: bool) -> Found:
    """What one agent learns, forgets and transfers in a stream."""
    visited = metrics["visited_regret"]
    about = {"algorithm": visited.algorithm, "class_name": visited.class_name}
    unlearnt = visited.iqm >= THRESHOLDS["unlearnt"]
    yield finding(
        "streams", "life", "unlearnt" if unlearnt else "learnt", **numbers_of(visited),
        lives=plural(visited.runs, "life", "lives"),
    )  # fmt: skip
    for key, neutral in (("forgetting", 0.0), ("plasticity_ratio", 1.0), ("forward_transfer", 0.0)):
        question, row = key.replace("_ratio", "").replace("_", " "), metrics.get(key)
        if row is not None:
            verdict = "above" if row.low > neutral else "below" if row.high < neutral else "open"
            yield finding(
                "streams", question, verdict, **numbers_of(row), interval=lives_text(row),
                few="" if row.runs >= ENOUGH_RUNS else " (an indication)",
                than_fresh=_than_fresh(analysis, row) if neutral else "",
            )  # fmt: skip
        elif neutral:
            verdict = "single_visit" if single_visit else "unknown"
            yield finding("streams", question, verdict, **about)


def _than_fresh(analysis: Analysis, row: Any) -> str:
    """How the regret of a life compares with that of fresh agents, over visits and in the last."""
    visits = analysis.tables["stream_visit_metrics"]
    at = (visits.class_name == row.class_name) & (visits.algorithm == row.algorithm)
    visits = visits[at & (visits.region == WITHIN)]
    last = visits[(visits.visit == visits.visit.max()) & (visits.metric == "plasticity_ratio")]
    text = (
        ": after a visit other than the first, its regret on the phase is "
        f"{fixed(row.iqm)} times a fresh agent’s{lives_text(row)}"
    )
    for each in last.itertuples():
        text += f", and {fixed(each.iqm)} times in the last visit{ends_text(each)}"
    return text


def _changes(analysis: Analysis) -> Found:
    """What streams that differ from the first in their tasks alone change for each algorithm."""
    rows = analysis.tables["stream_contrasts"]
    rows = rows[(rows.axis == TASKS) & rows.metric.isin(_CONTRASTED)]
    base = analysis.streams[analysis.stream_base]
    for name, of_class in rows.groupby("class_name", sort=False):
        info = analysis.streams[name]
        related = info.related and not base.related and info.stream.kinds == base.stream.kinds
        yield finding(
            "stream_changes", "relatedness", "related" if related else "other", class_name=name,
            first=base.name,
        )  # fmt: skip
        for row in of_class.itertuples():
            few = "" if row.enough_pairs or row.verdict == "open" else "_few"
            change = f"{fixed(row.base)} → {fixed(row.level)}, by {change_text(row)}"
            yield finding(
                "stream_changes", "change", row.verdict + few, algorithm=row.algorithm,
                **numbers_of(row), metric=_CONTRASTED[row.metric], change=change,
            )  # fmt: skip


def _caveats(analysis: Analysis) -> Found:
    missing, lives = analysis.tables["stream_missing"], analysis.tables["stream_lives"]
    failed = missing[missing.error != ""].key.nunique()
    finished = len(analysis.stream_cells & analysis.cells.keys())
    absent = analysis.missing_in_streams
    yield from missing_runs("stream_caveats", absent, finished + absent, failed)
    places = lives[lives.region == WITHIN].groupby(["class_name", "algorithm"])
    if len(places) and places.size().min() < ENOUGH_RUNS:
        yield few_runs("stream_caveats", int(places.size().min()), "life", "lives")
    if (places.stream_digest.nunique() < places.size()).any():
        yield finding("stream_caveats", "draws", "repeat")
