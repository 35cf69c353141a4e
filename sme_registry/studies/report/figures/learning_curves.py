"""Learning curves: algorithms side by side, the values of one axis as lines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from sme_registry.plots import literal, shades
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import AXES, Group, setting_label
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Look, Picture
from sme_registry.studies.report.tables import CURVES, training_data

_MOST_ACROSS = 4


def draw_learning_curves(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture | str]:
    """One figure an axis; a sentence where there are no evaluations during training."""
    if analysis.learning_curves.empty:
        yield "No learning curves: the plan has no evaluations during training."
        return
    groups = [group for group in analysis.groups if group.axis] or analysis.groups
    for group in groups:
        rows = analysis.learning_curves
        rows = rows[rows.class_name.isin(group.classes)]
        present = set(rows.algorithm)
        names = [name for name in analysis.learners if name in present]
        if names:
            yield _draw_group(analysis, formats, group, rows, names)


def _draw_group(
    analysis: Analysis, formats: Sequence[str], group: Group, rows: pd.DataFrame, names: list[str]
) -> Picture:
    data = training_data(analysis.runs)
    looks = panels.numbered_looks(group.classes, colours=shades(len(group.classes)))
    figure = panels.panel_grid(
        len(names), formats, (0.6, 4.4), width=min(panels.WIDTH, 1.2 + 2.6 * len(names)),
        most_across=_MOST_ACROSS, stack=len(CURVES),
    )  # fmt: skip
    with figure as (grid, files):
        for stack, name in zip(grid.stacks, names, strict=True):
            selected = rows[rows.algorithm == name]
            for axes, measure in zip(stack, CURVES, strict=True):
                _draw_curves(axes, selected[selected.measure == measure], looks)
            stack[0].set_title(literal(name))
            stack[-1].set_xlabel(f"{'gradient' if data[name] else 'environment'} steps")
            stack[-1].set_xlim(left=0)
            stack[-1].locator_params(axis="x", nbins=4)
            stack[-1].xaxis.set_major_formatter(_steps)
        for index, label in enumerate(CURVES.values()):
            grid.label_rows(label, index)
        labels = {_label(analysis, name, group): look for name, look in looks.items()}
        panels.legend(grid.figure, labels, across=4)
    window = rows.window.max()
    return Picture(
        f"learning-curves-{(group.axis or group.name).replace(' ', '-').lower()}",
        f"Learning curves: {group.name}",
        "Median over runs, with the interquartile range as a band"
        + (f", averaged over {window} evaluations" if window > 1 else "")
        + ". Above: return in % of the optimum's. Below: mean exact regret per step, 0 for the "
        "optimum.",
        files,
    )


def _draw_curves(axes: Any, rows: pd.DataFrame, looks: Mapping[str, Look]) -> None:
    """The curves of one algorithm and measure, one a class; markers do not coincide."""
    curves = dict(iter(rows.groupby("class_name")))
    for index, (name, look) in enumerate(looks.items()):
        if name not in curves:
            continue
        curve = curves[name]
        axes.fill_between(
            curve.step, curve.q25, curve.q75, color=look.colour, alpha=0.13, linewidth=0
        )
        every = max(1, len(curve) // 6)
        axes.plot(
            curve.step, curve["median"], **look.line, linewidth=1.6, markersize=4,
            markevery=(index * every // len(looks), every),
        )  # fmt: skip


def _label(analysis: Analysis, class_name: str, group: Group) -> str:
    """`k = 25`; the class's name where there is no axis."""
    if group.axis not in AXES:
        return class_name
    return setting_label(group.axis, analysis.classes[class_name].setting[group.axis])


def _steps(value: float, _: Any) -> str:
    return f"{value / 1000:g}k" if value >= 10_000 else f"{value:g}"
