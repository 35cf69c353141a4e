"""Findings of a study's streams: what is forgotten, is plasticity lost, what relatedness changes.

They follow from metrics of whole lives within distribution. A number counts if its 95 % interval
excludes the neutral value, 1 for a plasticity ratio and 0 for all others; it is an indication if it
rests on fewer than `ENOUGH_RUNS` lives, and open otherwise, which does not mean that there is no
effect. `templates/streams.jinja` has the words.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Literal

from sme_registry.diagnosis.questions import THRESHOLDS as DIAGNOSIS
from sme_registry.spec import Integer, Real, StrictModel, TupleOf
from sme_registry.studies.report.streams.analysis import StreamAnalysis
from sme_registry.studies.report.streams.tables import TASKS, WITHIN
from sme_registry.studies.report.tables import ENOUGH_RUNS

__all__ = ["LifeFinding", "LifeMetric", "StreamChange", "StreamFinding", "StreamFindings"]

UNLEARNT = DIAGNOSIS["unlearnt"]
_CONTRASTED = ("forgetting", "plasticity_ratio", "forward_transfer", "learning_transfer")

Verdict = Literal["above", "below", "open"]
Forgetting = Literal["forgets", "indication", "open", "none", "unlearnt"]


class LifeMetric(StrictModel):
    """A metric of the lives of one algorithm in one stream."""

    value: Real  # IQM over lives
    low: Real | None  # of its 95 % interval; None for a single life
    high: Real | None
    runs: Integer  # lives that have it
    enough_runs: bool
    verdict: Verdict  # on which side of the neutral value the interval lies


class LifeFinding(StrictModel):
    """The lives of one algorithm in one stream."""

    algorithm: str
    runs: Integer
    visited_regret: LifeMetric
    unlearnt: bool  # whether almost nothing was learnt in the visits: there is little to forget
    forgetting: LifeMetric | None  # None for a single visit
    forward_transfer: LifeMetric | None  # None without an initial policy, or with one phase
    # None unless all fresh agents of a life have finished, and for a single visit.
    plasticity_ratio: LifeMetric | None
    last_plasticity_ratio: LifeMetric | None  # in the last visit
    learning_transfer: LifeMetric | None


class Difference(StrictModel):
    """By how much the algorithm that forgets most forgets more than another one."""

    algorithm: str  # the other one
    change: Real  # IQM of the differences of paired lives
    low: Real | None
    high: Real | None
    pairs: Integer
    verdict: Literal["more", "indication", "open"]


class StreamFinding(StrictModel):
    """A stream: the lives of each algorithm, and which of them forget."""

    class_name: str
    lives: TupleOf[LifeFinding]  # by forgetting, the most first
    # Whether any of them forgets. If not: "none" if that was shown for each of them, and "unlearnt"
    # if none learnt anything that it could forget.
    forgetting: Forgetting
    rivals: TupleOf[Difference]  # the others with paired lives
    without_fresh: Integer  # lives without all of their fresh agents
    single_visit: bool  # a life has one, so it is a fresh agent itself and has no plasticity


class StreamChange(StrictModel):
    """What a stream changes for an algorithm, compared with the first stream; a contrast."""

    class_name: str
    # Whether its phases are rotations of one task, and those of the first stream are the same kind
    # of task, but unrelated.
    related: bool
    algorithm: str
    metric: str
    base: Real
    level: Real
    change: Real
    low: Real | None
    high: Real | None
    pairs: Integer
    enough_pairs: bool
    verdict: Literal["worse", "better", "open"]


class StreamFindings(StrictModel):
    """What a study found in its streams."""

    base: str  # the first stream, with which the others are contrasted
    streams: TupleOf[StreamFinding]
    # Of streams that differ from the first in their tasks alone.
    changes: TupleOf[StreamChange]
    planned: Integer  # runs: lives and fresh agents
    missing: Integer
    failed: Integer  # of those missing
    fewest_runs: Integer | None  # lives of an algorithm in a stream; None without lives
    draws_repeat: bool  # whether several lives of an algorithm share a draw of a stream


def stream_findings(streams: StreamAnalysis) -> StreamFindings:
    """The findings of a study's streams, from their tables."""
    lives = streams.frames.lives
    lives = lives[lives.region == WITHIN]
    places = lives.groupby(["class_name", "algorithm"])
    failed = streams.missing[streams.missing.error != ""]
    return StreamFindings(
        base=streams.base,
        streams=tuple(
            _stream(streams, name) for name in streams.classes if name in set(lives.class_name)
        ),
        changes=tuple(_changes(streams)),
        planned=streams.requested,
        missing=streams.requested - streams.finished,
        failed=failed.key.nunique(),
        fewest_runs=None if lives.empty else int(places.size().min()),
        draws_repeat=bool((places.stream_digest.nunique() < places.size()).any()),
    )


def _stream(streams: StreamAnalysis, name: str) -> StreamFinding:
    found = [_life(streams, name, algorithm) for algorithm in streams.algorithms]
    lives = sorted((life for life in found if life is not None), key=_forgotten, reverse=True)
    lived = [life for life in streams.lives if life.planned.class_name == name]
    return StreamFinding(
        class_name=name,
        lives=tuple(lives),
        forgetting=_forgets(lives),
        rivals=tuple(_rivals(streams, name, lives)),
        without_fresh=sum(life.fresh_agents < len(life.planned.cell.fresh) for life in lived),
        single_visit=streams.classes[name].stream.visits == 1,
    )


def _forgotten(life: LifeFinding) -> float:
    return -math.inf if life.forgetting is None else life.forgetting.value


def _forgets(lives: list[LifeFinding]) -> Forgetting:
    found = [life.forgetting for life in lives if life.forgetting is not None]
    above = [metric for metric in found if metric.verdict == "above"]
    if above:
        return "forgets" if any(metric.enough_runs for metric in above) else "indication"
    if found and all(life.unlearnt for life in lives):
        return "unlearnt"
    return "none" if all(map(_is_none, found)) else "open"


def _is_none(metric: LifeMetric) -> bool:
    """Whether a life was shown to forget nothing."""
    nothing = metric.verdict == "below" or metric.low == metric.high == 0.0
    return metric.enough_runs and nothing


def _life(streams: StreamAnalysis, name: str, algorithm: str) -> LifeFinding | None:
    rows = streams.metrics
    rows = rows[(rows.class_name == name) & (rows.algorithm == algorithm) & (rows.region == WITHIN)]
    metrics = {row.metric: _metric(row) for row in rows.itertuples()}
    if not metrics:
        return None
    visits = streams.visit_metrics
    visits = visits[
        (visits.class_name == name) & (visits.algorithm == algorithm) & (visits.region == WITHIN)
    ]
    last = visits[(visits.visit == visits.visit.max()) & (visits.metric == "plasticity_ratio")]
    visited = metrics["visited_regret"]
    return LifeFinding(
        algorithm=algorithm,
        runs=visited.runs,
        visited_regret=visited,
        unlearnt=visited.value >= UNLEARNT,
        last_plasticity_ratio=next(map(_metric, last.itertuples()), None),
        **{
            key: metrics.get(key)
            for key in ("forgetting", "forward_transfer", "plasticity_ratio", "learning_transfer")
        },
    )


def _metric(row: Any) -> LifeMetric:
    neutral = 1.0 if row.metric == "plasticity_ratio" else 0.0
    verdict: Verdict = "open"
    if row.low > neutral:
        verdict = "above"
    elif row.high < neutral:
        verdict = "below"
    return LifeMetric(
        value=row.iqm,
        low=_known(row.low),
        high=_known(row.high),
        runs=row.runs,
        enough_runs=row.runs >= ENOUGH_RUNS,
        verdict=verdict,
    )


def _rivals(streams: StreamAnalysis, name: str, lives: list[LifeFinding]) -> Iterable[Difference]:
    """The paired differences of the algorithm that forgets most from each other one."""
    rows = streams.differences
    rows = rows[(rows.class_name == name) & (rows.metric == "forgetting")]
    for life in lives[1:]:
        pair = {lives[0].algorithm, life.algorithm}
        for row in rows.itertuples():
            if {row.first, row.second} != pair:
                continue
            change, low, high = row.difference, row.low, row.high
            if row.first != lives[0].algorithm:
                change, low, high = -change, -high, -low
            verdict: Literal["more", "indication", "open"] = "open"
            if low > 0.0:
                verdict = "more" if row.enough_pairs else "indication"
            yield Difference(
                algorithm=life.algorithm, change=change, low=_known(low), high=_known(high),
                pairs=row.pairs, verdict=verdict,
            )  # fmt: skip


def _changes(streams: StreamAnalysis) -> Iterable[StreamChange]:
    rows = streams.contrasts
    rows = rows[(rows.axis == TASKS) & rows.metric.isin(_CONTRASTED)].drop(columns="axis")
    base = streams.classes[streams.base]
    for row in rows.astype(object).to_dict("records"):
        ends = {"low": _known(row["low"]), "high": _known(row["high"])}
        info = streams.classes[row["class_name"]]
        related = info.related and not base.related and info.stream.kinds == base.stream.kinds
        yield StreamChange(**{**row, **ends}, related=related)


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value
