"""Figures of the streams of a study: what lives cost and retain, and whether agents still learn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from sme_registry.evaluation.retention import LABELS
from sme_registry.evaluation.stream_report import Visit
from sme_registry.plots.streams import (
    MATRIX_SCALE,
    draw_matrix,
    performance_curve,
    shade_visits,
    tick_visits,
)
from sme_registry.plots.style import GREY, legend_below, literal
from sme_registry.studies.report.analysis import CURVES, ENOUGH_RUNS, Analysis
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.curves import curves_caption, draw_lines, step_text
from sme_registry.studies.report.figures.panels import CONSTANT, Look, Picture
from sme_registry.studies.report.lives import METRICS, WITHIN
from sme_registry.studies.report.texts import slug

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = ("average_performance", "forgetting", "plasticity_ratio", "learning_transfer")
_NEUTRAL = {"plasticity_ratio": 1.0}  # of a metric; 0 for all others
_MEASURE = "regret"
_HEIGHTS = 0.9, 2.3  # inches: of the rest, and of a row of panels
_INTERVAL = (
    "IQM over lives with its 95 % bootstrap interval, within distribution. "
    f"Hollow: fewer than {ENOUGH_RUNS} lives, so that the interval is an indication only."
)
_BESIDE = {  # a life, in the colour of its algorithm
    "fresh": ("fresh agents", Look(GREY, "", (0, (5, 1.2, 1, 1.2)))),
    "frozen": (LABELS["frozen_agent"], Look(GREY, "", (0, (2.5, 1.2)))),
}
_REFERENCES = {
    "frozen_optimum": Look(GREY, "", (0, (1, 1.2))),
    "constant_half": CONSTANT,
}
_QUARTILES = "Median over lives, with the interquartile range as a band."


def draw_streams(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """Every figure of the finished lives; none without one."""
    if not analysis.lives:
        return
    names = dict.fromkeys((*analysis.learners, *analysis.stream_algorithms))
    present = analysis.stream_algorithms
    looks = {a: look for a, look in panels.numbered_looks(names).items() if a in present}
    yield _draw_metrics(analysis, formats, looks)
    yield _draw_regret(analysis, formats, looks)
    yield from _draw_plasticity(analysis, formats, looks)
    for name in _lived(analysis):
        yield _draw_retention(analysis, formats, name)
        yield _draw_performance(analysis, formats, name)
    yield from _draw_learning_curves(analysis, formats, looks)


def _draw_metrics(analysis: Analysis, formats: Sequence[str], looks: Mapping[str, Look]) -> Picture:
    """The metrics of whole lives, one panel a metric and one row a stream."""
    rows = analysis.tables["stream_metrics"]
    rows = rows[rows.region == WITHIN]
    rows = rows.assign(place=rows.class_name, enough=rows.runs >= ENOUGH_RUNS)
    columns = [
        panels.Column(
            rows[rows.metric == metric.key],
            f"{metric.label}\n({'less' if metric.worse > 0 else 'more'} is better)",
            neutral=_NEUTRAL.get(metric.key, 0.0),
            ticks=4,
        )
        for metric in METRICS
        if metric.key in _SHOWN and metric.key in set(rows.metric)
    ]
    places = {name: float(i) for i, name in enumerate(_lived(analysis))}
    return Picture(
        "stream-metrics",
        "Performance, forgetting and plasticity of whole lives",
        f"{_INTERVAL} Black lines: the constant ½, no forgetting, and as good as a fresh agent.",
        panels.mark_rows(columns, "iqm", places, looks, formats, most_across=4),
    )


def _draw_regret(analysis: Analysis, formats: Sequence[str], looks: Mapping[str, Look]) -> Picture:
    """The dynamic regret over the lifetime, one panel a stream."""
    looks = {algorithm: look._replace(dash="-") for algorithm, look in looks.items()}
    regret, references = (analysis.tables[f"stream_{n}"] for n in ("regret", "reference_regret"))
    with panels.panel_grid(len(_lived(analysis)), formats, _HEIGHTS) as grid:
        for axes, name in zip(grid.panels, _lived(analysis), strict=True):
            rows = regret[regret.class_name == name]
            for algorithm, look in looks.items():
                curve = rows[rows.algorithm == algorithm]
                for column, (_, beside) in _BESIDE.items():
                    line = look._replace(marker="", dash=beside.dash).line
                    axes.plot(curve.lifetime, curve[column], **line, linewidth=1.1, zorder=2.5)
            draw_lines(axes, rows, "algorithm", looks, "lifetime")
            for reference, curve in references[references.class_name == name].groupby("reference"):
                look = _REFERENCES[str(reference)]
                axes.plot(curve.lifetime, curve["median"], **look.line, linewidth=1.1, zorder=1.5)
            _finish_lifetime(axes, analysis, name)
            axes.yaxis.set_major_formatter(step_text)
        grid.label_rows("dynamic regret  (Σ of 1 − r)")
        known = {column for column in _BESIDE if regret[column].notna().any()}
        beside_looks = dict(_BESIDE[column] for column in _BESIDE if column in known)
        drawn = {LABELS[name]: look for name, look in _REFERENCES.items()
                 if name in set(references.reference)}  # fmt: skip
        panels.legend(grid.figure, {**looks, **beside_looks, **drawn})
    caption = (
        f"{_QUARTILES} The regret of every step, summed over the lifetime; shades and numbers "
    )
    caption += "above are visits and their phases. Grey: agents that need no training."
    if "fresh" in known:
        caption += (
            " Dash-dotted, in the colour of the algorithm: agents that start anew in each visit, "
            "spread evenly over it. A life below that line learns faster than fresh agents."
        )
    if "frozen" in known:
        caption += (
            " Dashed, in the colour of the algorithm: the same agents if they stop learning after "
            "visit 0. A life above that line lost by learning on."
        )
    return Picture("stream-regret", "Dynamic regret", caption, grid.files)


def _draw_plasticity(
    analysis: Analysis, formats: Sequence[str], looks: Mapping[str, Look]
) -> Iterator[Picture]:
    """The plasticity ratio by visit, one panel a stream."""
    rows = analysis.tables["stream_visit_metrics"]
    rows = rows[(rows.region == WITHIN) & (rows.metric == "plasticity_ratio")]
    names = [name for name in _lived(analysis) if name in set(rows.class_name)]
    if not names:
        return
    with panels.panel_grid(len(names), formats, _HEIGHTS) as grid:
        for axes, name in zip(grid.panels, names, strict=True):
            selected = rows[rows.class_name == name]
            for algorithm, look, shift in panels.side_by_side(looks, 0.4):
                own = selected[selected.algorithm == algorithm]
                enough = own.runs >= ENOUGH_RUNS
                panels.marks(
                    axes, own, "iqm", own.visit + shift, enough, look, upright=True, joined=True
                )
            axes.axhline(1.0, color="black", linewidth=0.9, zorder=1.5)
            tick_visits(axes, _visits(analysis, name))
            axes.set_xlabel("visit of phase")
            axes.set_title(literal(name))
        grid.label_rows("plasticity ratio")
        panels.legend(grid.figure, looks)
    yield Picture(
        "stream-plasticity",
        "Plasticity by visit",
        "Normalised regret on the phase just visited, divided by that of a fresh agent after as "
        f"many steps on that phase alone: above 1, plasticity was lost. {_INTERVAL} In its first "
        "visit a life is a fresh agent itself: other values than 1 say nothing about plasticity.",
        grid.files,
    )


def _draw_retention(analysis: Analysis, formats: Sequence[str], name: str) -> Picture:
    """The retention matrices of one stream, one panel an algorithm."""
    rows = analysis.tables["stream_matrices"]
    rows = rows[(rows.region == WITHIN) & (rows.class_name == name)]
    names = [
        algorithm for algorithm in analysis.stream_algorithms if algorithm in set(rows.algorithm)
    ]
    visits, top = _visits(analysis, name), max(1.0, rows.iqm.max())
    initial = int(rows.visit.isna().any())
    labels = [*["initial"] * initial, *(f"visit {visit.visit}" for visit in visits)]
    visited = [(visit.visit + initial, visit.phase) for visit in visits]
    height = 0.55 + 0.24 * max(4, min(len(labels), 30))
    with panels.panel_grid(len(names), formats, (1.0, height), share_x=True) as grid:
        for axes, algorithm in zip(grid.panels, names, strict=True):
            own = rows[rows.algorithm == algorithm].assign(visit=lambda r: r.visit.fillna(-1))
            M = own.pivot(index="visit", columns="phase", values="iqm").to_numpy()
            image = draw_matrix(axes, M, visited, labels, top)
            axes.set_title(literal(algorithm))
        grid.label_rows("policy at the end of")
        grid.label_columns("on the task of phase")
        bar = grid.figure.colorbar(
            image, ax=grid.panels, location="bottom", shrink=0.5, aspect=40, pad=0.02,
            label=MATRIX_SCALE.replace("\n", " "),
        )  # fmt: skip
        bar.outline.set_visible(False)
    return Picture(
        f"stream-retention-{slug(name)}",
        f"Retention in {name}",
        "Normalised regret of the policy at the end of each visit (rows) on the task of each phase "
        "(columns), within distribution: IQM over lives. The phase just visited is outlined: below "
        "it one sees what is forgotten, above it what was known before.",
        grid.files,
        is_map=True,
    )


def _draw_performance(analysis: Analysis, formats: Sequence[str], name: str) -> Picture:
    """Performance on each phase over the visits of one stream, one panel an algorithm."""
    reports = {
        algorithm: [life.report for life in analysis.lives
                    if (life.planned.class_name, life.planned.algorithm) == (name, algorithm)]
        for algorithm in analysis.stream_algorithms
    }  # fmt: skip
    reports = {algorithm: each for algorithm, each in reports.items() if each}
    with panels.panel_grid(len(reports), formats, (0.9, 2.4), share_x=True) as grid:
        for axes, (algorithm, each) in zip(grid.panels, reports.items(), strict=True):
            performance_curve(each, ax=axes)
            axes.set_ylabel("")
            axes.set_title(literal(algorithm))
        grid.label_rows("performance")
        grid.label_columns("visit of phase")
        handles, _ = grid.panels[0].get_legend_handles_labels()
        legend_below(grid.figure, handles)
    return Picture(
        f"stream-performance-{slug(name)}",
        f"Performance on each phase of {name}",
        "1 − normalised regret within distribution on the task of each phase, after each visit: "
        "IQM over lives with quartiles. Filled marks: the phase was just visited.",
        grid.files,
    )


def _draw_learning_curves(
    analysis: Analysis, formats: Sequence[str], looks: Mapping[str, Look]
) -> Iterator[Picture]:
    """Regret per step over the lifetime, evaluated on the task in force, one panel a stream."""
    rows = analysis.tables["stream_learning_curves"]
    rows = rows[rows.measure == _MEASURE]
    names = [name for name in _lived(analysis) if name in set(rows.class_name)]
    if not names:
        return
    with panels.panel_grid(len(names), formats, _HEIGHTS) as grid:
        for axes, name in zip(grid.panels, names, strict=True):
            draw_lines(axes, rows[rows.class_name == name], "algorithm", looks)
            _finish_lifetime(axes, analysis, name)
        grid.label_rows(CURVES[_MEASURE])
        panels.legend(grid.figure, looks)
    yield Picture(
        "stream-learning-curves",
        "Learning curves of lives",
        f"{curves_caption(rows)} Mean exact regret per step in evaluations during training, on the "
        "task in force. Shades and numbers above are visits and their phases.",
        grid.files,
    )


def _finish_lifetime(axes: Axes, analysis: Analysis, name: str) -> None:
    """Visits as bands, the name of the stream above them, and ticks of steps."""
    visits = _visits(analysis, name)
    axes.set_xlim(0.0, visits[-1].lifetime)
    shade_visits(axes, visits)
    axes.set_title(literal(name), pad=14.0)
    axes.set_xlabel("lifetime (steps)")
    axes.locator_params(axis="x", nbins=4)
    axes.xaxis.set_major_formatter(step_text)


def _lived(analysis: Analysis) -> list[str]:
    """The streams with a finished life, in the plan's order."""
    present = {life.planned.class_name for life in analysis.lives}
    return [name for name in analysis.streams if name in present]


def _visits(analysis: Analysis, name: str) -> Sequence[Visit]:
    """The visits of a stream's lives."""
    return next(life.report.visits for life in analysis.lives if life.planned.class_name == name)
