"""Findings on learning from data: does a learner reach or surpass the policy that made its data?

The improvement of a run is its mean similarity r̃ minus that of the behaviour policy. The table
`offline` has a verdict for each class, ν and learner; `templates/findings.jinja` has the words.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from sme_registry.spec import Integer, Real, StrictModel
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

_Part = TypeVar("_Part")
_Tuple = Annotated[tuple[_Part, ...], Field(strict=False)]
Verdict = Literal["above", "above_few", "below", "below_few", "open"]


class Place(StrictModel):
    """A class and a ν, with a difference of similarity there.

    Attributes:
      class_name, nu: the place.
      difference: of r̃, from the behaviour policy; for a behaviour policy, from 1 − ν/6.
    """

    class_name: str
    nu: Real
    difference: Real


class Behaviour(StrictModel):
    """The behaviour policies compared with 1 − ν/6, which independent uniform actions give.

    Attributes:
      places: every class and ν.
      farthest: where the difference is largest.
      far: where it is larger than the threshold "near".
    """

    places: _Tuple[Place]
    farthest: Place
    far: _Tuple[Place]


class Depth(StrictModel):
    """A learner on the deepest class.

    Attributes:
      class_name: the class.
      verdict: "collapses" if it is at the constant ½ or far below its data at any ν.
      runs: of the learner there.
      places: its values of ν, with the improvements there.
      at_constant: those where r̃ is near that of the constant ½, or below it.
      below_data: others where it is below the behaviour policy by the threshold "collapse".
      few_runs: whether any of these has fewer than `ENOUGH_RUNS` runs.
      lowest: the place with the lowest improvement; None without runs.
    """

    class_name: str
    verdict: Literal["collapses", "holds", "no_runs"]
    runs: Integer
    places: _Tuple[Place] = ()
    at_constant: _Tuple[Place] = ()
    below_data: _Tuple[Place] = ()
    few_runs: bool = False
    lowest: Place | None = None


class Learner(StrictModel):
    """A learner compared with the behaviour policies.

    Attributes:
      name: such as "IQL (expectile = 0.9)".
      verdict: "imitates" if it is near them everywhere, else "near_at_some" or "near_at_none".
      surpasses: whether it is above its data anywhere, by enough runs or as an indication.
      near: where its improvement is within the threshold "near".
      farthest: where its improvement is largest, up or down.
      places: by verdict: "above" or "below" from `ENOUGH_RUNS` runs on, with "_few" an indication;
        "single_above" is a single run that is further above than "near".
      depth: on the deepest class; None if all classes are equally deep.
    """

    name: str
    verdict: Literal["imitates", "near_at_some", "near_at_none"]
    surpasses: bool
    near: _Tuple[Place]
    farthest: Place
    places: dict[Verdict | Literal["single_above"], _Tuple[Place]]
    depth: Depth | None


class OfflineFindings(StrictModel):
    """What learning from data adds to a study.

    Attributes:
      example, nu: an algorithm of the plan and its ν; an algorithm is a learner with its data.
      behaviour: the policies that made the data.
      learners: those of the plan.
      fewest_runs, most_runs: of a learner on a class at a ν.
    """

    example: str
    nu: Real
    behaviour: Behaviour
    learners: _Tuple[Learner]
    fewest_runs: Integer
    most_runs: Integer


def offline_findings(analysis: Analysis) -> OfflineFindings:
    """The findings of a study with offline learners."""
    rows = list(analysis.offline.itertuples())
    data = training_data(analysis.runs)
    example = next(name for name, source in data.items() if source is not None)
    source = data[example]
    assert source is not None
    runs = [row.runs for row in rows]
    return OfflineFindings(
        example=example,
        nu=source[0],
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
    places: dict[Any, tuple[Place, ...]] = {
        verdict: _places(
            row
            for row in rows
            if row.verdict == verdict and not (verdict == "open" and row.runs == 1)
        )
        for verdict in ("above", "above_few", "below", "below_few", "open")
    }
    places["single_above"] = _places(
        row for row in rows if row.runs == 1 and row.improvement > _NEAR
    )
    verdict: Literal["imitates", "near_at_some", "near_at_none"] = "near_at_none"
    if near:
        verdict = "imitates" if len(near) == len(rows) else "near_at_some"
    return Learner(
        name=name,
        verdict=verdict,
        surpasses=bool(places["above"] or places["above_few"]),
        near=near,
        farthest=max(_places(rows), key=lambda place: abs(place.difference)),
        places={verdict: found for verdict, found in places.items() if found},
        depth=_depth(analysis, rows),
    )


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
