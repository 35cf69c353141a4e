"""The figures of a study's report, drawn from its tables.

They have the width of a printed page. An algorithm has one colour, marker and dash in all
of them; a hollow marker stands for fewer than `ENOUGH_RUNS` runs, bars for 95 % intervals.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sme_registry.errors import SMEError
from sme_registry.evaluation import as_policy
from sme_registry.evaluation.report import NOT_COMPARABLE
from sme_registry.plots import maps, style
from sme_registry.plots.style import GREY, literal, new_figure
from sme_registry.studies.report.analysis import (
    CURVES,
    ENOUGH_RUNS,
    METRICS,
    OFFLINE_INTERVAL,
    Analysis,
    by_place,
    training_data,
)
from sme_registry.studies.report.classes import ALL, SEVERAL, Group, setting_label
from sme_registry.studies.report.figures import panels, streams
from sme_registry.studies.report.figures.panels import (
    CONSTANT,
    FEW,
    INDICATION,
    LINEAR,
    WIDTH,
    Column,
    Drawn,
    Look,
    Picture,
    curves_caption,
    looks_of,
    mark_rows,
    marks,
    new_look,
    panel_grid,
    side_by_side,
)
from sme_registry.studies.report.frames import RUN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEADINGS = {"wd_regret": "within distribution (WD)", "ood_regret": "out of distribution (OOD)"}
_BEHAVIOUR, _OPTIMUM = new_look("black"), new_look(GREY, dash=(0, (1, 1.2)))
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
    """Draw every figure that the finished runs allow."""
    from_tasks = TASK_FIGURES if analysis.algorithms else ()
    from_streams = streams.FIGURES if analysis.lives else ()
    return draw((*from_tasks, *from_streams), analysis, formats)


def draw_contrasts(analysis: Analysis) -> Drawn:
    """The change that each class makes: of regret, and of metrics of training."""
    sides = {1: "right", -1: "left"}
    table = analysis.tables["contrasts"]
    if table.empty:
        yield (
            "No contrasts: they need finished runs of one number on the first class and on another."
        )
    for name, metrics in (("regret", METRICS[:3]), ("training", METRICS[3:])):
        rows = table[table.metric.isin([metric.key for metric in metrics])]
        if rows.empty:
            continue
        columns = [
            Column(m.key, f"change of\n{m.label}\n(worse to the {sides[m.worse]})", neutral=0.0)
            for m in metrics
        ]
        labels = [metric.label.partition(",")[0] for metric in metrics]
        figure = mark_rows(
            rows.assign(place=rows.class_name, enough=rows.enough_pairs), "change", columns,
            _class_places(analysis, rows), _looks(analysis, rows.algorithm),
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


def draw_regret(analysis: Analysis) -> Drawn:
    """Normalised regret along each axis: WD and OOD in one figure for a single axis, else two."""
    caption = (
        "IQM over runs with its 95 % bootstrap interval: 0 is the optimum, 1 the constant action "
        f"½, the dashed line the linear least-squares policy fitted to the optimum. {FEW} runs."
    )
    remark, groups = _epsilon_remark(analysis), _axis_groups(analysis)
    if len(groups) == 1 and groups[0].axis not in ("", SEVERAL):
        (group,) = groups
        items = [(heading, group, metric) for metric, heading in HEADINGS.items()]
        yield Picture(
            f"regret-{group.axis.replace('.', '-')}",
            f"Normalised regret along the {group.name}",
            caption + remark,
            _regret_panels(analysis, items, x=literal(group.name)),
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
    looks = _looks(analysis, analysis.learners or analysis.algorithms)
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
    ordered = group.axis not in ("", SEVERAL)
    scale = panels.Scale.of(group.values, len(group.classes))
    x = dict(zip(group.classes, scale.at, strict=True))
    levels = analysis.tables["levels"]
    levels = levels[(levels.metric == metric) & levels.class_name.isin(x)]
    levels = levels.assign(at=levels.class_name.map(x), enough=levels.runs >= ENOUGH_RUNS)
    levels = levels.sort_values("at", kind="stable")
    linear = levels.drop_duplicates("class_name", keep="last")
    look = LINEAR if ordered else new_look(GREY, "_", "none")
    axes.plot(linear["at"], linear.linear, **look, linewidth=1.2, markersize=14, zorder=1.6)
    axes.axhline(1.0, color=GREY, linewidth=1.2, linestyle=CONSTANT["linestyle"], zorder=1.6)
    for name, look, shift in side_by_side(looks, 0.5):
        rows = levels[levels.algorithm == name]
        joined = ordered and scale.spacing != "nominal"
        at = scale.shifted(rows["at"], shift)
        marks(axes, rows, "iqm", at, look, upright=True, joined=joined)
    scale.apply(axes, [literal(label) for label in _class_labels(group)])
    axes.grid(visible=False, axis="x")


def draw_agents(analysis: Analysis) -> Drawn:
    """Normalised regret of each agent of a team, WD and OOD side by side, one row an agent."""
    rows = analysis.tables["agents"]
    if rows.empty:
        return
    rows = rows.assign(place=rows.class_name + ", " + rows.agent, enough=rows.runs >= ENOUGH_RUNS)
    blocks = dict(zip(rows.place, rows.class_name, strict=True))
    yield Picture(
        "agents",
        "Normalised regret of each agent",
        "IQM over runs with its 95 % bootstrap interval, over the action channels that the agent "
        f"owns: 0 is the optimum, 1 the constant ½. {FEW} runs.",
        mark_rows(
            rows, "iqm", _both("normalised regret"), _spaced(blocks), looks_of(analysis),
            share_x=True,
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
        f"it. A dash: no run has finished.{_epsilon_remark(analysis)}",
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
    dims = _dims(analysis)
    if len(dims) > 1:
        caption += f" It includes runs with S = {', '.join(map(str, dims))}."
        caption += _epsilon_remark(analysis)
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
    rows = rows.assign(place=rows.group, enough=rows.fewest_runs >= ENOUGH_RUNS)
    yield Picture(
        "aggregates",
        "Aggregates over kinds of tasks",
        "Mean over classes of the IQM over runs, with its 95 % stratified bootstrap interval: "
        "1 is the optimum, 0 the constant ½. The classes of an axis include the first class.",
        mark_rows(
            rows, "value", _both("IQM of 1 − normalised regret"), _spaced(rows.place),
            looks_of(analysis), share_x=True,
        ),
    )  # fmt: skip


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
    place = rows["first"] + " over " + rows["second"]
    rows = rows.assign(place=place, enough=rows.fewest_runs >= ENOUGH_RUNS, algorithm="")
    caption = (
        "How probably a run of the first algorithm beats a run of the second on a class drawn at "
        "random, with its 95 % interval: ½ where neither is better."
    )
    if not analysis.tables["offline"].empty:
        caption += " Algorithms that learnt from different data are not compared."
    columns = _both("P(a run of X beats a run of Y)", neutral=0.5, limits=(-0.02, 1.02))
    figure = mark_rows(
        rows, "probability", columns, _spaced(place), {"": new_look("black", "o")}, share_x=True
    )
    yield Picture("improvements", "Probability of improvement", caption, figure)


def draw_differences(analysis: Analysis) -> Drawn:
    """The paired difference of each algorithm from the first one, one row a class."""
    drawn, first = METRICS[:2], analysis.algorithms[0]
    rows = analysis.tables["differences"]
    rows = rows[(rows["first"] == first) & rows.metric.isin([metric.key for metric in drawn])]
    if rows.empty:
        return
    looks, places = _looks(analysis, rows.second), _class_places(analysis, rows)
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
            rows.assign(algorithm=rows.second, place=rows.class_name, enough=rows.enough_pairs),
            "difference", [Column(metric.key, label, metric.label, 0.0) for metric in drawn],
            places, looks, share_x=True,
        ),
    )  # fmt: skip


def draw_class_curves(analysis: Analysis) -> Drawn:
    """Learning curves with a panel for each class and all algorithms in it."""
    rows = analysis.tables["learning_curves"]
    rows = rows[(rows.measure == "regret") & rows.algorithm.isin(analysis.learners)]
    looks = _looks(analysis, rows.algorithm)
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
    looks = panels.numbered_looks(group.classes, colours=style.shades(len(group.classes)))
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
    rows = rows.assign(enough=rows.runs >= ENOUGH_RUNS)
    for name, look, shift in side_by_side(looks, 0.25 * apart):
        means, singles = rows[rows.learner == name], runs[runs.learner == name]
        marks(axes, means, "improvement", means.nu + shift, look, upright=True, joined=True)
        mark = {**look, "linestyle": "none", "markersize": 2.5, "markeredgewidth": 0.0}
        axes.plot(singles.nu + shift, singles.improvement, **mark, alpha=0.5, zorder=3.5)


def _dims(analysis: Analysis) -> list[int]:
    """The different state dimensions of the runs, in rising order."""
    return sorted(set(analysis.tables["results"].state_dim))


def _epsilon_remark(analysis: Analysis) -> str:
    """For captions with levels ε of several runs; "" where all have one state dimension."""
    return f" {NOT_COMPARABLE}" if len(_dims(analysis)) > 1 else ""


def _looks(analysis: Analysis, names: Iterable[str]) -> dict[str, Look]:
    """The looks of those algorithms that are among the names."""
    return {name: look for name, look in looks_of(analysis).items() if name in set(names)}


def _both(label: str, **options: Any) -> list[Column]:
    """Columns of WD and OOD regret side by side."""
    return [Column(metric, label, heading, **options) for metric, heading in HEADINGS.items()]


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


def _axis_groups(analysis: Analysis) -> Sequence[Group]:
    """Groups of single axes with several classes; all classes where there is none."""
    contrasted = [group for group in analysis.groups if group.axis and len(group.classes) > 1]
    return contrasted or analysis.groups[:1]


def _class_labels(group: Group, *, with_symbol: bool = False) -> list[str]:
    """The value of the axis in each class, `25` or `k = 25`; the class's name without an axis."""
    labels = [setting_label(group.axis, v, with_symbol=with_symbol) for v in group.values]
    return labels or list(group.classes)


TASK_FIGURES = (
    draw_contrasts, draw_regret, draw_agents, draw_regions, draw_decay, draw_aggregates,
    draw_profiles, draw_improvements, draw_differences, draw_class_curves, draw_learning_curves,
    draw_maps, draw_offline,
)  # fmt: skip
