"""`write_page`: the page of a profile, its figure as PDF, and the facts as JSON.

FOLDER/profile.html    one file that loads nothing: sentences, two figures, tables, origin
FOLDER/profile.pdf     the figure of all axes
FOLDER/profile.json    the `Profile`
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from sme_registry.io import write_atomically
from sme_registry.plots.style import GREY, draw_band, encoded, literal, new_figure, styled
from sme_registry.profiles.document import AXES, COMPARED, Axis, DrawEstimate, Profile
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.texts import TextTable
from sme_registry.studies.report.write import listed, rendered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HIGHEST = 1.45  # N₀ that the figure shows
_LEAST, _MOST = -0.6, 1.35  # robustness


def write_page(
    profile: Profile,
    folder: str | os.PathLike[str],
    references: Iterable[Profile] | None = None,
) -> list[Path]:
    """Write the page, the PDF and the JSON, and return their paths, the page first.

    `references` are drawn behind, as far as they are comparable; by default the package's.
    """
    given = None if references is None else [*references]
    others, folder = profile.behind(given), Path(folder)
    drawn = {"axes": draw_axes(profile, others), "robustness": draw_robustness(profile, others)}
    page = rendered(
        "profile.html.jinja",
        Path(__file__).parent / "templates",
        profile=profile,
        sentences=profile.sentences(given),
        figures={name: encoded(figure, ["svg"])["svg"] for name, figure in drawn.items()},
        tables=[_robustness(profile, others), *_differences(profile, others), _levels(profile)],
        origin=_origin(profile, others),
    )
    return [
        write_atomically(folder / "profile.html", page),
        write_atomically(folder / "profile.pdf", encoded(drawn["axes"], ["pdf"])["pdf"]),
        profile.write(folder / "profile.json"),
    ]


def _robustness(profile: Profile, others: Sequence[Profile]) -> TextTable:
    compared = [profile, *(each for each in others if each.name != "constant")]
    rows = [
        {"axis": axis.label}
        | {each.name: str(each.robustness(axis, profile.classes)) for each in compared}
        for axis in AXES
    ]
    note = (
        f"What is kept of the performance at the harder levels that {profile.name} has, with 95 % "
        "intervals over draws."
    )
    return TextTable("robustness", "Robustness", note, pd.DataFrame(rows))


def _differences(profile: Profile, others: Sequence[Profile]) -> Iterator[TextTable]:
    compared = {
        f"vs. {other.name}": {
            label: f"{difference} {difference.verdict}"
            for label, difference in profile.contrasts(other).items()
        }
        for other in others
        if other.learns
    }
    if not any(compared.values()):
        return
    frame = pd.DataFrame(compared).fillna("–").rename_axis("axis").reset_index()
    note = (
        f"N₀ of {profile.name} minus that of the other, over the harder levels of each axis: below "
        "0 it is better. In pairs, on the same draw with the same seed; IQM over pairs, mean over "
        "levels, with 95 % intervals. Open: the interval includes 0."
    )
    title = f"Difference of {profile.name} from the references"
    yield TextTable("differences", title, note, frame)


def _levels(profile: Profile) -> TextTable:
    failed = Counter(failure.class_name for failure in profile.failures)
    rows = []
    for name in dict.fromkeys(level for axis in AXES for level in axis.levels):
        regret = profile.level(name)
        rows.append(
            {
                "level": name,
                "N₀": str(regret),
                "N̄ outside": str(profile.level(name, "ood_regret")),
                "decay": _number(profile.level(name, "ood_decay"), ".1%"),
                "online regret": _number(profile.level(name, "online_regret"), ".3f"),
                "steps to N₀ ≤ ½": _steps(profile, name),
                "draws": f"{regret.draws}" + (f", {failed[name]} failed" if failed[name] else ""),
            }
        )
    note = (
        "N₀ within the training cube, N̄ its mean over the shells around it, decay the share of "
        "similarity that is lost there, online regret the mean of 1 − reward over all steps of "
        "training. IQM over draws, of steps the median; “never” within these steps."
    )
    return TextTable("levels", "Every level", note, pd.DataFrame(rows))


def _steps(profile: Profile, name: str) -> str:
    steps = profile.steps_to_half(name)
    return "–" if steps is None else "never" if math.isinf(steps) else f"{steps:,.0f}"


def _number(estimate: DrawEstimate, form: str) -> str:
    return format(estimate.value, form) if estimate.draws else "–"


def _origin(profile: Profile, others: Sequence[Profile]) -> Iterator[tuple[str, str, str]]:
    """A name, a digest or other code, and a text."""
    algorithm = profile.algorithm
    settings = listed(algorithm.hyperparameters, " = ") or "default hyperparameters"
    yield "algorithm", algorithm.uses, settings
    if algorithm.source:
        yield "source", algorithm.source, "of its module"
    done, failed = len(profile.rows), len(profile.failures)
    absent = profile.planned - done - failed
    counts = [f"{done} of {profile.planned} finished"]
    counts += [f"{failed} failed"] * bool(failed) + [f"{absent} not run"] * bool(absent)
    yield "runs", "", f"{', '.join(counts)}; {profile.budget}"
    yield "draws", "", f"{profile.seeds} of each level, the seed of training is their number"
    yield "plan", profile.plan_digest, profile.plan
    yield "protocol", profile.protocol_digest, "of N₀ and N̄"
    yield "versions", "", listed(profile.versions)
    for other in others:
        uses = other.algorithm.uses
        yield f"reference {other.name}", uses, f"{len(other.rows)} runs; {listed(other.versions)}"


def _looks(profile: Profile, others: Sequence[Profile]) -> dict[str, panels.Look]:
    """The profile in front; a method of several discounts has one colour. The constant has none."""
    methods = [other.name.partition(" (")[0] for other in others if other.learns]
    numbered = panels.numbered_looks(dict.fromkeys(("", *COMPARED, *methods)))
    solid, hollow = {"linestyle": "-"}, {"linestyle": (0, (2, 1.5)), "markerfacecolor": "none"}
    looks: dict[str, panels.Look] = {profile.name: {**numbered[""], **solid}}
    for other in others:
        method, _, variant = other.name.partition(" (")
        if other.learns:
            looks[other.name] = {**numbered[method], **(hollow if variant else solid)}
        elif other.name == "linear":
            looks[other.name] = panels.LINEAR
    return looks


@styled()
def draw_axes(profile: Profile, others: Sequence[Profile]) -> Figure:
    """N₀ over the levels of each axis, a panel each; the others are behind."""
    looks, by_name = _looks(profile, others), {each.name: each for each in (*others, profile)}

    def draw(axes: Axes, axis: Axis) -> None:
        for name, look in reversed(looks.items()):
            _draw_line(axes, by_name[name], axis, look, front=name == profile.name)
        axes.axhline(1.0, color=GREY, linewidth=0.8, linestyle=(0, (1, 2)), zorder=1)
        axes.set_xticks(range(len(axis.levels)), [*axis.levels.values()])
        axes.set_xlim(-0.25, len(axis.levels) - 0.75)
        axes.set_ylim(0.0, _HIGHEST)
        axes.grid(visible=False, axis="x")

    items = [(axis.label, axis) for axis in AXES]
    return panels.grid(items, draw, (0.7, 1.75), y="N₀", looks=looks)


def _draw_line(axes: Axes, profile: Profile, axis: Axis, look: panels.Look, *, front: bool) -> None:
    levels = enumerate(map(profile.level, axis.levels))
    points = [(i, level.value, level.low, level.high) for i, level in levels if level.draws]
    if not points:
        return
    x, y, low, high = zip(*points, strict=True)
    if front or look["marker"]:
        draw_band(axes, x, low, high, look["color"])
    width, alpha, order = (2.2, 1.0, 3) if front else (1.1, 0.75, 2)
    style = {**look, "linewidth": width, "alpha": alpha, "markersize": 4, "zorder": order}
    heights = np.minimum(y, _HIGHEST)  # of more, the mark is at the edge
    axes.plot(x, heights, **style, clip_on=False)


@styled()
def draw_robustness(profile: Profile, others: Sequence[Profile]) -> Figure:
    looks, by_name = _looks(profile, others), {each.name: each for each in (profile, *others)}
    looks = {
        name: {**look, "marker": look["marker"] or "D", "linestyle": "none"}
        for name, look in looks.items()
    }
    figure = new_figure((panels.WIDTH, 1.2 + 0.36 * len(AXES)))
    axes = figure.add_subplot()
    for name, look, shift in panels.side_by_side(looks, 0.6):
        for row, axis in enumerate(AXES):
            kept = by_name[name].robustness(axis, profile.classes)
            if not kept.draws:
                continue
            front = name == profile.name
            if not math.isnan(kept.low):
                width = 1.8 if front else 0.9
                axes.hlines(row + shift, kept.low, kept.high, color=look["color"], linewidth=width)
            size = 6.0 if front else 4.0
            value = min(max(kept.value, _LEAST), _MOST)  # of others, the mark is at the edge
            axes.plot([value], [row + shift], **look, markersize=size, zorder=3, clip_on=False)
    axes.set_yticks(range(len(AXES)), [literal(axis.label) for axis in AXES])
    axes.set_ylim(len(AXES) - 0.4, -0.6)
    axes.axvline(1.0, color="black", linewidth=0.9, zorder=1)
    axes.set_xlim(_LEAST, _MOST)
    axes.set_xlabel("robustness: share of the performance 1 − N₀ that is kept at the harder levels")
    axes.grid(visible=False, axis="y")
    panels.legend(figure, looks)
    return figure
