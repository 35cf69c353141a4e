"""Figures of curves: regret along each axis, profiles, learning curves, learning from data."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from sme_registry.plots.style import GREY, literal, shades
from sme_registry.studies.report.analysis import CURVES, ENOUGH_RUNS, Analysis
from sme_registry.studies.report.classes import SEVERAL, Group, axis_values, setting_label
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import CONSTANT, LINEAR, Look, Picture, Scale
from sme_registry.studies.report.tables import OFFLINE_INTERVAL, training_data

_OFFLINE_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (5, 1, 1, 1)), (0, (8, 2)))
_BEHAVIOUR = Look("black", "", "-")
_OPTIMUM = Look(GREY, "", (0, (1, 1.2)))


_REGRET_CAPTION = (
    "IQM over runs with its 95 % bootstrap interval: 0 is the optimum, 1 the constant action ½, "
    "the dashed line the linear least-squares policy fitted to the optimum. "
    f"Hollow: fewer than {ENOUGH_RUNS} runs."
)


def draw_regret(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """Normalised regret along each axis: WD and OOD in one figure for a single axis, else two."""
    groups = _axis_groups(analysis)
    if len(groups) == 1 and groups[0].axis not in ("", SEVERAL):
        (group,) = groups
        yield Picture(
            f"regret-{group.axis.replace('.', '-')}",
            f"Normalised regret along the {group.name}",
            f"{_REGRET_CAPTION}{panels.epsilon_remark(analysis)}",
            _draw_panels(analysis, formats, [(group, metric) for metric in panels.HEADINGS]),
        )
        return
    for metric, heading in panels.HEADINGS.items():
        yield Picture(
            metric.replace("_", "-"),
            f"Normalised regret {heading}, along each axis",
            _REGRET_CAPTION + (panels.epsilon_remark(analysis) if metric == "ood_regret" else ""),
            _draw_panels(analysis, formats, [(group, metric) for group in groups]),
        )


def _draw_panels(
    analysis: Analysis, formats: Sequence[str], drawn: Sequence[tuple[Group, str]]
) -> Mapping[str, bytes]:
    """A panel for each group and metric, named by what differs between the panels."""
    names = analysis.learners or analysis.algorithms
    looks = {name: look for name, look in panels.looks(analysis).items() if name in names}
    one_group = len({group.name for group, _ in drawn}) < len(drawn)
    with panels.panel_grid(len(drawn), formats, (0.9, 2.3)) as grid:
        for axes, (group, metric) in zip(grid.panels, drawn, strict=True):
            scale = _draw_axis(axes, analysis, group, metric, looks)
            axes.set_title(
                literal(panels.HEADINGS[metric] if one_group else group.name), fontsize=9
            )
            if one_group:
                log = ", log scale" if scale.spacing == "log" else ""
                axes.set_xlabel(literal(group.name) + log)
        # From 0, with headroom in proportion. Last: it ends autoscaling, for all panels.
        grid.panels[0].update_datalim([(0.0, 0.0)], updatex=False)
        grid.panels[0].autoscale_view(scalex=False)
        grid.panels[0].set_ylim(bottom=0.0)
        grid.label_rows("normalised regret")
        panels.legend(grid.figure, {**looks, "linear (LSQ)": LINEAR, "constant ½": CONSTANT})
    return grid.files


def _draw_axis(
    axes: Any, analysis: Analysis, group: Group, metric: str, looks: Mapping[str, Look]
) -> Scale:
    """The classes of one axis, in the order of its values."""
    ordered = group.axis not in ("", SEVERAL)
    values = axis_values(group.axis, [analysis.classes[name] for name in group.classes])
    scale = Scale.of(values, len(group.classes))
    x = dict(zip(group.classes, scale.at, strict=True))
    levels = analysis.tables["levels"][analysis.tables["levels"].metric == metric]
    levels = levels[levels.class_name.isin(x)]
    levels = levels.sort_values("class_name", key=lambda names: names.map(x), kind="stable")
    at = levels.class_name.map(x)
    linear = levels.drop_duplicates("class_name", keep="last")
    look = LINEAR if ordered else Look(GREY, "_", "none")
    axes.plot(
        at[linear.index], linear.linear, **look.line, linewidth=1.2, markersize=14, zorder=1.6
    )
    axes.axhline(1.0, color=GREY, linewidth=1.2, linestyle=CONSTANT.dash, zorder=1.6)
    for name, algorithm, shift in panels.side_by_side(looks, 0.5):
        own = levels[levels.algorithm == name]
        places, enough = scale.shifted(at[own.index], shift), own.runs >= ENOUGH_RUNS
        joined = ordered and scale.spacing != "nominal"
        panels.marks(axes, own, "iqm", places, enough, algorithm, upright=True, joined=joined)
    scale.apply(axes, [literal(label) for label in _class_labels(analysis, group)])
    axes.grid(visible=False, axis="x")
    return scale


def draw_profiles(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """The share of runs above each value of 1 − normalised regret, one panel a group of classes."""
    looks = panels.looks(analysis)
    for metric, rows in analysis.tables["profiles"].groupby("metric", sort=False):
        groups = list(dict.fromkeys(rows.group))
        with panels.panel_grid(len(groups), formats, (0.7, 2.1), share_x=True) as grid:
            for axes, group in zip(grid.panels, groups, strict=True):
                for name, profile in rows[rows.group == group].groupby("algorithm", sort=False):
                    columns = ["threshold", "low", "share", "high"]
                    line_with_band(axes, profile[columns], looks[name], (5, 20))
                axes.set_title(literal(group), fontsize=9)
                axes.set_ylim(-0.02, 1.02)
                axes.set_xlim(0.0, 1.0)
                axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            grid.label_rows("share of runs above τ")
            grid.label_columns("τ (1 − normalised regret)")
            panels.legend(grid.figure, looks)
        yield Picture(
            f"profiles-{metric.removesuffix('_regret')}",
            f"Performance profiles {panels.HEADINGS[metric]}",
            "The share of runs whose 1 − normalised regret is above τ, classes counting alike, "
            "with pointwise 95 % bands. A line above another is better at every τ.",
            grid.files,
        )


def draw_learning_curves(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """One figure an axis: algorithms as panels, the values of the axis as lines."""
    data = training_data(analysis.runs)
    for group in _axis_groups(analysis):
        rows = analysis.tables["learning_curves"]
        rows = rows[rows.class_name.isin(group.classes)]
        names = [name for name in analysis.learners if name in set(rows.algorithm)]
        if not names:
            continue
        looks = panels.numbered_looks(group.classes, colours=shades(len(group.classes)))
        width = min(panels.WIDTH, 1.2 + 2.6 * len(names))
        with panels.panel_grid(
            len(names), formats, (0.6, 4.4), width=width, most_across=4, stack=len(CURVES)
        ) as grid:
            for stack, name in zip(grid.stacks, names, strict=True):
                for axes, measure in zip(stack, CURVES, strict=True):
                    selected = rows[(rows.algorithm == name) & (rows.measure == measure)]
                    draw_lines(axes, selected, "class_name", looks)
                stack[0].set_title(literal(name))
                stack[-1].set_xlabel(f"{'gradient' if data[name] else 'environment'} steps")
                stack[-1].set_xlim(left=0)
                stack[-1].locator_params(axis="x", nbins=4)
                stack[-1].xaxis.set_major_formatter(step_text)
            for index, label in enumerate(CURVES.values()):
                grid.label_rows(label, index)
            labels = _class_labels(analysis, group, with_symbol=True)
            panels.legend(grid.figure, dict(zip(labels, looks.values(), strict=True)), across=4)
        yield Picture(
            f"learning-curves-{re.sub('[ .]', '-', group.axis or group.name).lower()}",
            f"Learning curves: {group.name}",
            f"{curves_caption(rows)} Above: return in % of the optimum's. Below: mean exact "
            "regret per step, 0 for the optimum.",
            grid.files,
        )


def curves_caption(rows: pd.DataFrame) -> str:
    """What the lines and bands of these rows of `learning_curves` are."""
    window = rows.window.max()
    smoothed = f", each a running median over {window} evaluations" if window > 1 else ""
    return f"Median over runs, with the interquartile range as a band{smoothed}."


def draw_class_curves(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """Learning curves with a panel for each class and all algorithms in it."""
    rows = analysis.tables["learning_curves"]
    rows = rows[(rows.measure == "regret") & rows.algorithm.isin(analysis.learners)]
    classes = list(dict.fromkeys(rows.class_name))
    looks = {a: look for a, look in panels.looks(analysis).items() if a in set(rows.algorithm)}
    if len(looks) < 2:
        return
    with panels.panel_grid(len(classes), formats, (0.8, 1.9)) as grid:
        for axes, class_name in zip(grid.panels, classes, strict=True):
            draw_lines(axes, rows[rows.class_name == class_name], "algorithm", looks)
            info = analysis.classes[class_name]
            axes.set_title(literal(f"{class_name} ({info.label})" if info.label else class_name))
            axes.title.set_fontsize(9)
            axes.set_xlim(left=0)
            axes.locator_params(axis="x", nbins=4)
            axes.xaxis.set_major_formatter(step_text)
            axes.set_xlabel("steps")
        grid.label_rows(CURVES["regret"])
        panels.legend(grid.figure, looks)
    yield Picture(
        "learning-curves-by-class",
        "Learning curves of all algorithms by class",
        f"{curves_caption(rows)} Mean exact regret per step, 0 for the optimum.",
        grid.files,
    )


def draw_lines(
    axes: Any, rows: pd.DataFrame, by: str, looks: Mapping[str, Look], x: str = "step"
) -> None:
    """The median and quartiles of each algorithm or class along x; markers do not coincide."""
    for index, (name, look) in enumerate(looks.items()):
        curve = rows[rows[by] == name][[x, "q25", "median", "q75"]]
        if not curve.empty:
            every = max(1, len(curve) // 6)
            line_with_band(axes, curve, look, (index * every // len(looks), every))


def draw_offline(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """The improvement of offline learners over the behaviour policy, one panel a class."""
    if analysis.tables["offline"].empty:
        return
    classes = list(dict.fromkeys(analysis.tables["offline"].class_name))
    looks = panels.numbered_looks(
        dict.fromkeys(analysis.tables["offline"].learner), dashes=_OFFLINE_DASHES
    )
    across = min(3, len(classes))
    width = max(3.6, min(panels.WIDTH, 1.0 + 2.4 * across))
    with panels.panel_grid(len(classes), formats, (0.9, 2.4), width=width, share_x=True) as grid:
        for axes, class_name in zip(grid.panels, classes, strict=True):
            _draw_improvements(axes, analysis, class_name, looks)
        grid.label_rows("r̃ − r̃ of the behaviour")
        grid.label_columns("ν of the behaviour policy")
        references = {
            "behaviour policy": _BEHAVIOUR, "optimum": _OPTIMUM, "constant ½": CONSTANT,
        }  # fmt: skip
        panels.legend(grid.figure, {**looks, **references}, across=2 * across)
    title = "Improvement over the behaviour policy"
    yield Picture("offline-improvement", title, _offline_caption(analysis), grid.files)


def _draw_improvements(
    axes: Any, analysis: Analysis, class_name: str, looks: Mapping[str, Look]
) -> None:
    rows = analysis.tables["offline"][analysis.tables["offline"].class_name == class_name]
    runs = analysis.offline_runs[analysis.offline_runs.class_name == class_name]
    data = rows.drop_duplicates("nu")
    axes.axhline(0.0, color="black", linewidth=0.9, zorder=1.5)
    for look, similarity in ((_OPTIMUM, 1.0), (CONSTANT, data.constant_similarity)):
        height = similarity - data.behaviour_similarity
        axes.plot(data.nu, height, **look.line, linewidth=1.1, zorder=1.6)
    nus = sorted(set(analysis.tables["offline"].nu))
    apart = min((b - a for a, b in itertools.pairwise(nus)), default=1.0)
    for name, look, shift in panels.side_by_side(looks, 0.25 * apart):
        selected, each = rows[rows.learner == name], runs[runs.learner == name]
        at, enough = selected.nu + shift, selected.runs >= ENOUGH_RUNS
        panels.marks(axes, selected, "improvement", at, enough, look, upright=True, joined=True)
        axes.plot(
            each.nu + shift, each.improvement, **look.points, markersize=2.5, markeredgewidth=0.0,
            alpha=0.5, zorder=3.5,
        )  # fmt: skip
    axes.set_title(literal(class_name))


def _offline_caption(analysis: Analysis) -> str:
    few = analysis.tables["offline"].runs.min()
    caption = (
        "A small mark is a run, a large one the mean over runs: similarity of the learner minus "
        "that of the policy that made its data."
    )
    if not analysis.tables["offline"].low.isna().all():
        caption += " Bars are 95 % bootstrap intervals of the mean."
    if few < OFFLINE_INTERVAL:
        caption += f" With fewer than {OFFLINE_INTERVAL} runs there is no interval."
    if few < ENOUGH_RUNS:
        caption += f" Hollow: fewer than {ENOUGH_RUNS} runs, an indication only."
    return caption


def line_with_band(axes: Any, curve: pd.DataFrame, look: Look, markevery: tuple[int, int]) -> None:
    """The columns of a curve are x, the lower end of the band, the line, and the upper end."""
    x, low, middle, high = (curve[name] for name in curve)
    axes.fill_between(x, low, high, color=look.colour, alpha=0.14, linewidth=0)
    axes.plot(x, middle, **look.line, linewidth=1.6, markersize=4, markevery=markevery)


def _axis_groups(analysis: Analysis) -> Sequence[Group]:
    """Groups of single axes with several classes; all classes where there is none."""
    contrasted = [group for group in analysis.groups if group.axis and len(group.classes) > 1]
    return contrasted or analysis.groups[:1]


def _class_labels(analysis: Analysis, group: Group, *, with_symbol: bool = False) -> list[str]:
    """The value of the axis in each class, `25` or `k = 25`; the class's name without an axis."""
    values = axis_values(group.axis, [analysis.classes[name] for name in group.classes])
    if not values:
        return list(group.classes)
    return [setting_label(group.axis, value, with_symbol=with_symbol) for value in values]


def step_text(value: float, _: Any) -> str:
    """A number of steps as a tick: `20k`."""
    return f"{value / 1000:g}k" if value >= 10_000 else f"{value:g}"
