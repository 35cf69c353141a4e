"""Figures of the streams of a study: what lives cost and retain, and whether agents still learn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import pandas as pd

from sme_registry.evaluation import StreamReport
from sme_registry.evaluation.retention import LABELS
from sme_registry.evaluation.streams import Visit
from sme_registry.plots.curves import performance_curve, shade_visits, tick_visits
from sme_registry.plots.maps import MATRIX_SCALE, draw_matrix
from sme_registry.plots.style import GREY, legend_below
from sme_registry.studies.report.analysis import CURVES, OF_LIVES, WITHIN, Analysis
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import CONSTANT, Look, Picture, new_look, panel_grid
from sme_registry.studies.report.texts import slug

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN = ("average_performance", "forgetting", "plasticity_ratio", "learning_transfer")
_HEIGHTS = 0.9, 2.3  # inches: of the rest, and of a row of panels
_PAD = 14.0  # points between panels and titles, for the phases
_INTERVAL = (
    "IQM over lives with its 95 % bootstrap interval, within distribution. "
    f"{panels.FEW} lives, {panels.INDICATION}"
)
_BESIDE = {  # a life, in the colour of its algorithm: label, look, caption
    "fresh": (
        "fresh agents", new_look(GREY, dash=(0, (5, 1.2, 1, 1.2))),
        " Dash-dotted, in the colour of the algorithm: agents that start anew in each visit, "
        "spread evenly over it. A life below that line learns faster than fresh agents.",
    ),
    "frozen": (
        LABELS["frozen_agent"], new_look(GREY, dash=(0, (2.5, 1.2))),
        " Dashed, in the colour of the algorithm: the same agents if they stop learning after "
        "visit 0. A life above that line lost by learning on.",
    ),
}  # fmt: skip
_REFERENCES = {"frozen_optimum": new_look(GREY, dash=(0, (1, 1.2))), "constant_half": CONSTANT}


def draw_metrics(analysis: Analysis) -> Iterator[Picture]:
    """The metrics of whole lives, one panel a metric and one row a stream."""
    rows = _within(analysis.tables["stream_metrics"])
    columns = [
        panels.MarkColumn(
            metric.key,
            f"{metric.label}\n({'less' if metric.worse > 0 else 'more'} is better)",
            neutral=1.0 if metric.key == "plasticity_ratio" else 0.0,
        )
        for metric in OF_LIVES
        if metric.key in _SHOWN and metric.key in set(rows.metric)
    ]
    places = {name: float(i) for i, name in enumerate(_lived(analysis))}
    yield Picture(
        "stream-metrics",
        "Performance, forgetting and plasticity of whole lives",
        f"{_INTERVAL} Black lines: the constant ½, no forgetting, and as good as a fresh agent.",
        panels.mark_rows(rows, "iqm", columns, "class_name", places, _looks(analysis)),
    )


def draw_regret(analysis: Analysis) -> Iterator[Picture]:
    """The dynamic regret over the lifetime, one panel a stream."""
    looks = {name: {**look, "linestyle": "-"} for name, look in _looks(analysis).items()}
    regret, references = (analysis.tables[f"stream_{n}"] for n in ("regret", "reference_regret"))

    def draw_stream(axes: Axes, name: str) -> None:
        rows = regret[regret.class_name == name]
        for algorithm, look in looks.items():
            curve = rows[rows.algorithm == algorithm]
            for column, (_, beside, _) in _BESIDE.items():
                style = {**beside, "color": look["color"]}
                axes.plot(curve.lifetime, curve[column], **style, linewidth=1.1, zorder=2.5)
        panels.draw_lines(axes, rows, "algorithm", looks, "lifetime")
        for reference, curve in references[references.class_name == name].groupby("reference"):
            line = _REFERENCES[str(reference)]
            axes.plot(curve.lifetime, curve["median"], **line, linewidth=1.1, zorder=1.5)
        _finish_lifetime(axes, analysis, name)
        axes.yaxis.set_major_formatter(panels.step_text)

    beside = [_BESIDE[column] for column in _BESIDE if regret[column].notna().any()]
    drawn = {LABELS[n]: look for n, look in _REFERENCES.items() if n in set(references.reference)}
    named = {**looks, **{label: look for label, look, _ in beside}, **drawn}
    figure = panel_grid(
        _named(_lived(analysis)), draw_stream, _HEIGHTS, x="lifetime (steps)",
        y="dynamic regret  (Σ of 1 − r)", looks=named, title_pad=_PAD,
    )  # fmt: skip
    caption = (
        "Median over lives, with the interquartile range as a band. The regret of every step, "
        "summed over the lifetime; shades and numbers above are visits and their phases. Grey: "
        "agents that need no training."
    ) + "".join(text for *_, text in beside)
    yield Picture("stream-regret", "Dynamic regret", caption, figure)


def draw_plasticity(analysis: Analysis) -> Iterator[Picture]:
    """The plasticity ratio by visit, one panel a stream."""
    rows = _within(analysis.tables["stream_visit_metrics"])
    rows = rows[rows.metric == "plasticity_ratio"]
    if rows.empty:
        return
    looks = _looks(analysis)

    def draw_stream(axes: Axes, name: str) -> None:
        for algorithm, look, shift in panels.side_by_side(looks, 0.4):
            lives = rows[(rows.class_name == name) & (rows.algorithm == algorithm)]
            panels.marks(axes, lives, "iqm", lives.visit + shift, look, upright=True, joined=True)
        axes.axhline(1.0, color="black", linewidth=0.9, zorder=1.5)
        tick_visits(axes, _visits(analysis, name))

    names = [name for name in _lived(analysis) if name in set(rows.class_name)]
    figure = panel_grid(
        _named(names), draw_stream, _HEIGHTS, x="visit of phase", y="plasticity ratio", looks=looks
    )
    yield Picture(
        "stream-plasticity",
        "Plasticity by visit",
        "Normalised regret on the phase just visited, divided by that of a fresh agent after as "
        f"many steps on that phase alone: above 1, plasticity was lost. {_INTERVAL} In its first "
        "visit a life is a fresh agent itself: other values than 1 say nothing about plasticity.",
        figure,
    )


def draw_retention(analysis: Analysis) -> Iterator[Picture]:
    """The retention matrices of each stream, one panel an algorithm."""
    for name in _lived(analysis):
        rows = _within(analysis.tables["stream_matrices"])
        rows = rows[rows.class_name == name]
        yield Picture(
            f"stream-retention-{slug(name)}",
            f"Retention in {name}",
            "Normalised regret of the policy at the end of each visit (rows) on the task of each "
            "phase (columns), within distribution: IQM over lives. The phase just visited is "
            "outlined: below it one sees what is forgotten, above it what was known before.",
            _retention(rows, _visits(analysis, name)),
            is_map=True,
        )


def _retention(rows: pd.DataFrame, visits: Sequence[Visit]) -> Figure:
    top, initial = max(1.0, rows.iqm.max()), int(rows.visit.isna().any())
    labels = [*["initial"] * initial, *(f"visit {visit.visit}" for visit in visits)]
    visited = [(visit.visit + initial, visit.phase) for visit in visits]

    def draw_agent(axes: Axes, of_agent: pd.DataFrame) -> None:
        of_agent = of_agent.assign(visit=of_agent.visit.fillna(-1))
        M = of_agent.pivot(index="visit", columns="phase", values="iqm").to_numpy()
        draw_matrix(axes, M, visited, labels, top)

    height = 0.55 + 0.24 * max(4, min(len(labels), 30))
    figure = panel_grid(
        panels.by(rows, "algorithm"), draw_agent, (1.0, height), x="on the task of phase",
        y="policy at the end of", share_x=True,
    )  # fmt: skip
    label = MATRIX_SCALE.replace("\n", " ")
    panels.colour_bar(figure, figure.axes[0].images[0], label)
    return figure


def draw_performance(analysis: Analysis) -> Iterator[Picture]:
    """Performance on each phase over the visits of each stream, one panel an algorithm."""
    for name in _lived(analysis):
        reports: dict[str, list[StreamReport]] = {}
        for life in analysis.lives:
            if life.planned.class_name == name:
                reports.setdefault(life.planned.algorithm, []).append(life.report)
        figure = panel_grid(
            reports.items(), lambda axes, of_agent: performance_curve(of_agent, ax=axes),
            (0.9, 2.4), x="visit of phase", y="performance", share_x=True,
        )  # fmt: skip
        legend_below(figure, figure.axes[0].get_legend_handles_labels()[0])
        yield Picture(
            f"stream-performance-{slug(name)}",
            f"Performance on each phase of {name}",
            "1 − normalised regret within distribution on the task of each phase, after each "
            "visit: IQM over lives with quartiles. Filled marks: the phase was just visited.",
            figure,
        )


def draw_learning_curves(analysis: Analysis) -> Iterator[Picture]:
    """Regret per step over the lifetime, evaluated on the task in force, one panel a stream."""
    rows = analysis.tables["stream_learning_curves"]
    rows = rows[rows.measure == "regret"]
    if rows.empty:
        return
    looks = _looks(analysis)

    def draw_stream(axes: Axes, name: str) -> None:
        panels.draw_lines(axes, rows[rows.class_name == name], "algorithm", looks)
        _finish_lifetime(axes, analysis, name)

    names = [name for name in _lived(analysis) if name in set(rows.class_name)]
    figure = panel_grid(
        _named(names), draw_stream, _HEIGHTS, x="lifetime (steps)", y=CURVES["regret"],
        looks=looks, title_pad=_PAD,
    )  # fmt: skip
    yield Picture(
        "stream-learning-curves",
        "Learning curves of lives",
        f"{panels.curves_caption(rows)} Mean exact regret per step in evaluations during training, "
        "on the task in force. Shades and numbers above are visits and their phases.",
        figure,
    )


FIGURES = (
    draw_metrics, draw_regret, draw_plasticity, draw_retention, draw_performance,
    draw_learning_curves,
)  # fmt: skip


def _finish_lifetime(axes: Axes, analysis: Analysis, name: str) -> None:
    """Visits as bands, with their phases above, and ticks of steps."""
    visits = _visits(analysis, name)
    panels.tick_steps(axes)
    axes.set_xlim(0.0, visits[-1].lifetime)
    shade_visits(axes, visits)


def _looks(analysis: Analysis) -> dict[str, Look]:
    """The looks of the algorithms that have lives; as in the figures of single tasks."""
    names = dict.fromkeys((*analysis.learners, *analysis.stream_algorithms))
    looks = panels.numbered_looks(names)
    return {name: looks[name] for name in names if name in analysis.stream_algorithms}


def _within(rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows.region == WITHIN]


def _named(names: Sequence[str]) -> list[tuple[str, str]]:
    return [(name, name) for name in names]


def _lived(analysis: Analysis) -> list[str]:
    """The streams with a finished life, in the plan's order."""
    present = {life.planned.class_name for life in analysis.lives}
    return [name for name in analysis.streams if name in present]


def _visits(analysis: Analysis, name: str) -> Sequence[Visit]:
    return next(life.report.visits for life in analysis.lives if life.planned.class_name == name)
