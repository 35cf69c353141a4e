"""The share of runs above each value of 1 − normalised regret."""

from __future__ import annotations

from collections.abc import Sequence

from sme_registry.plots import literal
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Picture
from sme_registry.studies.report.tables import Metric


def draw_profiles(analysis: Analysis, formats: Sequence[str], metric: Metric) -> Picture | str:
    """One panel a group of classes; a sentence where no class can be compared."""
    rows = analysis.profiles[analysis.profiles.metric == metric.key]
    if rows.empty:
        return "No performance profiles: no class has runs of every algorithm."
    groups = list(dict.fromkeys(rows.group))
    looks = panels.looks(analysis)
    with panels.panel_grid(len(groups), formats, (0.7, 2.1), share_x=True) as (grid, files):
        for axes, group in zip(grid.panels, groups, strict=True):
            for name, profile in rows[rows.group == group].groupby("algorithm", sort=False):
                look, tau = looks[name], profile.threshold
                axes.fill_between(
                    tau, profile.low, profile.high, color=look.colour, alpha=0.15, linewidth=0
                )
                axes.plot(
                    tau, profile.share, **look.line, linewidth=1.6, markersize=3.5,
                    markevery=(5, 20),
                )  # fmt: skip
            axes.set_title(literal(group), fontsize=9)
            axes.set_ylim(-0.02, 1.02)
            axes.set_xlim(0.0, 1.0)
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        grid.label_rows("share of runs above τ")
        grid.label_columns("τ (1 − normalised regret)")
        panels.legend(grid.figure, {name: looks[name] for name in analysis.algorithms})
    return Picture(
        f"profiles-{metric.key.removesuffix('_regret')}",
        f"Performance profiles {panels.HEADINGS[metric.key]}",
        "The share of runs whose 1 − normalised regret is above τ, classes counting alike, with "
        "pointwise 95 % bands. A line above another is better at every τ.",
        files,
    )
