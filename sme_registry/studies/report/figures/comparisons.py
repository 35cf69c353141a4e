"""Figures that compare classes or algorithms: contrasts, aggregates, improvements, decay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from sme_registry.plots.style import GREY, drawing, legend_below, literal, wrapped
from sme_registry.studies.report.analysis import Analysis
from sme_registry.studies.report.classes import ALL
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Grid, Look, Picture
from sme_registry.studies.report.frames import RUN
from sme_registry.studies.report.tables import ENOUGH_RUNS, METRICS

_LABELS = 2.4  # inches of the names of rows


def draw_contrasts(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """The change that each class makes: of regret, and of metrics of training."""
    for name, metrics in (("regret", METRICS[:3]), ("training", METRICS[3:])):
        rows = analysis.contrasts[analysis.contrasts.metric.isin([m.key for m in metrics])]
        if rows.empty:
            continue
        looks = {a: look for a, look in panels.looks(analysis).items() if a in set(rows.algorithm)}
        place = class_places(analysis, set(rows.class_name))
        height = 1.15 + (0.07 * len(looks) + 0.09) * max(5.0, max(place.values()) + 1)
        with panels.panel_grid(len(metrics), formats, (0.0, height)) as grid:
            if name == "regret":  # WD and OOD, of one unit and size
                grid.panels[1].sharex(grid.panels[0])
            for axes, metric in zip(grid.panels, metrics, strict=True):
                selected = rows[rows.metric == metric.key]
                at, enough = selected.class_name.map(place), selected.enough_pairs
                panels.marks_by_algorithm(axes, selected, "change", at, enough, looks)
                axes.axvline(0.0, color="black", linewidth=0.9, zorder=1.5)
                side = "right" if metric.worse > 0 else "left"
                axes.set_xlabel(f"change of\n{metric.label}\n(worse to the {side})")
                axes.locator_params(axis="x", nbins=15 // len(metrics))
            name_rows(grid, place)
            panels.legend(grid.figure, looks)
        labels = [metric.label.partition(",")[0] for metric in metrics]
        yield Picture(
            f"contrasts-{name}",
            f"What each class changes: {', '.join(labels[:-1])} and {labels[-1]}",
            f"IQM over runs of the change from the first class, {analysis.base}, to each other "
            "class, each run compared with the run of the same number, with its 95 % bootstrap "
            f"interval. Hollow: fewer than {ENOUGH_RUNS} pairs, so that the interval is an "
            "indication only.",
            grid.files,
        )


def draw_agents(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """Normalised regret of each agent of a team, WD and OOD side by side, one row an agent."""
    if not analysis.has_teams:
        return
    rows = analysis.agents
    names = rows.class_name + ", " + rows.agent
    place: dict[str, float] = {}
    for _, group in names.groupby(rows.class_name, sort=False):
        begin = max(place.values(), default=-1.4) + 1.4
        place |= {name: begin + i for i, name in enumerate(dict.fromkeys(group))}
    looks = panels.looks(analysis)
    height = 1.1 + (0.07 * len(looks) + 0.12) * max(4.0, max(place.values()) + 1)
    with panels.panel_grid(2, formats, (0.0, height)) as grid:
        for axes, (metric, heading) in zip(grid.panels, panels.HEADINGS.items(), strict=True):
            selected = rows[rows.metric == metric]
            at, enough = names[selected.index].map(place), selected.runs >= ENOUGH_RUNS
            panels.marks_by_algorithm(axes, selected, "iqm", at, enough, looks)
            axes.set_title(heading, fontsize=9)
            axes.set_xlabel("normalised regret")
        name_rows(grid, place)
        panels.legend(grid.figure, looks)
    yield Picture(
        "agents",
        "Normalised regret of each agent",
        "IQM over runs with its 95 % bootstrap interval, over the action channels that the agent "
        f"owns: 0 is the optimum, 1 the constant ½. Hollow: fewer than {ENOUGH_RUNS} runs.",
        grid.files,
    )


def draw_aggregates(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """The IQM of 1 − normalised regret, WD and OOD side by side, one row a group of classes."""
    rows = analysis.aggregates[analysis.aggregates.statistic == "iqm"]
    if rows.empty:
        return
    place = _places(rows.group)
    looks = panels.looks(analysis)
    height = 1.1 + (0.09 * len(looks) + 0.1) * max(2, len(place))
    with panels.panel_grid(2, formats, (0.0, height), share_x=True) as grid:
        for axes, (metric, heading) in zip(grid.panels, panels.HEADINGS.items(), strict=True):
            selected = rows[rows.metric == metric]
            at, enough = selected.group.map(place), selected.fewest_runs >= ENOUGH_RUNS
            panels.marks_by_algorithm(axes, selected, "value", at, enough, looks)
            axes.set_title(heading, fontsize=9)
            axes.set_xlabel("IQM of 1 − normalised regret")
        name_rows(grid, place)
        panels.legend(grid.figure, looks)
    yield Picture(
        "aggregates",
        "Aggregates over kinds of tasks",
        "Mean over classes of the IQM over runs, with its 95 % stratified bootstrap interval: "
        "1 is the optimum, 0 the constant ½. The classes of an axis include the first class.",
        grid.files,
    )


def draw_improvements(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """How probably one algorithm beats another, WD and OOD side by side, one row a pair."""
    rows = analysis.improvements[analysis.improvements.group == ALL]
    if rows.empty:
        return
    pairs = rows["first"] + " over " + rows["second"]
    place = _places(pairs)
    with panels.panel_grid(2, formats, (1.0, 0.26 * max(3, len(place)))) as grid:
        for axes, (metric, heading) in zip(grid.panels, panels.HEADINGS.items(), strict=True):
            selected = rows[rows.metric == metric]
            at, enough = pairs[selected.index].map(place), selected.fewest_runs >= ENOUGH_RUNS
            panels.marks(axes, selected, "probability", at, enough, Look("black", "o", "-"))
            axes.axvline(0.5, color=GREY, linewidth=1.0, zorder=1.5)
            axes.set_xlim(-0.02, 1.02)
            axes.set_title(heading, fontsize=9)
            axes.set_xlabel("P(a run of X beats a run of Y)")
        name_rows(grid, place, shaded=False)
    caption = (
        "How probably a run of the first algorithm beats a run of the second on a class drawn at "
        "random, with its 95 % interval: ½ where neither is better."
    )
    if analysis.has_offline_runs:
        caption += " Algorithms that learnt from different data are not compared."
    yield Picture("improvements", "Probability of improvement", caption, grid.files)


def draw_decay(analysis: Analysis, formats: Sequence[str]) -> Picture:
    """What each run loses out of distribution, against its similarity within; one mark a run."""
    inside = analysis.results.drop_duplicates(RUN, keep="first")
    outside = analysis.results.drop_duplicates(RUN, keep="last")
    loss = outside.similarity_loss.to_numpy()
    with drawing((4.8, 3.5), formats) as (figure, files):
        axes = figure.add_subplot()
        for name, look in panels.looks(analysis).items():
            selected = (inside.algorithm == name).to_numpy()
            edge = 0.8 if look.marker in "x+12" else 0.0
            axes.plot(
                inside.similarity[selected], loss[selected], **look.points, markersize=4,
                markeredgewidth=edge, alpha=0.55, label=literal(name),
            )  # fmt: skip
        axes.axhline(0.0, color=GREY, linewidth=1.0)
        axes.set_xlabel("similarity r̃ within distribution")
        axes.set_ylabel(f"points of r̃ lost in the shell up to ε = {outside.epsilon_high.max():g}")
        legend_below(figure, axes.get_legend_handles_labels()[0])
    dims = analysis.state_dims
    caption = (
        "One mark a run: its similarity in the unit cube, and the hundredths of r̃ that it loses in "
        "the outermost shell. Below 0 a run is better outside, which an agent can be whose actions "
        "saturate before it has learnt."
    )
    if len(dims) > 1:
        caption += f" It includes runs with S = {', '.join(map(str, dims))}."
        caption += panels.epsilon_remark(analysis)
    return Picture("decay", "Similarity lost outside against similarity inside", caption, files)


def _places(names: Iterable[str]) -> dict[str, float]:
    """The height of each name's row."""
    return {name: float(i) for i, name in enumerate(dict.fromkeys(names))}


def class_places(analysis: Analysis, present: set[str]) -> dict[str, float]:
    """The height of each class's row, with a gap between axes."""
    places: dict[str, float] = {}
    y, last = -1.0, None
    for info in analysis.classes.values():
        if info.name in present:
            y += 1.0 if last in (None, info.axis) else 1.4
            places[info.name], last = y, info.axis
    return places


def name_rows(grid: Grid, places: Mapping[str, float], *, shaded: bool = True) -> None:
    """Rows of marks from top to bottom, on light bands instead of grid lines."""
    for axes in grid.panels:
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        for y in places.values() if shaded else ():
            axes.axhspan(y - 0.42, y + 0.42, color="#f4f4f4", zorder=0.5, linewidth=0)
    first = grid.panels[0]
    labels = [wrapped(literal(name), _LABELS) for name in places]
    first.set_yticks([*places.values()], labels, fontsize=8)
    more = max(label.count("\n") for label in labels)
    grid.figure.set_figheight(grid.figure.get_figheight() + 0.13 * more * len(labels))
    first.set_ylim(max(places.values()) + 0.6, -0.6)
