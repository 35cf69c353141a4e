"""The figures of a study's report, drawn from its tables at the width of a printed page."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sme_registry.errors import SMEError
from sme_registry.evaluation import as_policy
from sme_registry.plots import maps, style
from sme_registry.plots.style import GREY, literal, new_figure
from sme_registry.studies.report.analysis import Analysis, by_place
from sme_registry.studies.report.design import ALL, metrics_of
from sme_registry.studies.report.figures import curves, panels
from sme_registry.studies.report.figures.panels import (
    FEW,
    HEADINGS,
    INDICATION,
    WIDTH,
    Drawn,
    MarkColumn,
    Picture,
    dims,
    epsilon_remark,
    looks_of,
    mark_rows,
    new_look,
    panel_grid,
)
from sme_registry.studies.report.frames import RUN

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EPSILON, _RESOLUTION, _TIME = 1.0, 120, 0.5  # of maps of the plane
_BOX = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
_LUMINANCE = (0.299, 0.587, 0.114)  # of red, green and blue


def draw(
    drawings: Iterable[Callable[[Analysis], Drawn]], analysis: Analysis, formats: Sequence[str]
) -> tuple[list[Picture], list[str]]:
    """Pictures with their files, and why others are absent."""
    pictures, reasons = [], []
    levels = analysis.tables["levels"]
    single = not levels.empty and levels.runs.min() == 1
    with style.styled():
        for drawn in itertools.chain.from_iterable(drawing(analysis) for drawing in drawings):
            if isinstance(drawn, str):
                reasons.append(drawn)
                continue
            caption = drawn.caption
            if single and any(words in caption for words in ("95 %", "interquartile")):
                caption += " A single run has no interval."
            files = style.encoded(drawn.figure, formats)
            pictures.append(replace(drawn, caption=caption, files=files))
    return pictures, reasons


def draw_figures(analysis: Analysis, formats: Sequence[str]) -> tuple[list[Picture], list[str]]:
    from_tasks = TASK_FIGURES if analysis.algorithms else ()
    from_streams = curves.STREAM_FIGURES if analysis.lives else ()
    return draw((*from_tasks, *from_streams), analysis, formats)


def draw_contrasts(analysis: Analysis) -> Drawn:
    """The change that each class makes: of regret, and of metrics of training."""
    sides = {1: "right", -1: "left"}
    table = analysis.tables["contrasts"]
    if table.empty:
        yield (
            "No contrasts: they need finished runs of one number on the first class and on another."
        )
    general = [metric for metric in metrics_of("run") if not metric.needs]
    for name in ("regret", "training"):
        metrics = [metric for metric in general if metric.training == (name == "training")]
        rows = table[table.metric.isin([metric.key for metric in metrics])]
        if rows.empty:
            continue
        columns = [
            MarkColumn(m.key, f"change of\n{m.label}\n(worse to the {sides[m.worse]})", neutral=0.0)
            for m in metrics
        ]
        labels = [metric.label.partition(",")[0] for metric in metrics]
        figure = mark_rows(
            rows, "change", columns, "class_name", _class_places(analysis, rows),
            looks_of(analysis, rows.algorithm),
            share_x=name == "regret",
        )  # fmt: skip
        yield Picture(
            f"contrasts-{name}",
            f"What each class changes: {', '.join(labels[:-1])} and {labels[-1]}",
            f"IQM over runs of the change from the first class, {analysis.base}, to each other "
            "class, each run compared with the run of the same number, with its 95 % bootstrap "
            f"interval. {FEW} pairs, {INDICATION}",
            figure,
        )


def draw_agents(analysis: Analysis) -> Drawn:
    """Normalised regret of each agent of a team, WD and OOD side by side, one row an agent."""
    rows = analysis.tables["agents"]
    if rows.empty:
        return
    rows = rows.assign(place=rows.class_name + ", " + rows.agent)
    blocks = dict(zip(rows.place, rows.class_name, strict=True))
    yield Picture(
        "agents",
        "Normalised regret of each agent",
        "IQM over runs with its 95 % bootstrap interval, over the action channels that the agent "
        f"owns: 0 is the optimum, 1 the constant ½. {FEW} runs.",
        mark_rows(
            rows, "iqm", _both("normalised regret"), "place", _spaced(blocks),
            looks_of(analysis), share_x=True,
        ),
    )  # fmt: skip


def draw_regions(analysis: Analysis) -> Drawn:
    """Similarity of every algorithm on every class in every region: one heat map an algorithm."""
    rows = analysis.tables["regions"]
    regions = list(dict.fromkeys(rows.region))
    classes = [name for name in analysis.classes if name in set(rows.class_name)]
    scale = maps.colour_scale(rows.similarity)

    def draw_map(axes: Axes, name: str) -> None:
        of_name = rows[rows.algorithm == name]
        values = of_name.pivot(index="class_name", columns="region", values="similarity")
        _heat_map(axes, values.reindex(index=classes, columns=regions).to_numpy(), scale)
        axes.set_xticks(range(len(regions)), [region.replace("OOD ", "") for region in regions])
        axes.set_yticks(range(len(classes)), classes, fontsize=8)

    items = [(name, name) for name in analysis.algorithms]
    figure = panel_grid(items, draw_map, (0.75, 0.62 + 0.2 * len(classes)))
    panels.colour_bar(
        figure, figure.axes[0].images[0],
        "similarity r̃ (IQM over runs) in WD and in the shells OOD 1, 2, …; "
        + maps.scale_text(scale),
        maps.scale_ticks(scale),
    )  # fmt: skip
    yield Picture(
        "regions",
        "Similarity within and out of distribution",
        "IQM over runs of r̃, 1 for the optimum, in the unit cube (WD) and in each shell around "
        f"it. A dash: no run has finished.{epsilon_remark(analysis)}",
        figure,
        is_map=True,
    )


def _heat_map(axes: Axes, values: Any, scale: tuple[float, float]) -> None:
    """`[class, region]` similarities as an image with their numbers."""
    image = axes.imshow(values, vmin=scale[0], vmax=scale[1], cmap="viridis", aspect="auto")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    digits = 2 if scale[1] - scale[0] > 0.11 else 3
    for (y, x), value in np.ndenumerate(values):
        known = not np.isnan(value)
        dark = known and np.dot(image.to_rgba(value)[:3], _LUMINANCE) < 0.5
        text = f"{value:.{digits}f}".removeprefix("0") if known else "–"
        colour = "white" if dark else "black"
        axes.text(x, y, text, ha="center", va="center", fontsize=7.5, color=colour)


def draw_decay(analysis: Analysis) -> Drawn:
    """What each run loses out of distribution, against its similarity within; one mark a run."""
    results = analysis.tables["results"]
    inside, outside = (results.drop_duplicates(RUN, keep=keep) for keep in ("first", "last"))
    loss = outside.similarity_loss.to_numpy()
    figure = new_figure((4.8, 3.5))
    axes = figure.add_subplot()
    for name, look in looks_of(analysis).items():
        selected = (inside.algorithm == name).to_numpy()
        mark = {**look, "linestyle": "none", "markersize": 4, "alpha": 0.55}
        edge = 0.8 if look["marker"] in "x+12" else 0.0
        x, y = inside.similarity[selected], loss[selected]
        axes.plot(x, y, **mark, markeredgewidth=edge, label=literal(name))
    axes.axhline(0.0, color=GREY, linewidth=1.0)
    axes.set_xlabel("similarity r̃ within distribution")
    axes.set_ylabel(f"points of r̃ lost in the shell up to ε = {outside.epsilon_high.max():g}")
    style.legend_below(figure, axes.get_legend_handles_labels()[0])
    caption = (
        "One mark a run: its similarity in the unit cube, and the hundredths of r̃ that it loses in "
        "the outermost shell. Below 0 a run is better outside, which an agent can be whose actions "
        "saturate before it has learnt."
    )
    state_dims = dims(analysis)
    if len(state_dims) > 1:
        caption += f" It includes runs with S = {', '.join(map(str, state_dims))}."
        caption += epsilon_remark(analysis)
    yield Picture("decay", "Similarity lost outside against similarity inside", caption, figure)


def draw_aggregates(analysis: Analysis) -> Drawn:
    """The IQM of 1 − normalised regret, WD and OOD side by side, one row a group of classes."""
    rows = analysis.tables["aggregates"]
    if rows.empty:
        yield (
            "No aggregates over classes and no performance profiles: no class has runs of every "
            "algorithm."
        )
        return
    rows = rows[rows.statistic == "iqm"]
    yield Picture(
        "aggregates",
        "Aggregates over kinds of tasks",
        "Mean over classes of the IQM over runs, with its 95 % stratified bootstrap interval: "
        "1 is the optimum, 0 the constant ½. The classes of an axis include the first class.",
        mark_rows(
            rows, "value", _both("IQM of 1 − normalised regret"), "group", _spaced(rows.group),
            looks_of(analysis), share_x=True,
        ),
    )  # fmt: skip


def draw_improvements(analysis: Analysis) -> Drawn:
    """How probably one algorithm beats another, WD and OOD side by side, one row a pair."""
    rows = analysis.tables["improvements"]
    if rows.empty:
        yield (
            "No comparison of algorithms: no two of them have runs on the same classes and, if "
            "they learn from data, the same data."
        )
        return
    rows = rows[rows.group == ALL]
    rows = rows.assign(place=rows["first"] + " over " + rows["second"], algorithm="")
    caption = (
        "How probably a run of the first algorithm beats a run of the second on a class drawn at "
        "random, with its 95 % interval: ½ where neither is better."
    )
    if not analysis.tables["offline"].empty:
        caption += " Algorithms that learnt from different data are not compared."
    columns, looks = (
        _both("P(a run of X beats a run of Y)", neutral=0.5),
        {"": new_look("black", "o")},
    )
    places = _spaced(rows.place)
    figure = mark_rows(rows, "probability", columns, "place", places, looks, share_x=True)
    yield Picture("improvements", "Probability of improvement", caption, figure)


def draw_differences(analysis: Analysis) -> Drawn:
    """The paired difference of each algorithm from the first one, one row a class."""
    drawn, first = metrics_of("score"), analysis.algorithms[0]
    rows = analysis.tables["differences"]
    rows = rows[(rows["first"] == first) & rows.metric.isin([metric.key for metric in drawn])]
    if rows.empty:
        return
    looks, places = looks_of(analysis, rows.second), _class_places(analysis, rows)
    if ALL in set(rows.class_name):
        places[ALL] = max(places.values()) + 1.4
    alone = next(iter(looks)) if len(looks) == 1 else ""
    label = (
        f"{literal(first)} − {literal(alone) or 'the other'}\n(left: {literal(first)} is better)"
    )
    yield Picture(
        "differences",
        f"Paired differences from {first}",
        f"IQM over pairs of runs of the difference {first} minus {alone or 'the other algorithm'}, "
        "with its 95 % bootstrap interval. The runs of a pair have the same instance and seed. "
        f"{FEW} pairs, {INDICATION}",
        mark_rows(
            rows.assign(algorithm=rows.second), "difference",
            [MarkColumn(metric.key, label, metric.label, 0.0) for metric in drawn],
            "class_name", places, looks, share_x=True,
        ),
    )  # fmt: skip


def draw_maps(analysis: Analysis) -> Drawn:
    """One map a class and algorithm whose models were kept."""
    inside = analysis.tables["results"][analysis.tables["results"].region == "WD"]
    single = [name for name, info in analysis.classes.items() if info.setting["team"] == "none"]
    plane = inside[(inside.state_dim == 2) & inside.class_name.isin(single)]
    if plane.empty:
        yield "No maps of the plane: no finished run has a task with two state channels."
        return
    kept, problem = _kept_maps(analysis, plane[plane.key.isin(analysis.models)])
    if not kept:
        yield (
            "No maps of the plane: they need trained models. Run the study with --keep-models in a "
            f"new folder.{problem}"
        )
        return
    scale = maps.colour_scale([grid for grid, _ in kept.values()])

    def draw_map(axes: Axes, item: tuple[Any, float]) -> None:
        similarity, level = item
        maps.draw_similarity(axes, similarity, _EPSILON, scale)
        place = axes.transAxes
        axes.text(0.03, 0.03, f"WD {level:.2f}", transform=place, fontsize=7.5, bbox=_BOX)
        axes.set_xticks([0, 1])
        axes.set_yticks([0, 1])

    items = [(f"{algorithm} on {name}", item) for (name, algorithm), item in kept.items()]
    width = min(WIDTH, 1.4 + 2.0 * len(items))
    figure = panel_grid(items, draw_map, (0.5, 2.1), width=width, share_x=True)
    label = f"similarity r̃; {maps.scale_text(scale)}"
    panels.colour_bar(figure, figure.axes[0].images[0], label, maps.scale_ticks(scale))
    yield Picture(
        "maps",
        "Similarity over the plane, beyond the unit square",
        "r̃ of a trained policy at each state of the plane, halfway through the episode; the square "
        "is the unit square, where it was trained. For each algorithm the run with the median r̃ "
        f"within distribution, among those whose model was kept.{problem}",
        figure,
        is_map=True,
    )


def _kept_maps(
    analysis: Analysis, runs: pd.DataFrame
) -> tuple[dict[tuple[str, str], tuple[Any, float]], str]:
    """(class, algorithm) → its median run's map and WD similarity; and the last problem."""
    kept, problem = {}, ""
    for place, group in by_place(runs).items():
        median = group.sort_values(["similarity", "run"]).iloc[(len(group) - 1) // 2]
        spec = analysis.cells[median.key].cell.spec
        try:
            policy = as_policy(analysis.models[median.key], spec)
            _, grid = maps.similarity_on_grid(policy, spec, _EPSILON, _RESOLUTION, _TIME)
            kept[place] = grid, median.similarity
        except SMEError as error:
            problem = f" {error}"
    return kept, problem


def _both(label: str, **options: Any) -> list[MarkColumn]:
    """Columns of WD and OOD regret side by side."""
    return [MarkColumn(metric, label, heading, **options) for metric, heading in HEADINGS.items()]


def _spaced(names: Iterable[str] | Mapping[str, str]) -> dict[str, float]:
    """The height of each name's row, with a gap where the block changes that a mapping names."""
    blocks = names if isinstance(names, Mapping) else dict.fromkeys(names, "")
    places: dict[str, float] = {}
    y, last = -1.0, None
    for name, block in blocks.items():
        y += 1.0 if last in (None, block) else 1.4
        places[name], last = y, block
    return places


def _class_places(analysis: Analysis, rows: pd.DataFrame) -> dict[str, float]:
    """The height of each class's row, with a gap between axes."""
    present = set(rows.class_name)
    return _spaced({n: info.axis for n, info in analysis.classes.items() if n in present})


TASK_FIGURES = (
    draw_contrasts, curves.draw_regret, draw_agents, draw_regions, draw_decay, draw_aggregates,
    curves.draw_profiles, draw_improvements, draw_differences, curves.draw_class_curves,
    curves.draw_learning_curves, draw_maps, curves.draw_offline,
)  # fmt: skip
