"""The improvement of offline learners over the behaviour policy, against ν."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from sme_registry.plots import GREY, literal
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Look, Picture
from sme_registry.studies.report.offline_tables import OFFLINE_INTERVAL
from sme_registry.studies.report.tables import ENOUGH_RUNS

_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (5, 1, 1, 1)), (0, (8, 2)))
_OPTIMUM_DASH: Any = (0, (1, 1.2))


def draw_offline(analysis: Analysis, formats: Sequence[str]) -> list[Picture]:
    """One panel a class; no figure where no run learnt from data."""
    if not analysis.has_offline_runs:
        return []
    classes = list(dict.fromkeys(analysis.offline.class_name))
    looks = panels.numbered_looks(dict.fromkeys(analysis.offline.learner), dashes=_DASHES)
    across = min(3, len(classes))
    width = max(3.6, min(panels.WIDTH, 1.0 + 2.4 * across))
    with panels.panel_grid(len(classes), formats, (0.9, 2.4), width=width, share_x=True) as (
        grid,
        files,
    ):
        for axes, class_name in zip(grid.panels, classes, strict=True):
            _draw_class(axes, analysis, class_name, looks)
        grid.label_rows("r̃ − r̃ of the behaviour")
        grid.label_columns("ν of the behaviour policy")
        lines = {
            "behaviour policy": ("black", "-"),
            "optimum": (GREY, _OPTIMUM_DASH),
            "constant ½": (GREY, panels.CONSTANT_DASH),
        }
        panels.legend(grid.figure, looks, lines, across=2 * across)
    title = "Improvement over the behaviour policy"
    return [Picture("offline-improvement", title, _caption(analysis), files)]


def _draw_class(axes: Any, analysis: Analysis, class_name: str, looks: dict[str, Look]) -> None:
    rows = analysis.offline[analysis.offline.class_name == class_name]
    runs = analysis.offline_runs[analysis.offline_runs.class_name == class_name]
    data = rows.drop_duplicates("nu")
    axes.axhline(0.0, color="black", linewidth=0.9, zorder=1.5)
    for similarity, dash in (
        (1.0, _OPTIMUM_DASH),
        (data.constant_similarity, panels.CONSTANT_DASH),
    ):
        height = similarity - data.behaviour_similarity
        axes.plot(data.nu, height, color=GREY, linewidth=1.1, linestyle=dash, zorder=1.6)
    nus = sorted(set(analysis.offline.nu))
    apart = min((b - a for a, b in itertools.pairwise(nus)), default=1.0)
    for index, (name, look) in enumerate(looks.items()):
        shift = (index - (len(looks) - 1) / 2) * 0.25 * apart / len(looks)
        selected, each = rows[rows.learner == name], runs[runs.learner == name]
        at, enough = selected.nu + shift, selected.runs >= ENOUGH_RUNS
        panels.marks(axes, selected, "improvement", at, enough, look, upright=True, joined=True)
        axes.plot(
            each.nu + shift, each.improvement, **look.points, markersize=2.5, markeredgewidth=0.0,
            alpha=0.5, zorder=3.5,
        )  # fmt: skip
    axes.set_title(literal(class_name))


def _caption(analysis: Analysis) -> str:
    few = analysis.offline.runs.min()
    caption = (
        "A small mark is a run, a large one the mean over runs: similarity of the learner minus "
        "that of the policy that made its data."
    )
    if not analysis.offline.low.isna().all():
        caption += " Bars are 95 % bootstrap intervals of the mean."
    if few < OFFLINE_INTERVAL:
        caption += f" With fewer than {OFFLINE_INTERVAL} runs there is no interval."
    if few < ENOUGH_RUNS:
        caption += f" Hollow: fewer than {ENOUGH_RUNS} runs, an indication only."
    return caption
