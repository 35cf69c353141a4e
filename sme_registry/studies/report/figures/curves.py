"""Figures of curves: along each axis, of training, of learning from data, and of streams."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import pandas as pd

from sme_registry.evaluation import StreamReport
from sme_registry.evaluation.retention import LABELS
from sme_registry.evaluation.streams import Visit
from sme_registry.plots.curves import performance_curve, shade_visits, tick_visits
from sme_registry.plots.maps import MATRIX_SCALE, draw_matrix
from sme_registry.plots.style import GREY, legend_below, literal, shades
from sme_registry.studies.report.analysis import (
    CURVES,
    OFFLINE_INTERVAL,
    Analysis,
    training_data,
)
from sme_registry.studies.report.design import (
    SEVERAL,
    WITHIN,
    Group,
    metrics_of,
    setting_label,
)
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import FEW, INDICATION, Drawn, Look, Picture
from sme_registry.studies.report.texts import slug

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BEHAVIOUR, _OPTIMUM = panels.new_look("black"), panels.new_look(GREY, dash=(0, (1, 1.2)))
_HEIGHTS = 0.9, 2.3  # inches: of the rest, and of a row of panels
_PAD = 14.0  # points between panels and titles, for the phases
OVER_LIVES = (
    "IQM over lives with its 95 % bootstrap interval, within distribution. "
    f"{FEW} lives, {INDICATION}"
)
_BESIDE = {  # a life, in the colour of its algorithm: label, look, caption
    "fresh": (
        "fresh agents", panels.new_look(GREY, dash=(0, (5, 1.2, 1, 1.2))),
        " Dash-dotted, in the colour of the algorithm: agents that start anew in each visit, "
        "spread evenly over it. A life below that line has less regret than fresh agents.",
    ),
    "frozen": (
        LABELS["frozen_agent"], panels.new_look(GREY, dash=(0, (2.5, 1.2))),
        " Dashed, in the colour of the algorithm: the same agents if they stop learning after "
        "visit 0. A life above that line lost by learning on.",
    ),
}  # fmt: skip
_REFERENCES = {"frozen_optimum": _OPTIMUM, "constant": panels.CONSTANT}


def draw_regret(analysis: Analysis) -> Drawn:
    """Normalised regret along each axis: WD and OOD in one figure for a single axis, else two."""
    caption = (
        "IQM over runs with its 95 % bootstrap interval: 0 is the optimum, 1 the constant action "
        f"½, the dashed line the linear least-squares policy fitted to the optimum. {FEW} runs."
    )
    remark, groups = panels.epsilon_remark(analysis), _axis_groups(analysis)
    metrics = metrics_of("score")
    if len(groups) == 1 and groups[0].axis not in ("", SEVERAL):
        (group,) = groups
        log = ", log scale" if panels.spacing(group.values) == "log" else ""
        items = [(metric.label, group, metric.key) for metric in metrics]
        yield Picture(
            f"regret-{group.axis.replace('.', '-')}",
            f"Normalised regret along the {group.name}",
            caption + remark,
            _regret_panels(analysis, items, x=literal(group.name) + log),
        )
        return
    for metric in metrics:
        yield Picture(
            slug(metric.key),
            f"{metric.label} along each axis",
            caption + remark,
            _regret_panels(analysis, [(group.name, group, metric.key) for group in groups]),
        )


def _regret_panels(
    analysis: Analysis, items: Sequence[tuple[str, Group, str]], x: str = ""
) -> Figure:
    looks = panels.looks_of(analysis, analysis.learners or analysis.algorithms)
    figure = panels.grid(
        [(title, (group, metric)) for title, group, metric in items],
        lambda axes, item: _draw_axis(axes, analysis, *item, looks), (0.9, 2.3),
        x=x, y="normalised regret",
        looks={**looks, "linear (LSQ)": panels.LINEAR, "constant ½": panels.CONSTANT},
    )  # fmt: skip
    # From 0, with headroom in proportion. Last: it ends autoscaling, for all panels.
    first = figure.axes[0]
    first.update_datalim([(0.0, 0.0)], updatex=False)
    first.autoscale_view(scalex=False)
    first.set_ylim(bottom=0.0)
    return figure


def _draw_axis(
    axes: Axes, analysis: Analysis, group: Group, metric: str, looks: Mapping[str, Look]
) -> None:
    """The classes of one axis, in the order of its values."""
    kind = panels.spacing(group.values)
    places = panels.positions(group.values, len(group.classes))
    labels = [literal(label) for label in _class_labels(group)]
    distance = panels.tick_classes(axes, places, labels, nominal=kind == "nominal")
    x = dict(zip(group.classes, places, strict=True))
    levels = analysis.rows("levels", metric=metric)
    levels = levels[levels.class_name.isin(x)]
    levels = levels.assign(at=levels.class_name.map(x)).sort_values("at", kind="stable")
    linear = levels.drop_duplicates("class_name", keep="last")
    look = panels.LINEAR if group.axis not in ("", SEVERAL) else panels.new_look(GREY, "_", "none")
    axes.plot(linear["at"], linear.linear, **look, linewidth=1.2, markersize=14, zorder=1.6)
    axes.axhline(1.0, color=GREY, linewidth=1.2, linestyle=panels.CONSTANT["linestyle"], zorder=1.6)
    joined = kind != "nominal"
    panels.marks(axes, levels, "iqm", looks, 0.5 * distance, upright=True, joined=joined)


def draw_profiles(analysis: Analysis) -> Drawn:
    looks = panels.looks_of(analysis)

    def draw_group(axes: Axes, rows: pd.DataFrame) -> None:
        for name, profile in rows.groupby("algorithm", sort=False):
            columns = profile[["threshold", "low", "share", "high"]]
            panels.line_with_band(axes, columns, looks[str(name)], (5, 20))
        axes.set_ylim(-0.02, 1.02)
        axes.set_xlim(0.0, 1.0)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")

    for metric in metrics_of("score"):
        rows = analysis.rows("profiles", metric=metric.key)
        if rows.empty:
            continue
        figure = panels.grid(
            panels.by(rows, "group"), draw_group, (0.7, 2.1), x=f"τ (1 − {metric.label})",
            y="share of runs above τ", looks=looks, share_x=True,
        )  # fmt: skip
        yield Picture(
            f"profiles-{metric.key.removesuffix('_regret')}",
            f"Performance profiles of {metric.label}",
            f"The share of runs whose 1 − {metric.label} is above τ, classes counting alike, with "
            "pointwise 95 % bands. A line above another is better at every τ.",
            figure,
        )


def draw_class_curves(analysis: Analysis) -> Drawn:
    rows = analysis.rows("learning_curves", measure="regret")
    rows = rows[rows.algorithm.isin(analysis.learners)]
    looks = panels.looks_of(analysis, rows.algorithm)
    if len(looks) < 2:
        return

    def draw_class(axes: Axes, of_class: pd.DataFrame) -> None:
        panels.draw_lines(axes, of_class, "algorithm", looks)
        panels.tick_steps(axes)

    labels = {
        name: f"{name} ({c.label})".removesuffix(" ()") for name, c in analysis.classes.items()
    }
    items = [(labels[name], of_class) for name, of_class in panels.by(rows, "class_name")]
    yield Picture(
        "learning-curves-by-class",
        "Learning curves of all algorithms by class",
        f"{panels.curves_caption(rows)} Mean exact regret per step, 0 for the optimum.",
        panels.grid(items, draw_class, (0.8, 1.9), x="steps", y=CURVES["regret"], looks=looks),
    )


def draw_lifetime_curves(analysis: Analysis) -> Drawn:
    rows = analysis.rows("stream_learning_curves", measure="regret")
    if rows.empty:
        return
    looks = panels.looks_of(analysis, rows.algorithm)

    def draw_stream(axes: Axes, of_stream: pd.DataFrame) -> None:
        panels.draw_lines(axes, of_stream, "algorithm", looks)
        _finish_lifetime(axes, analysis, of_stream.class_name.iloc[0])

    yield Picture(
        "stream-learning-curves",
        "Learning curves of lives",
        f"{panels.curves_caption(rows)} Mean exact regret per step in evaluations during training, "
        "on the task in force. Shades and numbers above are visits and their phases.",
        panels.grid(
            panels.by(rows, "class_name"), draw_stream, _HEIGHTS, x="lifetime (steps)",
            y=CURVES["regret"], looks=looks, title_pad=_PAD,
        ),
    )  # fmt: skip


def draw_learning_curves(analysis: Analysis) -> Drawn:
    for group in _axis_groups(analysis):
        rows = analysis.tables["learning_curves"]
        rows = rows[rows.class_name.isin(group.classes) & rows.algorithm.isin(analysis.learners)]
        if not rows.empty:
            yield Picture(
                f"learning-curves-{re.sub('[ .]', '-', group.axis or group.name).lower()}",
                f"Learning curves: {group.name}",
                f"{panels.curves_caption(rows)} Left: return in % of the optimum's. Right: mean "
                "exact regret per step, 0 for the optimum.",
                _group_curves(analysis, group, rows),
            )


def _group_curves(analysis: Analysis, group: Group, rows: pd.DataFrame) -> Figure:
    numbered = panels.numbered_looks(group.classes).items()
    coloured = zip(numbered, shades(len(numbered)), strict=True)
    looks = {name: {**look, "color": colour} for (name, look), colour in coloured}
    data = training_data(analysis.runs)

    def draw_curve(axes: Axes, place: tuple[str, str]) -> None:
        name, measure = place
        curves = rows[(rows.algorithm == name) & (rows.measure == measure)]
        panels.draw_lines(axes, curves, "class_name", looks)
        axes.set_xlabel(f"{'gradient' if data[name] else 'environment'} steps")
        panels.tick_steps(axes)

    names = [name for name in analysis.learners if name in set(rows.algorithm)]
    items = [
        (f"{name}: {label}", (name, measure)) for name in names for measure, label in CURVES.items()
    ]
    labels = _class_labels(group, with_symbol=True)
    named = dict(zip(labels, looks.values(), strict=True))
    return panels.grid(items, draw_curve, (0.6, 2.2), looks=named, across=2, share_y="col")


def draw_offline(analysis: Analysis) -> Drawn:
    rows = analysis.tables["offline"]
    if rows.empty:
        return
    looks = panels.numbered_looks(dict.fromkeys(rows.learner))
    known = _BEHAVIOUR, _OPTIMUM, panels.CONSTANT
    references = dict(zip(("behaviour policy", "optimum", "constant ½"), known, strict=True))
    across = min(3, rows.class_name.nunique())
    figure = panels.grid(
        panels.by(rows, "class_name"),
        lambda axes, of_class: _draw_improvements(axes, analysis, of_class, looks),
        (0.9, 2.4), x="ν of the behaviour policy", y="r̃ − r̃ of the behaviour",
        looks={**looks, **references}, width=max(3.6, min(panels.WIDTH, 1.0 + 2.4 * across)),
        share_x=True,
    )  # fmt: skip
    yield Picture(
        "offline-improvement",
        "Improvement over the behaviour policy",
        "Mean over runs of the similarity of the learner minus that of the policy that made its "
        f"data, with its 95 % bootstrap interval from {OFFLINE_INTERVAL} runs on. {FEW} runs, "
        f"{INDICATION}",
        figure,
    )


def _draw_improvements(
    axes: Axes, analysis: Analysis, rows: pd.DataFrame, looks: Mapping[str, Look]
) -> None:
    data = rows.drop_duplicates("nu")
    axes.axhline(0.0, color="black", linewidth=0.9, zorder=1.5)
    for look, similarity in ((_OPTIMUM, 1.0), (panels.CONSTANT, data.constant_similarity)):
        height = similarity - data.behaviour_similarity
        axes.plot(data.nu, height, **look, linewidth=1.1, zorder=1.6)
    nus = sorted(set(analysis.tables["offline"].nu))
    apart = min((b - a for a, b in itertools.pairwise(nus)), default=1.0)
    panels.marks(
        axes, rows, "improvement", looks, 0.25 * apart,
        of="learner", at="nu", upright=True, joined=True,
    )  # fmt: skip


def _axis_groups(analysis: Analysis) -> Sequence[Group]:
    """Groups of single axes with several classes; all classes where there is none."""
    contrasted = [group for group in analysis.groups if group.axis and len(group.classes) > 1]
    return contrasted or analysis.groups[:1]


def _class_labels(group: Group, *, with_symbol: bool = False) -> list[str]:
    """The value of the axis in each class, `25` or `k = 25`; its name where that does not tell."""
    labels = [setting_label(group.axis, v, with_symbol=with_symbol) for v in group.values]
    return labels if len({*labels}) == len(group.classes) else list(group.classes)


def draw_dynamic_regret(analysis: Analysis) -> Drawn:
    regret = analysis.tables["stream_regret"]
    if regret.empty:
        return
    looks = {
        name: {**look, "linestyle": "-"}
        for name, look in panels.looks_of(analysis, regret.algorithm).items()
    }

    def draw_stream(axes: Axes, rows: pd.DataFrame) -> None:
        name = rows.class_name.iloc[0]
        for algorithm, look in looks.items():
            curve = rows[rows.algorithm == algorithm]
            for column, (_, beside, _) in _BESIDE.items():
                style = {**beside, "color": look["color"]}
                axes.plot(curve.lifetime, curve[column], **style, linewidth=1.1, zorder=2.5)
        panels.draw_lines(axes, rows, "algorithm", looks, "lifetime")
        references = analysis.rows("stream_reference_regret", class_name=name)
        for reference, curve in references.groupby("reference"):
            line = _REFERENCES[str(reference)]
            axes.plot(curve.lifetime, curve["median"], **line, linewidth=1.1, zorder=1.5)
        _finish_lifetime(axes, analysis, name)
        axes.yaxis.set_major_formatter(panels.step_text)

    beside = [_BESIDE[column] for column in _BESIDE if regret[column].notna().any()]
    known = set(analysis.tables["stream_reference_regret"].reference)
    drawn = {LABELS[name]: look for name, look in _REFERENCES.items() if name in known}
    named = {**looks, **{label: look for label, look, _ in beside}, **drawn}
    figure = panels.grid(
        panels.by(regret, "class_name"), draw_stream, _HEIGHTS, x="lifetime (steps)",
        y="dynamic regret  (Σ of 1 − r)", looks=named, title_pad=_PAD,
    )  # fmt: skip
    caption = (
        "Median over lives, with the interquartile range as a band. The regret of every step, "
        "summed over the lifetime; shades and numbers above are visits and their phases. Grey: "
        "agents that need no training."
    ) + "".join(text for *_, text in beside)
    yield Picture("stream-regret", "Dynamic regret", caption, figure)


def draw_plasticity(analysis: Analysis) -> Drawn:
    rows = analysis.rows("stream_visit_metrics", region=WITHIN, metric="plasticity_ratio")
    if rows.empty:
        return
    looks = panels.looks_of(analysis, rows.algorithm)

    def draw_stream(axes: Axes, of_stream: pd.DataFrame) -> None:
        panels.marks(axes, of_stream, "iqm", looks, 0.4, at="visit", upright=True, joined=True)
        axes.axhline(1.0, color="black", linewidth=0.9, zorder=1.5)
        tick_visits(axes, _visits(analysis, of_stream.class_name.iloc[0]))

    figure = panels.grid(
        panels.by(rows, "class_name"), draw_stream, _HEIGHTS, x="visit of phase",
        y="plasticity ratio", looks=looks,
    )  # fmt: skip
    yield Picture(
        "stream-plasticity",
        "Plasticity by visit",
        "Normalised regret on the phase just visited, divided by that of a fresh agent after as "
        f"many steps on that phase alone: above 1, the life ends worse. {OVER_LIVES} In its first "
        "visit a life is a fresh agent itself: other values than 1 say nothing about plasticity.",
        figure,
    )


def draw_retention(analysis: Analysis) -> Drawn:
    for name, rows in panels.by(analysis.rows("stream_matrices", region=WITHIN), "class_name"):
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
        phases = [str(phase) for phase in range(M.shape[1])]
        draw_matrix(axes, M, labels, phases, (0.0, top), visited, "viridis_r")

    height = 0.55 + 0.24 * max(4, min(len(labels), 30))
    return panels.grid(
        panels.by(rows, "algorithm"), draw_agent, (1.0, height), x="on the task of phase",
        y="policy at the end of", share_x=True, bar=MATRIX_SCALE.replace("\n", " "),
    )  # fmt: skip


def draw_performance(analysis: Analysis) -> Drawn:
    reports: dict[str, dict[str, list[StreamReport]]] = {}
    for life in analysis.lives:
        of_stream = reports.setdefault(life.planned.class_name, {})
        of_stream.setdefault(life.planned.algorithm, []).append(life.report)
    for name, of_stream in reports.items():
        figure = panels.grid(
            of_stream.items(), lambda axes, of_agent: performance_curve(of_agent, ax=axes),
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


def _finish_lifetime(axes: Axes, analysis: Analysis, name: str) -> None:
    """Visits as bands, with their phases above, and ticks of steps."""
    visits = _visits(analysis, name)
    panels.tick_steps(axes)
    axes.set_xlim(0.0, visits[-1].lifetime)
    shade_visits(axes, visits)


def _visits(analysis: Analysis, name: str) -> Sequence[Visit]:
    return next(life.report.visits for life in analysis.lives if life.planned.class_name == name)
