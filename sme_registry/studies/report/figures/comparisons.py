"""Figures that compare classes or algorithms: contrasts, aggregates, improvements, differences."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from sme_registry.plots.style import GREY, drawing, legend_below, literal
from sme_registry.studies.report.analysis import ENOUGH_RUNS, METRICS, Analysis
from sme_registry.studies.report.classes import ALL
from sme_registry.studies.report.figures import panels
from sme_registry.studies.report.figures.panels import Column, Look, Picture, mark_rows
from sme_registry.studies.report.frames import RUN


def draw_contrasts(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """The change that each class makes: of regret, and of metrics of training."""
    sides = {1: "right", -1: "left"}
    for name, metrics in (("regret", METRICS[:3]), ("training", METRICS[3:])):
        rows = analysis.tables["contrasts"]
        rows = rows[rows.metric.isin([m.key for m in metrics])]
        if rows.empty:
            continue
        rows = rows.assign(place=rows.class_name, enough=rows.enough_pairs)
        looks = {a: look for a, look in panels.looks(analysis).items() if a in set(rows.algorithm)}
        columns = [
            Column(
                rows[rows.metric == metric.key],
                f"change of\n{metric.label}\n(worse to the {sides[metric.worse]})",
                neutral=0.0,
                ticks=15 // len(metrics),
            )
            for metric in metrics
        ]
        labels = [metric.label.partition(",")[0] for metric in metrics]
        yield Picture(
            f"contrasts-{name}",
            f"What each class changes: {', '.join(labels[:-1])} and {labels[-1]}",
            f"IQM over runs of the change from the first class, {analysis.base}, to each other "
            "class, each run compared with the run of the same number, with its 95 % bootstrap "
            f"interval. Hollow: fewer than {ENOUGH_RUNS} pairs, so that the interval is an "
            "indication only.",
            mark_rows(
                columns, "change", _class_places(analysis, set(rows.class_name)), looks, formats,
                alike=2 if name == "regret" else 0,  # WD and OOD, of one unit and size
            ),
        )  # fmt: skip


def draw_agents(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """Normalised regret of each agent of a team, WD and OOD side by side, one row an agent."""
    rows = analysis.tables["agents"]
    if rows.empty:
        return
    rows = rows.assign(place=rows.class_name + ", " + rows.agent, enough=rows.runs >= ENOUGH_RUNS)
    places: dict[str, float] = {}
    for _, group in rows.groupby("class_name", sort=False):
        begin = max(places.values(), default=-1.4) + 1.4
        places |= {name: begin + i for i, name in enumerate(dict.fromkeys(group.place))}
    columns = [
        Column(rows[rows.metric == metric], "normalised regret", heading)
        for metric, heading in panels.HEADINGS.items()
    ]
    yield Picture(
        "agents",
        "Normalised regret of each agent",
        "IQM over runs with its 95 % bootstrap interval, over the action channels that the agent "
        f"owns: 0 is the optimum, 1 the constant ½. Hollow: fewer than {ENOUGH_RUNS} runs.",
        mark_rows(columns, "iqm", places, panels.looks(analysis), formats),
    )


def draw_aggregates(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """The IQM of 1 − normalised regret, WD and OOD side by side, one row a group of classes."""
    rows = analysis.tables["aggregates"]
    rows = rows[rows.statistic == "iqm"]
    if rows.empty:
        return
    rows = rows.assign(place=rows.group, enough=rows.fewest_runs >= ENOUGH_RUNS)
    columns = [
        Column(rows[rows.metric == metric], "IQM of 1 − normalised regret", heading)
        for metric, heading in panels.HEADINGS.items()
    ]
    yield Picture(
        "aggregates",
        "Aggregates over kinds of tasks",
        "Mean over classes of the IQM over runs, with its 95 % stratified bootstrap interval: "
        "1 is the optimum, 0 the constant ½. The classes of an axis include the first class.",
        mark_rows(
            columns, "value", _places(rows.place), panels.looks(analysis), formats, alike=2
        ),
    )  # fmt: skip


def draw_improvements(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """How probably one algorithm beats another, WD and OOD side by side, one row a pair."""
    rows = analysis.tables["improvements"]
    rows = rows[rows.group == ALL]
    if rows.empty:
        return
    rows = rows.assign(
        place=rows["first"] + " over " + rows["second"],
        enough=rows.fewest_runs >= ENOUGH_RUNS,
        algorithm="",
    )
    columns = [
        Column(
            rows[rows.metric == metric], "P(a run of X beats a run of Y)", heading, neutral=0.5,
            limits=(-0.02, 1.02),
        )
        for metric, heading in panels.HEADINGS.items()
    ]  # fmt: skip
    caption = (
        "How probably a run of the first algorithm beats a run of the second on a class drawn at "
        "random, with its 95 % interval: ½ where neither is better."
    )
    if not analysis.tables["offline"].empty:
        caption += " Algorithms that learnt from different data are not compared."
    looks = {"": Look("black", "o", "-")}
    files = mark_rows(
        columns, "probability", _places(rows.place), looks, formats, shaded=False
    )  # fmt: skip
    yield Picture("improvements", "Probability of improvement", caption, files)


def draw_differences(analysis: Analysis, formats: Sequence[str]) -> Iterator[Picture]:
    """The paired difference of each algorithm from the first one, one row a class."""
    drawn, first = METRICS[:2], analysis.algorithms[0]
    rows = analysis.tables["differences"]
    rows = rows[(rows["first"] == first) & rows.metric.isin([metric.key for metric in drawn])]
    rows = rows.assign(algorithm=rows.second, place=rows.class_name, enough=rows.enough_pairs)
    looks = {a: look for a, look in panels.looks(analysis).items() if a in set(rows.second)}
    if not looks:
        return
    places = _class_places(analysis, set(rows.class_name))
    if ALL in set(rows.class_name):
        places[ALL] = max(places.values()) + 1.4
    alone = next(iter(looks)) if len(looks) == 1 else ""
    label = (
        f"{literal(first)} − {literal(alone) or 'the other'}\n(left: {literal(first)} is better)"
    )
    columns = [
        Column(rows[rows.metric == metric.key], label, metric.label, neutral=0.0, ticks=6)
        for metric in drawn
    ]
    yield Picture(
        "differences",
        f"Paired differences from {first}",
        f"IQM over pairs of runs of the difference {first} minus {alone or 'the other algorithm'}, "
        "with its 95 % bootstrap interval. The runs of a pair have the same instance and seed. "
        f"Hollow: fewer than {ENOUGH_RUNS} pairs, so that the interval is an indication only.",
        mark_rows(columns, "difference", places, looks, formats, alike=2),
    )


def draw_decay(analysis: Analysis, formats: Sequence[str]) -> Picture:
    """What each run loses out of distribution, against its similarity within; one mark a run."""
    inside = analysis.tables["results"].drop_duplicates(RUN, keep="first")
    outside = analysis.tables["results"].drop_duplicates(RUN, keep="last")
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


def _class_places(analysis: Analysis, present: set[str]) -> dict[str, float]:
    """The height of each class's row, with a gap between axes."""
    places: dict[str, float] = {}
    y, last = -1.0, None
    for info in analysis.classes.values():
        if info.name in present:
            y += 1.0 if last in (None, info.axis) else 1.4
            places[info.name], last = y, info.axis
    return places
