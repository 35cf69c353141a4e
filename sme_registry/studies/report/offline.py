"""Learning from data in a study's report: how good the data were, and what was made of them.

The number of a run is its r̃ less the r̃ of the policy that made its data: 0 for who imitates.
What is `shown` has an interval that leaves out 0 and rests on `ENOUGH_RUNS` runs; where all of
fewer runs lie on one side it is an indication; and otherwise it is open.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from sme_registry.plots import COLOURS, GREY, MARKERS, REFERENCE_DASHES, drawing, literal
from sme_registry.studies.report.analysis import learnt_from
from sme_registry.studies.report.exports import Data, Printed, number, table_of
from sme_registry.studies.report.figures import WIDTH, Picture
from sme_registry.studies.report.tables import (
    ENOUGH_RUNS,
    OFFLINE_INTERVAL,
    Analysis,
    OfflineData,
    OfflineScore,
)

_NEAR = 0.02  # of r̃: what is called near, or imitated
_FALLEN = 0.1  # of r̃ below its data: what is called a collapse
_LEARNER_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (5, 1, 1, 1)), (0, (8, 2)))


def offline_data(analysis: Analysis) -> list[Data]:
    """Every number, and every run; nothing where no cell learnt from data."""
    if not analysis.offline:
        return []
    scores = (
        (*row[:9], data.behaviour, data.behaviour_sd, data.sets, data.constant)
        for row, data in _with_data(analysis)
    )
    runs = (
        (
            run.planned.class_name,
            own.nu,
            run.planned.algorithm,
            run.planned.run,
            own.behaviour_similarity,
            own.behaviour_similarity_sd,
            own.similarity,
            own.similarity_sd,
            own.similarity - own.behaviour_similarity,
            own.transitions,
            own.dataset_digest,
            run.result.key,
        )
        for run in analysis.results
        if (own := run.result.offline) is not None
    )
    return [
        table_of(
            "offline",
            "class nu learner runs score score_sd change low high behaviour behaviour_sd data_sets "
            "constant",
            scores,
        ),
        table_of(
            "offline-runs",
            "class nu algorithm run behaviour behaviour_sd score score_sd change transitions "
            "dataset key",
            runs,
        ),
    ]


def offline_printed(analysis: Analysis) -> list[Printed]:
    """Who made the data beside who learnt from them, and the differences."""
    if not analysis.offline:
        return []
    learners = _learners(analysis)
    at = {(row.class_name, row.nu, row.learner): row for row in analysis.offline}

    def score(row: OfflineScore) -> str:
        return f"{number(row.score, 3)} ± {number(row.score_sd, 3)} ({row.runs})"

    def change(row: OfflineScore) -> str:
        text = number(row.change, 3, "+")
        if row.low is None or row.high is None:
            return f"{text} (n = {row.runs})"
        star = {"above": " †", "below": " *"}.get(_verdict(row), "")
        few = "" if row.runs >= ENOUGH_RUNS else f" (n = {row.runs})"
        return f"{text} [{number(row.low, 3, '+')}, {number(row.high, 3, '+')}]{few}{star}"

    def rows(
        entry: Callable[[OfflineScore], str], first: Callable[[OfflineData], tuple[str, ...]]
    ) -> tuple[tuple[str, ...], ...]:
        return tuple(
            (
                data.class_name,
                f"{data.nu:g}",
                *first(data),
                *(
                    "–" if (row := at.get((*data[:2], name))) is None else entry(row)
                    for name in learners
                ),
            )
            for data in analysis.offline_data
        )

    return [
        Printed(
            "offline",
            "Learning from data: mean similarity r̃",
            "Mean over runs ± the standard deviation over steps, its mean over runs; in brackets "
            "the number of runs, and of the behaviour policy's data sets. The constant ½ is given "
            "within distribution.",
            ("class", "ν", "constant ½", "behaviour policy", *learners),
            rows(
                score,
                lambda data: (
                    number(data.constant, 3),
                    f"{number(data.behaviour, 3)} ± {number(data.behaviour_sd, 3)} ({data.sets})",
                ),
            ),
        ),
        Printed(
            "offline-improvement",
            "Learning from data: r̃ less the behaviour policy's",
            f"Mean over runs, with its 95 % bootstrap interval from {OFFLINE_INTERVAL} runs on. "
            "†: above its data, *: below, by an interval that leaves out 0 and rests on "
            f"{ENOUGH_RUNS} runs or more.",
            ("class", "ν", *learners),
            rows(change, lambda data: ()),
        ),
    ]


def offline_pictures(analysis: Analysis, formats: Sequence[str]) -> list[Picture]:
    """The improvement over the behaviour policy against ν, one panel a class."""
    if not analysis.offline:
        return []
    learners = _learners(analysis)
    classes = _classes(analysis)
    nus = sorted({data.nu for data in analysis.offline_data})
    apart = min((b - a for a, b in itertools.pairwise(nus)), default=1.0)
    across = min(3, len(classes))
    down = math.ceil(len(classes) / across)
    size = (max(3.6, min(WIDTH, 1.0 + 2.4 * across)), 0.9 + 2.4 * down)
    with drawing(size, tuple(formats)) as (figure, files):
        panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        for axes in panels.ravel()[len(classes) :]:
            axes.set_visible(False)
        for axes, class_name in zip(panels.ravel(), classes, strict=False):
            data = [row for row in analysis.offline_data if row.class_name == class_name]
            at = [row.nu for row in data]
            axes.axhline(0.0, color="black", linewidth=0.9, zorder=1.5)
            for heights, dash in (
                ([1.0 - row.behaviour for row in data], _OPTIMUM_DASH),
                ([row.constant - row.behaviour for row in data], _CONSTANT_DASH),
            ):
                axes.plot(at, heights, color=GREY, linewidth=1.1, linestyle=dash, zorder=1.6)
            for index, name in enumerate(learners):
                own = [
                    row
                    for row in analysis.offline
                    if (row.class_name, row.learner) == (class_name, name)
                ]
                shift = (index - (len(learners) - 1) / 2) * 0.25 * apart / len(learners)
                _draw(axes, own, index, shift)
            axes.set_title(literal(class_name))
        for index, axes in enumerate(panels.ravel()[: len(classes)]):
            axes.tick_params(labelbottom=index + across >= len(classes))
            if index + across >= len(classes):
                axes.set_xlabel("ν of the behaviour policy")
        for row_of_panels in panels:
            row_of_panels[0].set_ylabel("r̃ − r̃ of the behaviour")
        first = panels[0][0]
        handles = [
            first.plot([], [], label=literal(name), linewidth=1.4, markersize=4.5, **_look(i))[0]
            for i, name in enumerate(learners)
        ]
        handles += [
            first.plot([], [], color=colour, linewidth=1.1, linestyle=dash, label=label)[0]
            for label, dash, colour in (
                ("behaviour policy", "-", "black"),
                ("optimum", _OPTIMUM_DASH, GREY),
                ("constant ½", _CONSTANT_DASH, GREY),
            )
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=2 * across)
    few = min(row.runs for row in analysis.offline)
    caption = (
        "A small mark is a run, a large one the mean over runs: similarity of the learner less "
        "that of the policy that made its data."
    )
    if any(row.low is not None for row in analysis.offline):
        caption += " Bars are 95 % bootstrap intervals of the mean."
    if few < OFFLINE_INTERVAL:
        caption += f" Where there are fewer than {OFFLINE_INTERVAL} runs there is no interval."
    if few < ENOUGH_RUNS:
        caption += f" Hollow: fewer than {ENOUGH_RUNS} runs, an indication only."
    title = "Improvement over the behaviour policy"
    return [Picture("offline-improvement", title, caption, files)]


def offline_words(analysis: Analysis) -> list[str]:
    """What the numbers say, a sentence or a few for each question; nothing without such cells."""
    if not analysis.offline:
        return []
    said = [_of_the_names(analysis), _of_the_data(analysis)]
    for name in _learners(analysis):
        said += [_of_learner(analysis, name), *_of_depth(analysis, name)]
    runs = [row.runs for row in analysis.offline]
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
        (name, data) for name, data in learnt_from(analysis.results).items() if data
    )
    return (
        f"An algorithm here is a learner with its data: {name} learnt from data of ν = "
        f"{nu:g}. The behaviour policy that makes them takes (1 − α) a* + α ã, with α drawn from "
        "U(0, ν) at each step and ã of a second network."
    )


def _of_the_data(analysis: Analysis) -> str:
    """Whether the behaviour is as good as two independent uniform actions would make it."""
    off = [(row.behaviour - (1.0 - row.nu / 6.0), row) for row in analysis.offline_data]
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
    rows = [row for row in analysis.offline if row.learner == name]
    near = [row for row in rows if abs(row.change) <= _NEAR]
    top = max(rows, key=lambda row: abs(row.change))
    if len(near) == len(rows):
        text = (
            f"{name} imitates: its mean is near the behaviour policy's everywhere, "
            f"{number(top.change, 3, '+')} off at most ({_place(top)})."
        )
    elif near:
        text = (
            f"{name} is near the behaviour policy at {_places(near)}; it is farthest from it at "
            f"{_place(top)}, by {number(top.change, 3, '+')}."
        )
    else:
        text = (
            f"{name} is nowhere near the behaviour policy; it is farthest from it at "
            f"{_place(top)}, by {number(top.change, 3, '+')}."
        )
    for verdict, words in _WORDS.items():
        own = [row for row in rows if _verdict(row) == verdict]
        if own:
            text += f" {words} {_places(own)}{_range(own)}."
    alone = [row for row in rows if row.runs == 1]
    high = [row for row in alone if row.change > _NEAR]
    if high:
        text += f" A single run, no more than a hint, is above its data at {_places(high)}"
        text += f"{_range(high)}."
    if not any(_verdict(row) in ("above", "above, few") for row in rows):
        text += " It has not been shown to surpass its data at any ν."
    still_open = [row for row in rows if _verdict(row) == "open" and row not in alone]
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
        (row, data)
        for row, data in _with_data(analysis)
        if (row.class_name, row.learner) == (deepest, name)
    ]
    where = f"on the deepest class, {deepest}"
    if not own:
        return [f"Of {name} {where}, no run has finished yet."]
    runs = sum(row.runs for row, _ in own)
    of = f"{len(own)} {_plural(len(own), 'value')} of ν, {runs} {_plural(runs, 'run')}"
    at_constant = [row for row, data in own if row.score <= data.constant + _NEAR]
    fallen = [row for row, _ in own if row.change <= -_FALLEN and row not in at_constant]
    if not at_constant and not fallen:
        low, _ = min(own, key=lambda pair: pair[0].change)
        return [
            f"{name} does not collapse {where} ({of}): its mean is more than {_NEAR:g} above the "
            f"constant ½'s everywhere, and {number(low.change, 3, '+')} from its data at the "
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
    "above, few": "All of its few runs surpass their data, an indication, at",
    "below": "It is shown to fall behind its data at",
    "below, few": "All of its few runs fall behind their data, an indication, at",
}
_OPTIMUM_DASH: Any = (0, (1, 1.2))
_CONSTANT_DASH = REFERENCE_DASHES["constant_half"]


def _verdict(row: OfflineScore) -> str:
    """A key of `_WORDS`, or `open`; of a single run always `open`."""
    if row.runs >= ENOUGH_RUNS and row.low is not None and row.high is not None:
        return "above" if row.low > 0.0 else "below" if row.high < 0.0 else "open"
    if row.runs > 1 and min(row.changes) > 0.0:
        return "above, few"
    return "below, few" if row.runs > 1 and max(row.changes) < 0.0 else "open"


def _draw(axes: Any, rows: Sequence[OfflineScore], index: int, shift: float) -> None:
    """A learner in one panel."""
    look = _look(index)
    colour = look["color"]
    axes.plot(
        [row.nu + shift for row in rows], [row.change for row in rows], color=colour,
        linewidth=1.4, linestyle=look["linestyle"],
    )  # fmt: skip
    for row in rows:
        x = row.nu + shift
        if row.low is not None and row.high is not None:
            axes.plot([x, x], [row.low, row.high], color=colour, linewidth=1.6)
        axes.plot(
            [x] * row.runs, row.changes, color=colour, marker=look["marker"], markersize=2.5,
            markeredgewidth=0.0, alpha=0.5, linestyle="none", zorder=2.5,
        )  # fmt: skip
        axes.plot(
            x, row.change, color=colour, marker=look["marker"], markersize=4.5,
            markeredgewidth=1.1, markerfacecolor=colour if row.runs >= ENOUGH_RUNS else "none",
            linestyle="none", zorder=3,
        )  # fmt: skip


def _look(index: int) -> dict[str, Any]:
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[index % len(MARKERS)],
        "linestyle": _LEARNER_DASHES[index % len(_LEARNER_DASHES)],
    }


def _with_data(analysis: Analysis) -> Iterator[tuple[OfflineScore, OfflineData]]:
    data = {row[:2]: row for row in analysis.offline_data}
    return ((row, data[row[:2]]) for row in analysis.offline)


def _learners(analysis: Analysis) -> list[str]:
    """Each once, as the first class has them."""
    return list(dict.fromkeys(row.learner for row in analysis.offline))


def _classes(analysis: Analysis) -> list[str]:
    """With data, in the plan's order."""
    return list(dict.fromkeys(row.class_name for row in analysis.offline_data))


def _places(rows: Iterable[OfflineScore | OfflineData]) -> str:
    """`complexity1 (ν = 0, 0.5), complexity50 (ν = 1)`."""
    found: dict[str, list[OfflineScore | OfflineData]] = {}
    for row in rows:
        found.setdefault(row.class_name, []).append(row)
    return ", ".join(f"{name} (ν = {_nus(own)})" for name, own in found.items())


def _place(row: OfflineScore) -> str:
    return f"{row.class_name}, ν = {row.nu:g}"


def _nus(rows: Iterable[OfflineScore | OfflineData]) -> str:
    return ", ".join(f"{row.nu:g}" for row in rows)


def _range(rows: Sequence[OfflineScore]) -> str:
    """`, by +0.010 to +0.042`."""
    ends = [number(end(row.change for row in rows), 3, "+") for end in (min, max)]
    return f", by {ends[0]}" if ends[0] == ends[1] else f", by {ends[0]} to {ends[1]}"


def _plural(count: int, one: str) -> str:
    return one if count == 1 else f"{one}s"
