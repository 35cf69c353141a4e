"""The figures of a study's report, drawn from its frames, each as bytes in every requested format.

They have the width of a printed page. An algorithm has one colour, marker and dash in all
of them; a hollow marker stands for fewer than `ENOUGH_RUNS` runs, bars for 95 % intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.figures import comparisons, curves, maps, streams
from sme_registry.studies.report.figures.panels import Picture

__all__ = ["Picture", "draw_figures"]

# Why there is no figure of a table that is empty.
_REASONS = {
    "contrasts": "No contrasts: they need finished runs of one number on the first class and on "
    "another.",
    "aggregates": "No aggregates over classes and no performance profiles: no class has runs of "
    "every algorithm.",
    "improvements": "No comparison of algorithms: no two of them have runs on the same classes "
    "and, if they learn from data, the same data.",
    "learning_curves": "No learning curves: the plan has no evaluations during training.",
}


def draw_figures(
    analysis: Analysis, formats: Sequence[str], models: Mapping[str, Path]
) -> tuple[list[Picture], list[str]]:
    """Draw every figure that the finished runs allow."""
    pictures, reasons = _draw_tasks(analysis, formats, models) if analysis.algorithms else ([], [])
    return [*pictures, *streams.draw_streams(analysis, formats)], reasons


def _draw_tasks(
    analysis: Analysis, formats: Sequence[str], models: Mapping[str, Path]
) -> tuple[list[Picture], list[str]]:
    """The figures of runs on single tasks."""
    plane = maps.draw_maps(analysis, formats, models)
    pictures = [
        *comparisons.draw_contrasts(analysis, formats),
        *curves.draw_regret(analysis, formats),
        *comparisons.draw_agents(analysis, formats),
        maps.draw_regions(analysis, formats),
        comparisons.draw_decay(analysis, formats),
        *comparisons.draw_aggregates(analysis, formats),
        *curves.draw_profiles(analysis, formats),
        *comparisons.draw_improvements(analysis, formats),
        *comparisons.draw_differences(analysis, formats),
        *curves.draw_class_curves(analysis, formats),
        *curves.draw_learning_curves(analysis, formats),
        *([plane] if isinstance(plane, Picture) else ()),
        *curves.draw_offline(analysis, formats),
    ]
    if not analysis.tables["levels"].empty and analysis.tables["levels"].runs.min() == 1:
        pictures = [_with_single_runs(picture) for picture in pictures]
    reasons = [reason for table, reason in _REASONS.items() if analysis.tables[table].empty]
    return pictures, reasons if isinstance(plane, Picture) else [*reasons, plane]


def _with_single_runs(picture: Picture) -> Picture:
    """The picture, whose caption says that a single run has no interval, if it has intervals."""
    if not any(words in picture.caption for words in ("95 %", "interquartile")):
        return picture
    return replace(picture, caption=f"{picture.caption} A single run has no interval.")
