"""Learning from data in a study's report: how good the data were, and what was made of them.

The number of a run is its r̃ less the r̃ of the policy that made its data: 0 for who imitates.
What is `shown` has an interval that leaves out 0 and rests on `ENOUGH_RUNS` runs; where all of
fewer runs lie on one side it is an indication; and otherwise it is open.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.exports import number
from sme_registry.studies.report.offline_tables import OFFLINE_INTERVAL
from sme_registry.studies.report.tables import ENOUGH_RUNS, training_data

_NEAR = 0.02  # of r̃: what is called near, or imitated
_FALLEN = 0.1  # of r̃ below its data: what is called a collapse


def offline_words(analysis: Analysis) -> list[str]:
    """What the numbers say, a sentence or a few for each question; nothing without such cells."""
    if not analysis.has_offline_runs:
        return []
    said = [_of_the_names(analysis), _of_the_data(analysis)]
    for name in _learners(analysis):
        said += [_of_learner(analysis, name), *_of_depth(analysis, name)]
    runs = [row.runs for row in analysis.offline.itertuples()]
    spread = str(min(runs)) if min(runs) == max(runs) else f"{min(runs)} to {max(runs)}"
    if min(runs) < ENOUGH_RUNS:
        said.append(
            f"There {'is' if spread == '1' else 'are'} {spread} {_plural(max(runs), 'run')} for "
            f"each learner, class and ν. Under {ENOUGH_RUNS} this report calls nothing shown, and "
            f"under {OFFLINE_INTERVAL} it gives no interval; “near” is within {_NEAR:g} of r̃."
        )
    else:
        said.append(
            f"There are {spread} runs for each learner, class and ν. “Shown” is an interval of its "
            "own, and of many intervals one in twenty leaves out 0 by chance; “near” is within "
            f"{_NEAR:g} of r̃."
        )
    return said


def _of_the_names(analysis: Analysis) -> str:
    """What an algorithm of such a plan is."""
    name, (nu, _) = next(
        (name, data) for name, data in training_data(analysis.runs).items() if data
    )
    return (
        f"An algorithm here is a learner with its data: {name} learnt from data of ν = "
        f"{nu:g}. The behaviour policy that makes them takes (1 − α) a* + α ã, with α drawn from "
        "U(0, ν) at each step and ã of a second network."
    )


def _of_the_data(analysis: Analysis) -> str:
    """Whether the behaviour is as good as two independent uniform actions would make it."""
    off = [(row.behaviour_similarity - (1.0 - row.nu / 6.0), row) for row in _data(analysis)]
    by, worst = max(off, key=lambda pair: abs(pair[0]))
    there = f"{worst.class_name}, ν = {worst.nu:g}"
    if abs(by) <= _NEAR:
        return (
            f"The behaviour policies are near 1 − ν/6 everywhere: {number(by, 3, '+')} off at "
            f"most ({there})."
        )
    far = [row for by_here, row in off if abs(by_here) > _NEAR]
    return (
        f"The behaviour policies are near 1 − ν/6 in {len(off) - len(far)} of {len(off)} places, "
        f"and not at {_places(far)}: {number(by, 3, '+')} off at most ({there}). A single second "
        "network may be closer to the optimum, or farther, than independent uniform actions are."
    )


def _of_learner(analysis: Analysis, name: str) -> str:
    """Where a learner is with its data, above them and below."""
    rows = [row for row in analysis.offline.itertuples() if row.learner == name]
    near = [row for row in rows if abs(row.improvement) <= _NEAR]
    top = max(rows, key=lambda row: abs(row.improvement))
    if len(near) == len(rows):
        text = (
            f"{name} imitates: its mean is near the behaviour policy's everywhere, "
            f"{number(top.improvement, 3, '+')} off at most ({_place(top)})."
        )
    elif near:
        text = (
            f"{name} is near the behaviour policy at {_places(near)}; it is farthest from it at "
            f"{_place(top)}, by {number(top.improvement, 3, '+')}."
        )
    else:
        text = (
            f"{name} is nowhere near the behaviour policy; it is farthest from it at "
            f"{_place(top)}, by {number(top.improvement, 3, '+')}."
        )
    for verdict, words in _WORDS.items():
        own = [row for row in rows if row.verdict == verdict]
        if own:
            text += f" {words} {_places(own)}{_range(own)}."
    alone = [row for row in rows if row.runs == 1]
    high = [row for row in alone if row.improvement > _NEAR]
    if high:
        text += f" A single run, no more than a hint, is above its data at {_places(high)}"
        text += f"{_range(high)}."
    if not any(row.verdict in ("above", "above_few") for row in rows):
        text += " It has not been shown to surpass its data at any ν."
    still_open = [row for row in rows if row.verdict == "open" and row not in alone]
    if still_open:
        text += f" Which side of its data it is on is open at {_places(still_open)}."
    return text


def _of_depth(analysis: Analysis, name: str) -> list[str]:
    """Whether a learner collapses on the deepest class; nothing where no class is deeper."""
    depth = {c: analysis.classes[c].setting["complexity"] for c in _classes(analysis)}
    deepest = max(depth, key=lambda c: float(depth[c]))
    if len(set(depth.values())) < 2:
        return []
    own = [
        row
        for row in analysis.offline.itertuples()
        if (row.class_name, row.learner) == (deepest, name)
    ]
    where = f"on the deepest class, {deepest}"
    if not own:
        return [f"Of {name} {where}, no run has finished yet."]
    runs = sum(row.runs for row in own)
    of = f"{len(own)} {_plural(len(own), 'value')} of ν, {runs} {_plural(runs, 'run')}"
    at_constant = [row for row in own if row.similarity <= row.constant_similarity + _NEAR]
    fallen = [row for row in own if row.improvement <= -_FALLEN and row not in at_constant]
    if not at_constant and not fallen:
        low = min(own, key=lambda row: row.improvement)
        return [
            f"{name} does not collapse {where} ({of}): its mean is more than {_NEAR:g} above the "
            f"constant ½'s everywhere, and {number(low.improvement, 3, '+')} from its data at the "
            f"least (ν = {low.nu:g})."
        ]
    few = ""
    if any(row.runs < ENOUGH_RUNS for row in (*at_constant, *fallen)):
        few = " With so few runs this is an indication."
    parts = []
    if at_constant:
        parts.append(
            f"at ν = {_nus(at_constant)} it is no more than {_NEAR:g} better than the constant ½"
        )
    if fallen:
        parts.append(
            f"at ν = {_nus(fallen)} it is better than the constant ½, but {_FALLEN:g} or more "
            "below its data"
        )
    return [f"{name} collapses {where} ({of}): {', and '.join(parts)}.{few}"]


_WORDS = {
    "above": "It is shown to surpass its data at",
    "above_few": "All of its few runs surpass their data, an indication, at",
    "below": "It is shown to fall behind its data at",
    "below_few": "All of its few runs fall behind their data, an indication, at",
}


def _data(analysis: Analysis) -> list[Any]:
    """One row for each class and ν."""
    return list(analysis.offline.drop_duplicates(["class_name", "nu"]).itertuples())


def _learners(analysis: Analysis) -> list[str]:
    """Each once, as the first class has them."""
    return list(dict.fromkeys(row.learner for row in analysis.offline.itertuples()))


def _classes(analysis: Analysis) -> list[str]:
    """With data, in the plan's order."""
    return list(dict.fromkeys(row.class_name for row in _data(analysis)))


def _places(rows: Iterable[Any]) -> str:
    """`complexity1 (ν = 0, 0.5), complexity50 (ν = 1)`."""
    found: dict[str, list[Any]] = {}
    for row in rows:
        found.setdefault(row.class_name, []).append(row)
    return ", ".join(f"{name} (ν = {_nus(own)})" for name, own in found.items())


def _place(row: Any) -> str:
    return f"{row.class_name}, ν = {row.nu:g}"


def _nus(rows: Iterable[Any]) -> str:
    return ", ".join(f"{row.nu:g}" for row in rows)


def _range(rows: Sequence[Any]) -> str:
    """`, by +0.010 to +0.042`."""
    ends = [number(end(row.improvement for row in rows), 3, "+") for end in (min, max)]
    return f", by {ends[0]}" if ends[0] == ends[1] else f", by {ends[0]} to {ends[1]}"


def _plural(count: int, one: str) -> str:
    return one if count == 1 else f"{one}s"
