"""The figures of a study's report, drawn from its tables at the width of a printed page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pandas as pd

from sme_registry.errors import SMEError
from sme_registry.evaluation.policies import as_policy
from sme_registry.io.markup import conjunction
from sme_registry.plots import maps, style
from sme_registry.plots.style import GREY, literal, new_figure, wrapped
from sme_registry.studies.report.analysis import Analysis, by_place
from sme_registry.studies.report.design import ALL, WITHIN, Metric, metrics_of
from sme_registry.studies.report.figures import curves, panels
from sme_registry.studies.report.figures.panels import FEW, INDICATION, Drawn, Picture
from sme_registry.studies.report.frames import RUN

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EPSILON, _RESOLUTION, _TIME = 1.0, 120, 0.5  # of maps of the plane
_BOX = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
_LABELS = 2.4  # inches of the names of rows
_OF_LIVES = ("average_performance", "forgetting", "plasticity_ratio", "learning_transfer")


def draw(
    drawings: Iterable[Callable[[Analysis], Drawn]], analysis: Analysis, formats: Sequence[str]
) -> list[Picture]:
    """Pictures with their files."""
    with style.styled():
        return [
            replace(picture, files=style.encoded(picture.figure, formats))
            for drawing in drawings
            for picture in drawing(analysis)
        ]


def draw_figures(analysis: Analysis, formats: Sequence[str]) -> list[Picture]:
    from_tasks = TASK_FIGURES if analysis.algorithms else ()
    from_streams = STREAM_FIGURES if analysis.lives else ()
    return draw((*from_tasks, *from_streams), analysis, formats)


def draw_contrasts(analysis: Analysis) -> Drawn:
    general = [metric for metric in metrics_of("run") if not metric.needs]
    for name in ("regret", "training"):
        metrics = [metric for metric in general if metric.training == (name == "training")]
        labels = conjunction([metric.label.partition(",")[0] for metric in metrics])
        yield from _forest(
            analysis, analysis.tables["contrasts"], "change", metrics,
            "change of\n{label}\n({worse} is worse)",
            neutral=lambda _: 0.0, share_x=name == "regret",
            name=f"contrasts-{name}",
            title=f"What each class changes: {labels}",
            caption="IQM over runs of the change from the first class, "
            f"{analysis.base}, to each other class, each run compared with the run of the same "
            f"number, with its 95 % bootstrap interval. {FEW} pairs, {INDICATION}",
        )  # fmt: skip


def draw_agents(analysis: Analysis) -> Drawn:
    rows = analysis.tables["agents"]
    yield from _forest(
        analysis, rows.assign(place=rows.class_name + ", " + rows.agent), "iqm",
        metrics_of("score"), "{label}", "place",
        name="agents",
        title="Normalised regret of each agent",
        caption="IQM over runs with its 95 % bootstrap interval, over the action channels that the "
        f"agent owns: 0 is the optimum, 1 the constant ½. {FEW} runs.",
    )  # fmt: skip


def draw_aggregates(analysis: Analysis) -> Drawn:
    yield from _forest(
        analysis, analysis.rows("aggregates", statistic="iqm"), "value", metrics_of("score"),
        "IQM of 1 − {label}", "group",
        name="aggregates",
        title="Aggregates over kinds of tasks",
        caption="Mean over classes of the IQM over runs, with its 95 % stratified bootstrap "
        "interval: 1 is the optimum, 0 the constant ½. The classes of an axis include the first "
        "class.",
    )  # fmt: skip


def draw_improvements(analysis: Analysis) -> Drawn:
    rows = analysis.rows("improvements", group=ALL)
    yield from _forest(
        analysis, rows.assign(place=rows["first"] + " over " + rows["second"], algorithm=""),
        "probability", metrics_of("score"), "P(less {label})", "place", neutral=lambda _: 0.5,
        name="improvements",
        title="Probability of improvement",
        caption="How probably a run of the first algorithm beats a run of the second on a class "
        "drawn at random, with its 95 % interval: ½ where neither is better. Algorithms that "
        "learnt from different data are not compared.",
    )  # fmt: skip


def draw_differences(analysis: Analysis) -> Drawn:
    first = analysis.algorithms[0]
    rows = analysis.rows("differences", first=first)
    yield from _forest(
        analysis, rows.assign(algorithm=rows.second), "difference", metrics_of("score"),
        f"{literal(first)} − the other:\n{{label}}\n(left: {literal(first)} is better)",
        neutral=lambda _: 0.0,
        name="differences",
        title=f"Paired differences from {first}",
        caption=f"IQM over pairs of runs of the difference {first} minus the other algorithm, with "
        "its 95 % bootstrap interval. The runs of a pair have the same instance and seed. "
        f"{FEW} pairs, {INDICATION}",
    )  # fmt: skip


def draw_lives(analysis: Analysis) -> Drawn:
    rows = analysis.rows("stream_metrics", region=WITHIN)
    shown = [metric for metric in metrics_of("life") if metric.key in _OF_LIVES]
    yield from _forest(
        analysis, rows, "iqm", shown, "{label}\n({worse} is worse)",
        neutral=lambda metric: metric.neutral, share_x=False,
        name="stream-metrics",
        title="Performance, forgetting and plasticity of whole lives",
        caption=f"{curves.OVER_LIVES} Black lines: the constant ½, no forgetting, and as good as a "
        "fresh agent.",
    )  # fmt: skip


def _forest(
    analysis: Analysis,
    rows: pd.DataFrame,
    value: str,
    metrics: Sequence[Metric],
    label: str,
    place: str = "class_name",
    *,
    neutral: Callable[[Metric], float] | None = None,
    share_x: bool = True,
    name: str,
    title: str,
    caption: str,
) -> Drawn:
    """Marks with intervals: a panel for each metric, and a named row at each place."""
    metrics = [metric for metric in metrics if metric.key in set(rows.metric)]
    rows = rows[rows.metric.isin([metric.key for metric in metrics])]
    if rows.empty:
        return
    places = _places(analysis, rows, place)
    rows = rows.assign(at=rows[place].map(places))
    looks = panels.looks_of(analysis, rows.algorithm) or {"": panels.new_look("black", "o")}

    def draw_metric(axes: Axes, metric: Metric) -> None:
        panels.marks(axes, rows[rows.metric == metric.key], value, looks, 0.7)
        if neutral is not None:
            axes.axvline(neutral(metric), color="black", linewidth=0.9, zorder=1.5)
        for y in places.values():
            axes.axhspan(y - 0.42, y + 0.42, color="#f4f4f4", zorder=0.5, linewidth=0)
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        axes.locator_params(axis="x", nbins=5)
        text = label.format(label=metric.label, worse="right" if metric.worse > 0 else "left")
        lines = (wrapped(line, 0.9 * panels.WIDTH / len(metrics)) for line in text.splitlines())
        axes.set_xlabel("\n".join(lines))

    highest = max(places.values())
    labels = [wrapped(literal(text), _LABELS) for text in places]
    more = max(text.count("\n") for text in labels)
    height = 1.6 + (0.09 * len(looks) + 0.12) * max(4.0, highest + 1) + 0.13 * more * len(labels)
    figure = panels.grid(
        [("", metric) for metric in metrics], draw_metric, (0.0, height),
        looks={algorithm: look for algorithm, look in looks.items() if algorithm},
        across=len(metrics), share_x=share_x,
    )  # fmt: skip
    first = figure.axes[0]
    first.set_yticks([*places.values()], labels, fontsize=8)
    first.set_ylim(highest + 0.6, -0.6)
    yield Picture(name, title, caption, figure)


def _places(analysis: Analysis, rows: pd.DataFrame, place: str) -> dict[str, float]:
    """The height of each row of a forest, with a gap between axes, or between teams."""
    axes = {name: info.axis for name, info in analysis.classes.items()} | {ALL: ALL}
    places: dict[str, float] = {}
    y, last = -1.0, None
    for row in rows.drop_duplicates(place).itertuples():
        block = getattr(row, "class_name", "")
        block = axes.get(block, "") if place == "class_name" else block
        y += 1.0 if last in (None, block) else 1.4
        places[getattr(row, place)], last = y, block
    return places


def draw_regions(analysis: Analysis) -> Drawn:
    rows = analysis.tables["regions"]
    regions = list(dict.fromkeys(rows.region))
    classes = [name for name in analysis.classes if name in set(rows.class_name)]
    scale = maps.colour_scale(rows.similarity)

    def draw_map(axes: Axes, name: str) -> None:
        of_name = rows[rows.algorithm == name]
        values = of_name.pivot(index="class_name", columns="region", values="similarity")
        values = values.reindex(index=classes, columns=regions).to_numpy()
        columns = [region.replace("OOD ", "") for region in regions]
        maps.draw_matrix(axes, values, classes, columns, scale)
        axes.set_yticks(range(len(classes)), classes, fontsize=8)

    items = [(name, name) for name in analysis.algorithms]
    figure = panels.grid(
        items, draw_map, (0.75, 0.62 + 0.2 * len(classes)),
        bar="similarity r̃ (IQM over runs) in WD and in the shells OOD 1, 2, …; "
        + maps.scale_text(scale),
        ticks=maps.scale_ticks(scale),
    )  # fmt: skip
    yield Picture(
        "regions",
        "Similarity within and out of distribution",
        "IQM over runs of r̃, 1 for the optimum, in the unit cube (WD) and in each shell around "
        f"it. A dash: no run has finished.{panels.epsilon_remark(analysis)}",
        figure,
        is_map=True,
    )


def draw_decay(analysis: Analysis) -> Drawn:
    results = analysis.tables["results"]
    inside, outside = (results.drop_duplicates(RUN, keep=keep) for keep in ("first", "last"))
    loss = outside.similarity_loss.to_numpy()
    figure = new_figure((4.8, 3.5))
    axes = figure.add_subplot()
    for name, look in panels.looks_of(analysis).items():
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
    state_dims = panels.dims(analysis)
    if len(state_dims) > 1:
        caption += f" It includes runs with S = {', '.join(map(str, state_dims))}."
        caption += panels.epsilon_remark(analysis)
    yield Picture("decay", "Similarity lost outside against similarity inside", caption, figure)


def draw_maps(analysis: Analysis) -> Drawn:
    inside = analysis.rows("results", region=WITHIN)
    kept, problem = _kept_maps(analysis, inside[[_on_plane(analysis, key) for key in inside.key]])
    if not kept:
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
    figure = panels.grid(
        items, draw_map, (0.5, 2.1), width=min(panels.WIDTH, 1.4 + 2.0 * len(items)), share_x=True,
        bar=f"similarity r̃; {maps.scale_text(scale)}", ticks=maps.scale_ticks(scale),
    )  # fmt: skip
    yield Picture(
        "maps",
        "Similarity over the plane, beyond the unit square",
        "r̃ of a trained policy at each state of the plane, halfway through the episode; the square "
        "is the unit square, where it was trained. For each algorithm the run with the median r̃ "
        f"within distribution, among those whose model was kept.{problem}",
        figure,
        is_map=True,
    )


def _on_plane(analysis: Analysis, key: str) -> bool:
    """Whether a run's model was kept, and is one policy that sees the two state channels."""
    spec = analysis.cells[key].cell.spec
    is_plane = spec.state_dim == 2 and spec.team is None and spec.observation is None
    return is_plane and key in analysis.models


def _kept_maps(
    analysis: Analysis, runs: pd.DataFrame
) -> tuple[dict[tuple[str, str], tuple[Any, float]], str]:
    """(class, algorithm) → its median run's map and WD similarity; and why the last is absent."""
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


TASK_FIGURES = (
    draw_contrasts, curves.draw_regret, draw_agents, draw_regions, draw_decay, draw_aggregates,
    curves.draw_profiles, draw_improvements, draw_differences, curves.draw_class_curves,
    curves.draw_learning_curves, draw_maps, curves.draw_offline,
)  # fmt: skip
STREAM_FIGURES = (
    draw_lives, curves.draw_dynamic_regret, curves.draw_plasticity, curves.draw_retention,
    curves.draw_performance, curves.draw_lifetime_curves,
)  # fmt: skip
