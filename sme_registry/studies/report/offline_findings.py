"""Findings on learning from data: does a learner reach or surpass the policy that made its data?

The improvement of a run is its mean similarity r̃ minus that of the behaviour policy. The table
`offline` has a verdict for each class, ν and learner; `templates/findings.jinja` has the words.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal

from sme_registry.spec import Integer, Real, StrictModel, TupleOf
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.tables import ENOUGH_RUNS, training_data

__all__ = [
    "THRESHOLDS",
    "Behaviour",
    "Depth",
    "Learner",
    "OfflineFindings",
    "Place",
    "offline_findings",
]

THRESHOLDS = {
    "near": 0.02,  # difference of r̃, at most: as good as
    "collapse": 0.1,  # of r̃ below the behaviour policy, at least
}
_NEAR, _COLLAPSE = THRESHOLDS["near"], THRESHOLDS["collapse"]

Verdict = Literal["above", "above_few", "below", "below_few", "open", "single_above"]
"""Above or below its data from `ENOUGH_RUNS` runs on; with "_few" an indication; "single_above" is
one run that is further above its data than "near"."""


class Place(StrictModel):
    """A class and a ν, with a difference of similarity there."""

    class_name: str
    nu: Real
    difference: Real  # of r̃, from the behaviour policy; for a behaviour policy, from 1 − ν/6


class Behaviour(StrictModel):
    """The behaviour policies compared with 1 − ν/6, which independent uniform actions give."""

    places: TupleOf[Place]  # every class and ν
    farthest: Place  # where the difference is largest
    far: TupleOf[Place]  # where it is larger than the threshold "near"


class Depth(StrictModel):
    """A learner on the deepest class: it collapses if it is in `at_constant` or `below_data`."""

    class_name: str
    verdict: Literal["collapses", "holds", "no_runs"]
    runs: Integer  # of the learner there
    places: TupleOf[Place] = ()  # its values of ν, with the improvements there
    at_constant: TupleOf[Place] = ()  # where r̃ is near that of the constant ½, or below it
    below_data: TupleOf[Place] = ()  # others, below the behaviour policy by "collapse"
    few_runs: bool = False  # whether any of these has fewer than `ENOUGH_RUNS` runs
    lowest: Place | None = None  # with the lowest improvement; None without runs


class Learner(StrictModel):
    """A learner compared with the behaviour policies."""

    name: str  # such as "IQL (expectile = 0.9)"
    verdict: Literal["imitates", "near_at_some", "near_at_none"]  # near them everywhere: "imitates"
    surpasses: bool  # whether it is above its data anywhere, by enough runs or as an indication
    near: TupleOf[Place]  # where its improvement is within the threshold "near"
    farthest: Place  # where its improvement is largest, up or down
    places: dict[Verdict, TupleOf[Place]]
    depth: Depth | None  # None if all classes are equally deep


class OfflineFindings(StrictModel):
    """What learning from data adds to a study."""

    example: str  # an algorithm of the plan, which is a learner with its data
    nu: Real  # of the example
    behaviour: Behaviour  # the policies that made the data
    learners: TupleOf[Learner]  # those of the plan
    fewest_runs: Integer  # of a learner on a class at a ν
    most_runs: Integer


def offline_findings(analysis: Analysis) -> OfflineFindings:
    """The findings of a study with offline learners."""
    rows = list(analysis.offline.itertuples())
    data = training_data(analysis.runs)
    example, nu = next((name, source[0]) for name, source in data.items() if source)
    runs = [row.runs for row in rows]
    return OfflineFindings(
        example=example,
        nu=nu,
        behaviour=_behaviour(analysis),
        learners=tuple(
            _learner(analysis, name, [row for row in rows if row.learner == name])
            for name in dict.fromkeys(row.learner for row in rows)
        ),
        fewest_runs=min(runs),
        most_runs=max(runs),
    )


def _behaviour(analysis: Analysis) -> Behaviour:
    places = [
        _place(row, row.behaviour_similarity - (1.0 - row.nu / 6.0))
        for row in analysis.offline.drop_duplicates(["class_name", "nu"]).itertuples()
    ]
    return Behaviour(
        places=tuple(places),
        farthest=max(places, key=lambda place: abs(place.difference)),
        far=tuple(place for place in places if abs(place.difference) > _NEAR),
    )


def _learner(analysis: Analysis, name: str, rows: list[Any]) -> Learner:
    near = _places(row for row in rows if abs(row.improvement) <= _NEAR)
    places: dict[Any, tuple[Place, ...]] = {}
    for row in rows:
        verdict = row.verdict
        if row.runs == 1:
            verdict = "single_above" if row.improvement > _NEAR else None
        if verdict is not None:
            places[verdict] = (*places.get(verdict, ()), *_places([row]))
    return Learner(
        name=name,
        verdict=_nearness(len(near), len(rows)),
        surpasses=not places.keys().isdisjoint(("above", "above_few")),
        near=near,
        farthest=max(_places(rows), key=lambda place: abs(place.difference)),
        places=places,
        depth=_depth(analysis, rows),
    )


def _nearness(near: int, places: int) -> Literal["imitates", "near_at_some", "near_at_none"]:
    if not near:
        return "near_at_none"
    return "imitates" if near == places else "near_at_some"


def _depth(analysis: Analysis, rows: list[Any]) -> Depth | None:
    classes = dict.fromkeys(analysis.offline.class_name)
    depth = {name: float(analysis.classes[name].setting["complexity"]) for name in classes}
    if len(set(depth.values())) < 2:
        return None
    deepest = max(depth, key=lambda name: depth[name])
    rows = [row for row in rows if row.class_name == deepest]
    if not rows:
        return Depth(class_name=deepest, verdict="no_runs", runs=0)
    at_constant = [row for row in rows if row.similarity <= row.constant_similarity + _NEAR]
    below = [row for row in rows if row.improvement <= -_COLLAPSE and row not in at_constant]
    collapsed = [*at_constant, *below]
    return Depth(
        class_name=deepest,
        verdict="collapses" if collapsed else "holds",
        runs=sum(row.runs for row in rows),
        places=_places(rows),
        at_constant=_places(at_constant),
        below_data=_places(below),
        few_runs=any(row.runs < ENOUGH_RUNS for row in collapsed),
        lowest=min(_places(rows), key=lambda place: place.difference),
    )


def _places(rows: Iterable[Any]) -> tuple[Place, ...]:
    return tuple(_place(row, row.improvement) for row in rows)


def _place(row: Any, difference: float) -> Place:
    return Place(class_name=row.class_name, nu=row.nu, difference=difference)
