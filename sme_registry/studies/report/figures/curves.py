"""Figures of curves: regret along each axis, profiles, learning curves, learning from data."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import pandas as pd

from sme_registry.plots.style import GREY, literal, shades
from sme_registry.studies.report.analysis import (
    CURVES,
    ENOUGH_RUNS,
    OFFLINE_INTERVAL,
    Analysis,
    training_data,
)
from sme_registry.studies.report.classes import SEVERAL, Group, setting_label
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import (
    CONSTANT,
    FEW,
    HEADINGS,
    LINEAR,
    WIDTH,
    Drawn,
    Look,
    Picture,
    curves_caption,
    epsilon_remark,
    looks_of,
    marks,
    new_look,
    panel_grid,
    side_by_side,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BEHAVIOUR, _OPTIMUM = new_look("black"), new_look(GREY, dash=(0, (1, 1.2)))


def draw_regret(analysis: Analysis) -> Drawn:
    """Normalised regret along each axis: WD and OOD in one figure for a single axis, else two."""
    caption = (
        "IQM over runs with its 95 % bootstrap interval: 0 is the optimum, 1 the constant action "
        f"½, the dashed line the linear least-squares policy fitted to the optimum. {FEW} runs."
    )
    remark, groups = epsilon_remark(analysis), _axis_groups(analysis)
    if len(groups) == 1 and groups[0].axis not in ("", SEVERAL):
        (group,) = groups
        log = ", log scale" if panels.spacing(group.values) == "log" else ""
        items = [(heading, group, metric) for metric, heading in HEADINGS.items()]
        yield Picture(
            f"regret-{group.axis.replace('.', '-')}",
            f"Normalised regret along the {group.name}",
            caption + remark,
            _regret_panels(analysis, items, x=literal(group.name) + log),
        )
        return
    for metric, heading in HEADINGS.items():
        yield Picture(
            metric.replace("_", "-"),
            f"Normalised regret {heading}, along each axis",
            caption + remark * (metric == "ood_regret"),
            _regret_panels(analysis, [(group.name, group, metric) for group in groups]),
        )


def _regret_panels(
    analysis: Analysis, items: Sequence[tuple[str, Group, str]], x: str = ""
) -> Figure:
    looks = looks_of(analysis, analysis.learners or analysis.algorithms)
    figure = panel_grid(
        [(title, (group, metric)) for title, group, metric in items],
        lambda axes, item: _draw_axis(axes, analysis, *item, looks), (0.9, 2.3),
        x=x, y="normalised regret",
        looks={**looks, "linear (LSQ)": LINEAR, "constant ½": CONSTANT},
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
    levels = analysis.tables["levels"]
    levels = levels[(levels.metric == metric) & levels.class_name.isin(x)]
    levels = levels.assign(at=levels.class_name.map(x)).sort_values("at", kind="stable")
    linear = levels.drop_duplicates("class_name", keep="last")
    look = LINEAR if group.axis not in ("", SEVERAL) else new_look(GREY, "_", "none")
    axes.plot(linear["at"], linear.linear, **look, linewidth=1.2, markersize=14, zorder=1.6)
    axes.axhline(1.0, color=GREY, linewidth=1.2, linestyle=CONSTANT["linestyle"], zorder=1.6)
    for name, look, shift in side_by_side(looks, 0.5 * distance):
        rows = levels[levels.algorithm == name]
        joined = kind != "nominal"
        marks(axes, rows, "iqm", rows["at"] + shift, look, upright=True, joined=joined)


def draw_profiles(analysis: Analysis) -> Drawn:
    """The share of runs above each value of 1 − normalised regret, one panel a group of classes."""
    looks = looks_of(analysis)

    def draw_group(axes: Axes, rows: pd.DataFrame) -> None:
        for name, profile in rows.groupby("algorithm", sort=False):
            columns = profile[["threshold", "low", "share", "high"]]
            panels.line_with_band(axes, columns, looks[str(name)], (5, 20))
        axes.set_ylim(-0.02, 1.02)
        axes.set_xlim(0.0, 1.0)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")

    for metric, rows in analysis.tables["profiles"].groupby("metric", sort=False):
        figure = panel_grid(
            panels.by(rows, "group"), draw_group, (0.7, 2.1), x="τ (1 − normalised regret)",
            y="share of runs above τ", looks=looks, share_x=True,
        )  # fmt: skip
        yield Picture(
            f"profiles-{metric.removesuffix('_regret')}",
            f"Performance profiles {HEADINGS[metric]}",
            "The share of runs whose 1 − normalised regret is above τ, classes counting alike, "
            "with pointwise 95 % bands. A line above another is better at every τ.",
            figure,
        )


def draw_class_curves(analysis: Analysis) -> Drawn:
    """Learning curves with a panel for each class and all algorithms in it."""
    rows = analysis.tables["learning_curves"]
    rows = rows[(rows.measure == "regret") & rows.algorithm.isin(analysis.learners)]
    looks = looks_of(analysis, rows.algorithm)
    if len(looks) < 2:
        return

    def draw_class(axes: Axes, of_class: pd.DataFrame) -> None:
        panels.draw_lines(axes, of_class, "algorithm", looks)
        panels.tick_steps(axes)

    labels = {name: f" ({c.label})" if c.label else "" for name, c in analysis.classes.items()}
    items = [(f"{name}{labels[name]}", group) for name, group in panels.by(rows, "class_name")]
    yield Picture(
        "learning-curves-by-class",
        "Learning curves of all algorithms by class",
        f"{curves_caption(rows)} Mean exact regret per step, 0 for the optimum.",
        panel_grid(items, draw_class, (0.8, 1.9), x="steps", y=CURVES["regret"], looks=looks),
    )


def draw_learning_curves(analysis: Analysis) -> Drawn:
    """One figure an axis: a row of panels an algorithm, the values of the axis as lines."""
    if analysis.tables["learning_curves"].empty:
        yield "No learning curves: the plan has no evaluations during training."
    for group in _axis_groups(analysis):
        rows = analysis.tables["learning_curves"]
        rows = rows[rows.class_name.isin(group.classes) & rows.algorithm.isin(analysis.learners)]
        if not rows.empty:
            yield Picture(
                f"learning-curves-{re.sub('[ .]', '-', group.axis or group.name).lower()}",
                f"Learning curves: {group.name}",
                f"{curves_caption(rows)} Left: return in % of the optimum's. Right: mean exact "
                "regret per step, 0 for the optimum.",
                _group_curves(analysis, group, rows),
            )


def _group_curves(analysis: Analysis, group: Group, rows: pd.DataFrame) -> Figure:
    looks = panels.numbered_looks(group.classes, colours=shades(len(group.classes)))
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
    return panel_grid(items, draw_curve, (0.6, 2.2), looks=named, across=2, share_y="col")


def draw_offline(analysis: Analysis) -> Drawn:
    """The improvement of offline learners over the behaviour policy, one panel a class."""
    rows = analysis.tables["offline"]
    if rows.empty:
        return
    dashes = ("-", (0, (5, 1.5)), (0, (5, 1, 1, 1)), (0, (8, 2)))
    looks = panels.numbered_looks(dict.fromkeys(rows.learner), dashes=dashes)
    references = {"behaviour policy": _BEHAVIOUR, "optimum": _OPTIMUM, "constant ½": CONSTANT}
    across = min(3, rows.class_name.nunique())
    figure = panel_grid(
        panels.by(rows, "class_name"),
        lambda axes, of_class: _draw_improvements(axes, analysis, of_class, looks),
        (0.9, 2.4), x="ν of the behaviour policy", y="r̃ − r̃ of the behaviour",
        looks={**looks, **references}, width=max(3.6, min(WIDTH, 1.0 + 2.4 * across)),
        share_x=True,
    )  # fmt: skip
    caption = (
        "A small mark is a run, a large one the mean over runs: similarity of the learner minus "
        "that of the policy that made its data."
    )
    if rows.low.notna().any():
        caption += " Bars are 95 % bootstrap intervals of the mean."
    if rows.runs.min() < OFFLINE_INTERVAL:
        caption += f" With fewer than {OFFLINE_INTERVAL} runs there is no interval."
    if rows.runs.min() < ENOUGH_RUNS:
        caption += f" {FEW} runs, an indication only."
    yield Picture("offline-improvement", "Improvement over the behaviour policy", caption, figure)


def _draw_improvements(
    axes: Axes, analysis: Analysis, rows: pd.DataFrame, looks: Mapping[str, Look]
) -> None:
    runs = analysis.offline_runs[analysis.offline_runs.class_name == rows.class_name.iloc[0]]
    data = rows.drop_duplicates("nu")
    axes.axhline(0.0, color="black", linewidth=0.9, zorder=1.5)
    for look, similarity in ((_OPTIMUM, 1.0), (CONSTANT, data.constant_similarity)):
        height = similarity - data.behaviour_similarity
        axes.plot(data.nu, height, **look, linewidth=1.1, zorder=1.6)
    nus = sorted(set(analysis.tables["offline"].nu))
    apart = min((b - a for a, b in itertools.pairwise(nus)), default=1.0)
    for name, look, shift in side_by_side(looks, 0.25 * apart):
        means, singles = rows[rows.learner == name], runs[runs.learner == name]
        marks(axes, means, "improvement", means.nu + shift, look, upright=True, joined=True)
        mark = {**look, "linestyle": "none", "markersize": 2.5, "markeredgewidth": 0.0}
        axes.plot(singles.nu + shift, singles.improvement, **mark, alpha=0.5, zorder=3.5)


def _axis_groups(analysis: Analysis) -> Sequence[Group]:
    """Groups of single axes with several classes; all classes where there is none."""
    contrasted = [group for group in analysis.groups if group.axis and len(group.classes) > 1]
    return contrasted or analysis.groups[:1]


def _class_labels(group: Group, *, with_symbol: bool = False) -> list[str]:
    """The value of the axis in each class, `25` or `k = 25`; the class's name without an axis."""
    labels = [setting_label(group.axis, v, with_symbol=with_symbol) for v in group.values]
    return labels or list(group.classes)
