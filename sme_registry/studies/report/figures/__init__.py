"""The figures of a study's report, drawn from its frames, each as bytes in every requested format.

They have the width of a printed page. An algorithm has one colour, marker and dash in all
of them; a hollow marker stands for fewer than `ENOUGH_RUNS` runs, bars for 95 % intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.figures.aggregates import draw_aggregates
from sme_registry.studies.report.figures.contrasts import draw_contrasts
from sme_registry.studies.report.figures.decay import draw_decay
from sme_registry.studies.report.figures.improvements import draw_improvements
from sme_registry.studies.report.figures.learning_curves import draw_learning_curves
from sme_registry.studies.report.figures.maps import draw_maps
from sme_registry.studies.report.figures.offline import draw_offline
from sme_registry.studies.report.figures.panels import Picture
from sme_registry.studies.report.figures.profiles import draw_profiles
from sme_registry.studies.report.figures.regions import draw_regions
from sme_registry.studies.report.figures.regret import draw_regret
from sme_registry.studies.report.tables import METRICS, REGRET_METRICS

__all__ = ["Picture", "draw_figures"]


def draw_figures(
    analysis: Analysis, formats: Sequence[str], models: Mapping[str, Path]
) -> tuple[list[Picture], list[str]]:
    """Draw every figure that the finished runs allow.

    Args:
      analysis: the tables.
      formats: of `plots.FORMATS`.
      models: paths of kept models by the digests of their cells. They are loaded.

    Returns:
      The figures, and a sentence for each that cannot be drawn.

    Raises:
      MissingDependencyError: Matplotlib is not installed.
    """
    results = (
        draw_contrasts(analysis, formats, METRICS[:3], "contrasts-regret"),
        draw_contrasts(analysis, formats, METRICS[3:], "contrasts-training"),
        *(draw_regret(analysis, formats, metric) for metric in REGRET_METRICS),
        draw_regions(analysis, formats),
        draw_decay(analysis, formats),
        draw_aggregates(analysis, formats),
        *(draw_profiles(analysis, formats, metric) for metric in REGRET_METRICS),
        draw_improvements(analysis, formats),
        *draw_learning_curves(analysis, formats),
        draw_maps(analysis, formats, models),
        *draw_offline(analysis, formats),
    )
    pictures = [picture for picture in results if isinstance(picture, Picture)]
    return pictures, [reason for reason in results if isinstance(reason, str)]
