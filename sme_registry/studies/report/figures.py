"""The figures of a study's report, drawn from its tables; each as bytes of every format asked for.

They are drawn at the width of a printed page. An algorithm has one colour, marker and dash in all
of them; a hollow marker stands for fewer than `ENOUGH_RUNS` runs, bars for 95 % intervals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sme_registry.errors import SMEError
from sme_registry.evaluation import as_policy
from sme_registry.evaluation.report import NOT_COMPARABLE
from sme_registry.plots import (
    COLOURS,
    GREY,
    MARKERS,
    REFERENCE_DASHES,
    drawing,
    literal,
    shades,
    similarity_on_grid,
)
from sme_registry.studies.report.analysis import (
    ALL,
    AXES,
    CURVES,
    METRICS,
    REGRET_METRICS,
    SEVERAL,
    learnt_from,
)
from sme_registry.studies.report.tables import ENOUGH_RUNS, Analysis, Curve, Group, Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 7.2  # inches: a page's, so that 9 points stay 9 points
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (8, 2)))
_LINEAR_DASH = REFERENCE_DASHES["linear_least_squares"]
_CONSTANT_DASH = REFERENCE_DASHES["constant_half"]
_HEADINGS = {"wd_regret": "within distribution (WD)", "ood_regret": "out of distribution (OOD)"}
_MAP_EPSILON, _MAP_SIDE = 1.0, 120
_BOX = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}


@dataclass(frozen=True)
class Picture:
    """A drawn figure.

    Attributes:
      name: of its files.
      title: what it shows, in a few words.
      caption: how to read it.
      files: its bytes, by format.
      is_map: whether its colours are a scale, which no dark page may turn over.
    """

    name: str
    title: str
    caption: str
    files: Mapping[str, bytes]
    is_map: bool = False


class _Look(NamedTuple):
    """How an algorithm is drawn everywhere."""

    colour: str
    marker: str
    dash: Any


def pictures(
    analysis: Analysis, formats: Sequence[str], models: Mapping[str, Path]
) -> tuple[list[Picture], list[str]]:
    """Every figure that the finished runs allow.

    Args:
      analysis: the tables.
      formats: of `plots.FORMATS`.
      models: paths of trained models that were kept, by their cells' digests. They are loaded.

    Returns:
      The figures, and a sentence for each that cannot be drawn.

    Raises:
      MissingDependencyError: Matplotlib is not installed.
    """
    drawer = _Drawer(analysis, tuple(formats))
    found, absent = [], []
    for sketch in (
        drawer.contrasts(REGRET_METRICS, "contrasts-regret"),
        drawer.contrasts(METRICS[2:], "contrasts-training"),
        *(drawer.regret(metric.key) for metric in REGRET_METRICS),
        drawer.heat_map(),
        drawer.decay(),
        drawer.scores(),
        *(drawer.profiles(metric.key) for metric in REGRET_METRICS),
        drawer.improvements(),
        *drawer.learning_curves(),
        drawer.maps(models),
    ):
        if isinstance(sketch, Picture):
            found.append(sketch)
        else:
            absent.append(sketch)
    return found, absent


class _Drawer:
    """Draws one figure after the other; a method returns a sentence where there is nothing."""

    def __init__(self, analysis: Analysis, formats: Sequence[str]) -> None:
        self._analysis, self._formats = analysis, formats
        learners = [name for name in analysis.algorithms if name in analysis.learners]
        self._looks = {
            name: _Look(
                COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)], _DASHES[i % len(_DASHES)]
            )
            for i, name in enumerate(learners)
        }
        references = [name for name in analysis.algorithms if name not in self._looks]
        for i, name in enumerate(references):
            self._looks[name] = _Look(GREY, "x+12"[i % 4], _DASHES[1 + i % 4])
        self._axis_groups = [group for group in analysis.groups if group.axis]

    def learning_curves(self) -> Iterator[Picture | str]:
        """One figure an axis: algorithms side by side, the axis' values as lines."""
        if not self._analysis.curves:
            yield "No learning curves: the plan has no evaluations while training."
            return
        curves = {(c.class_name, c.algorithm, c.measure): c for c in self._analysis.curves}
        data = learnt_from(self._analysis.results)
        for group in self._axis_groups or self._analysis.groups:
            names = [
                a
                for a in self._analysis.learners
                if any((c, a, measure) in curves for c in group.classes for measure in CURVES)
            ]
            if not names:
                continue
            colours = dict(zip(group.classes, shades(len(group.classes)), strict=True))
            across = min(4, len(names))
            down = math.ceil(len(names) / across)
            size = (min(WIDTH, 1.2 + 2.6 * across), 0.6 + 4.4 * down)
            with drawing(size, self._formats) as (figure, files):
                panels = figure.subplots(len(CURVES) * down, across, squeeze=False)
                # [algorithm, measure]: an algorithm's panels stand one below the other
                stacks = np.concatenate([block.T for block in np.split(panels, down)])
                for axes in stacks[len(names) :].ravel():
                    axes.set_visible(False)
                for index, (stack, name) in enumerate(zip(stacks, names, strict=False)):
                    for axes, first, measure in zip(stack, stacks[0], CURVES, strict=True):
                        if axes is not first:
                            axes.sharey(first)
                        if axes is not stack[-1]:
                            axes.sharex(stack[-1])
                            axes.tick_params(labelbottom=False)
                        axes.tick_params(labelleft=index % across == 0)
                        if index % across == 0:
                            axes.set_ylabel(CURVES[measure])
                        own = {c: curves.get((c, name, measure)) for c in group.classes}
                        self._lines(axes, own, colours)
                    stack[0].set_title(literal(name))
                    stack[-1].set_xlabel(f"{'gradient' if data[name] else 'environment'} steps")
                    stack[-1].set_xlim(left=0)
                    stack[-1].locator_params(axis="x", nbins=4)
                    stack[-1].xaxis.set_major_formatter(_steps)
                handles = [
                    panels[0][0].plot(
                        [], [], color=colours[c], linewidth=1.6, markersize=4,
                        linestyle=_DASHES[i % len(_DASHES)], marker=MARKERS[i % len(MARKERS)],
                        label=literal(self._label(c, group)),
                    )[0]
                    for i, c in enumerate(group.classes)
                ]  # fmt: skip
                figure.legend(
                    handles=handles, loc="outside lower center", ncols=min(4, len(handles))
                )
            window = max(curve.window for curve in curves.values())
            yield Picture(
                f"learning-curves-{_file_name(group)}",
                f"Learning curves: {group.name}",
                "Median over runs, with the interquartile range as a band"
                + (f", averaged over {window} evaluations" if window > 1 else "")
                + ". Above: return in hundredths of what the optimum earns. Below: exact regret of "
                "a step, 0 for the optimum.",
                files,
            )

    def heat_map(self) -> Picture | str:
        """Similarity of every algorithm on every class in every region."""
        rows = self._analysis.regions
        regions = list(dict.fromkeys(row.region for row in rows))
        classes = [c for c in self._analysis.classes if any(row.class_name == c for row in rows)]
        if not rows:
            return "No table of regions: no run has finished."
        names = self._analysis.algorithms
        across = min(3, len(names))
        down = math.ceil(len(names) / across)
        height = down * (0.62 + 0.2 * len(classes)) + 0.75
        with drawing((WIDTH, height), self._formats) as (figure, files):
            panels = figure.subplots(down, across, squeeze=False, sharey=True)
            for axes in panels.ravel()[len(names) :]:
                axes.set_visible(False)
            image: Any = None
            for axes, name in zip(panels.ravel(), names, strict=False):
                values = np.full((len(classes), len(regions)), np.nan)
                for row in rows:
                    if row.algorithm == name:
                        at = classes.index(row.class_name), regions.index(row.region)
                        values[at] = row.similarity
                image = axes.imshow(values, vmin=0.4, vmax=1.0, cmap="viridis", aspect="auto")
                axes.grid(visible=False)
                axes.spines[:].set_visible(False)
                axes.tick_params(length=0)
                for (y, x), value in np.ndenumerate(values):
                    dark = not np.isnan(value) and np.dot(image.to_rgba(value)[:3], _LIGHT) < 0.5
                    axes.text(
                        x, y, "–" if np.isnan(value) else f"{value:.2f}"[1 - (value >= 0.995) :],
                        ha="center", va="center", fontsize=7.5, color="white" if dark else "black",
                    )  # fmt: skip
                axes.set_title(literal(name))
                shown = [region.replace("OOD ", "") for region in regions]
                axes.set_xticks(range(len(regions)), shown)
                axes.set_yticks(range(len(classes)), classes, fontsize=8)
            bar = figure.colorbar(
                image, ax=panels, location="bottom", shrink=0.5, aspect=40, pad=0.02,
                label="similarity r̃ (IQM over runs) in WD and in the shells OOD 1, 2, …",
                extend="min",
            )  # fmt: skip
            bar.outline.set_visible(False)
        return Picture(
            "regions",
            "Similarity within and out of distribution",
            "IQM over runs of r̃, 1 for the optimum, in the unit cube (WD) and in each shell around "
            f"it. A dash: no run has finished. {NOT_COMPARABLE}",
            files,
            is_map=True,
        )

    def decay(self) -> Picture | str:
        """What each run loses outside, against how good it is inside."""
        rows = self._analysis.decay
        if not rows:
            return "No decay: no run has finished."
        outermost = max(row.epsilon for row in self._analysis.regions)
        with drawing((4.8, 3.5), self._formats) as (figure, files):
            axes = figure.add_subplot()
            for name, look in self._looks.items():
                own = [row for row in rows if row.algorithm == name]
                axes.plot(
                    [row.similarity for row in own], [row.decay_points for row in own],
                    color=look.colour, marker=look.marker, markersize=4, alpha=0.55,
                    markeredgewidth=0.8 if look.marker in "x+12" else 0.0, linestyle="none",
                    label=literal(name),
                )  # fmt: skip
            axes.axhline(0.0, color=GREY, linewidth=1.0)
            axes.set_xlabel("similarity r̃ within distribution")
            axes.set_ylabel(f"points of r̃ lost in the shell up to ε = {outermost:g}")
            figure.legend(loc="outside right center")
        dims = sorted({row.state_dim for row in rows})
        caption = (
            "One mark a run: how good it is in the unit cube, and how many hundredths of r̃ it "
            "loses in the outermost shell. Below 0 it does better outside, as an agent can whose "
            "actions saturate before it has learnt."
        )
        if len(dims) > 1:
            caption += f" Runs with S = {', '.join(map(str, dims))} are in it. {NOT_COMPARABLE}"
        return Picture("decay", "Decay against performance inside", caption, files)

    def contrasts(self, metrics: Sequence[Any], name: str) -> Picture | str:
        """The change that each class makes, with its interval."""
        keys = [metric.key for metric in metrics]
        rows = [row for row in self._analysis.contrasts if row.metric in keys]
        classes = [c for c in self._analysis.classes if any(row.class_name == c for row in rows)]
        if not rows:
            return (
                "No contrasts: they need finished runs of one number on the first class and on "
                "another."
            )
        names = [a for a in self._looks if any(row.algorithm == a for row in rows)]
        place = _places(classes, [self._analysis.classes[c].axis for c in classes])
        step = 0.7 / len(names)
        size = (WIDTH, 1.15 + (0.07 * len(names) + 0.09) * max(5.0, max(place.values()) + 1))
        with drawing(size, self._formats) as (figure, files):
            panels = figure.subplots(1, len(metrics), squeeze=False, sharey=True)[0]
            for axes, metric in zip(panels, metrics, strict=True):
                for index, algorithm in enumerate(names):
                    own = [
                        row
                        for row in rows
                        if (row.algorithm, row.metric) == (algorithm, metric.key)
                    ]
                    shift = (index - (len(names) - 1) / 2) * step
                    self._marks(
                        axes,
                        [(row.change, row.low, row.high) for row in own],
                        [place[row.class_name] + shift for row in own],
                        algorithm,
                        [row.settled for row in own],
                    )
                axes.axvline(0.0, color="black", linewidth=0.9, zorder=1.5)
                side = "right" if metric.worse > 0 else "left"
                axes.set_xlabel(f"change of\n{metric.label}\n(worse to the {side})")
                axes.grid(visible=False, axis="y")
            panels[0].set_yticks([place[c] for c in classes], classes, fontsize=8)
            panels[0].set_ylim(max(place.values()) + 0.6, -0.6)
            for axes in panels:
                axes.tick_params(axis="y", length=0)
                for y in place.values():
                    axes.axhspan(y - 0.42, y + 0.42, color="#f4f4f4", zorder=0.5, linewidth=0)
            self._legend(figure, names)
        about = " and ".join(metric.label.partition(",")[0] for metric in metrics[::-1])
        if name == "contrasts-regret":
            about = "normalised regret"
        return Picture(
            name,
            f"What each class changes: {about}",
            f"IQM over runs of the change from the first class, {self._analysis.base}, to each "
            "other, each run against the run of the same number, with its 95 % bootstrap interval. "
            f"Hollow: fewer than {ENOUGH_RUNS} pairs, so that the interval is an indication only.",
            files,
        )

    def regret(self, metric: str) -> Picture | str:
        """Normalised regret along each axis, between the references."""
        groups = self._axis_groups or list(self._analysis.groups)
        if not groups:
            return "No normalised regret: no run has finished."
        names = self._analysis.learners or self._analysis.algorithms
        across = min(3, len(groups))
        down = math.ceil(len(groups) / across)
        with drawing((WIDTH, 0.7 + 2.3 * down), self._formats) as (figure, files):
            panels = figure.subplots(down, across, squeeze=False, sharey=True)
            for axes in panels.ravel()[len(groups) :]:
                axes.set_visible(False)
            for axes, group in zip(panels.ravel(), groups, strict=False):
                x = {name: i for i, name in enumerate(group.classes)}
                levels = [
                    level
                    for level in self._analysis.levels
                    if level.metric == metric and level.class_name in x
                ]
                linear = {x[level.class_name]: level.linear for level in levels}
                ordered = group.axis not in ("", SEVERAL)
                axes.plot(
                    sorted(linear), [linear[i] for i in sorted(linear)], color=GREY, linewidth=1.2,
                    linestyle=_LINEAR_DASH if ordered else "none", marker="" if ordered else "_",
                    markersize=14, zorder=1.6,
                )  # fmt: skip
                axes.axhline(1.0, color=GREY, linewidth=1.2, linestyle=_CONSTANT_DASH, zorder=1.6)
                for index, name in enumerate(names):
                    own = sorted(
                        (level for level in levels if level.algorithm == name),
                        key=lambda level: x[level.class_name],
                    )
                    shift = (index - (len(names) - 1) / 2) * 0.5 / len(names)
                    at = [x[level.class_name] + shift for level in own]
                    values = [(level.value, level.low, level.high) for level in own]
                    full = [level.runs >= ENOUGH_RUNS for level in own]
                    self._marks(axes, values, at, name, full, upright=True, joined=ordered)
                axes.set_xticks(
                    range(len(group.classes)),
                    [literal(self._tick(name, group)) for name in group.classes],
                    **({} if ordered else {"rotation": 30, "ha": "right", "fontsize": 8}),
                )
                axes.set_title(literal(group.name), fontsize=9)
                axes.set_xlim(-0.5, len(group.classes) - 0.5)
                axes.grid(visible=False, axis="x")
            panels[0][0].set_ylim(bottom=0.0)  # of all, once all is drawn: it ends autoscaling
            for row in panels:
                row[0].set_ylabel("normalised regret")
            extra = [
                panels[0][0].plot([], [], color=GREY, linewidth=1.2, linestyle=dash, label=label)[0]
                for dash, label in ((_LINEAR_DASH, "linear (LSQ)"), (_CONSTANT_DASH, "constant ½"))
            ]
            self._legend(figure, names, extra)
        return Picture(
            f"regret-{metric.removeprefix('regret_')}",
            f"Normalised regret {_HEADINGS[metric]}, along each axis",
            "IQM over runs with its 95 % bootstrap interval: 0 is the optimum, 1 the constant "
            "action ½, the dashed line the linear least-squares policy fitted to the optimum. "
            f"Hollow: fewer than {ENOUGH_RUNS} runs."
            + (f" {NOT_COMPARABLE}" if metric == "ood_regret" else ""),
            files,
        )

    def scores(self) -> Picture | str:
        """IQM of the score over each group of classes."""
        rows = [row for row in self._analysis.aggregates if row.statistic == "iqm"]
        if not rows:
            return "No scores over classes: no class has runs of every algorithm."
        groups = list(dict.fromkeys(row.group for row in rows))
        names = self._analysis.algorithms
        step = 0.7 / len(names)
        size = (WIDTH, 1.1 + (0.09 * len(names) + 0.1) * max(2, len(groups)))
        with drawing(size, self._formats) as (figure, files):
            panels = figure.subplots(1, 2, sharey=True)
            for axes, metric in zip(panels, REGRET_METRICS, strict=True):
                for index, name in enumerate(names):
                    own = [row for row in rows if (row.algorithm, row.metric) == (name, metric.key)]
                    shift = (index - (len(names) - 1) / 2) * step
                    self._marks(
                        axes,
                        [(row.value, row.low, row.high) for row in own],
                        [groups.index(row.group) + shift for row in own],
                        name,
                        [row.fewest >= ENOUGH_RUNS for row in own],
                    )
                axes.set_title(_HEADINGS[metric.key], fontsize=9)
                axes.set_xlabel("IQM of 1 − normalised regret")
                axes.grid(visible=False, axis="y")
                axes.tick_params(axis="y", length=0)
                for y in range(len(groups)):
                    axes.axhspan(y - 0.42, y + 0.42, color="#f4f4f4", zorder=0.5, linewidth=0)
            panels[0].set_yticks(range(len(groups)), [literal(g) for g in groups], fontsize=8)
            panels[0].set_ylim(len(groups) - 0.4, -0.6)
            self._legend(figure, names)
        return Picture(
            "scores",
            "Scores over kinds of tasks",
            "Mean over classes of the IQM over runs, with its 95 % stratified bootstrap interval: "
            "1 is the optimum, 0 the constant ½. An axis' classes are taken with the first class.",
            files,
        )

    def profiles(self, metric: str) -> Picture | str:
        """The share of runs above each score."""
        rows = [row for row in self._analysis.profiles if row.metric == metric]
        if not rows:
            return "No performance profiles: no class has runs of every algorithm."
        groups = list(dict.fromkeys(row.group for row in rows))
        across = min(3, len(groups))
        down = math.ceil(len(groups) / across)
        with drawing((WIDTH, 0.7 + 2.1 * down), self._formats) as (figure, files):
            panels = figure.subplots(down, across, squeeze=False, sharey=True, sharex=True)
            for axes in panels.ravel()[len(groups) :]:
                axes.set_visible(False)
            for axes, group in zip(panels.ravel(), groups, strict=False):
                for row in (row for row in rows if row.group == group):
                    look, found = self._looks[row.algorithm], row.estimate
                    axes.fill_between(
                        row.thresholds, found.low, found.high, color=look.colour, alpha=0.15,
                        linewidth=0,
                    )  # fmt: skip
                    axes.plot(
                        row.thresholds, found.value, color=look.colour, linestyle=look.dash,
                        linewidth=1.6, marker=look.marker, markersize=3.5, markevery=(5, 20),
                    )  # fmt: skip
                axes.set_title(literal(group), fontsize=9)
                axes.set_ylim(-0.02, 1.02)
                axes.set_xlim(0.0, 1.0)
                axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            for row_of_panels in panels:
                row_of_panels[0].set_ylabel("share of runs above τ")
            for index, axes in enumerate(panels.ravel()[: len(groups)]):
                axes.tick_params(labelbottom=index + across >= len(groups))
                if index + across >= len(groups):
                    axes.set_xlabel("score τ = 1 − normalised regret")
            self._legend(figure, self._analysis.algorithms)
        return Picture(
            f"profiles-{metric.removeprefix('regret_')}",
            f"Performance profiles {_HEADINGS[metric]}",
            "The share of runs whose score lies above τ, classes counting alike, with pointwise "
            "95 % bands. A line above another is better at every score.",
            files,
        )

    def improvements(self) -> Picture | str:
        """Every pair of algorithms."""
        rows = [row for row in self._analysis.improvements if row.group == ALL]
        if not rows:
            return (
                "No comparison of algorithms: there are not two with runs on the same classes, "
                "nor with the same data where they learn from data."
            )
        pairs = list(dict.fromkeys((row.first, row.second) for row in rows))
        with drawing((WIDTH, 1.0 + 0.26 * max(3, len(pairs))), self._formats) as (figure, files):
            panels = figure.subplots(1, 2, sharey=True)
            for axes, metric in zip(panels, REGRET_METRICS, strict=True):
                own = [row for row in rows if row.metric == metric.key]
                self._marks(
                    axes,
                    [(row.value, row.low, row.high) for row in own],
                    [pairs.index((row.first, row.second)) for row in own],
                    None,
                    [row.fewest >= ENOUGH_RUNS for row in own],
                )
                axes.axvline(0.5, color=GREY, linewidth=1.0, zorder=1.5)
                axes.set_xlim(-0.02, 1.02)
                axes.set_title(_HEADINGS[metric.key], fontsize=9)
                axes.set_xlabel("P(a run of X beats a run of Y)")
                axes.grid(visible=False, axis="y")
                axes.tick_params(axis="y", length=0)
            labels = [literal(f"{first} over {second}") for first, second in pairs]
            panels[0].set_yticks(range(len(pairs)), labels)
            panels[0].set_ylim(len(pairs) - 0.5, -0.5)
        return Picture(
            "improvement",
            "Probability of improvement",
            "How probably a run of the first algorithm beats a run of the second on a class drawn "
            "at random, with its 95 % interval: ½ where neither is better."
            + (
                " Who learnt from different data is not compared." if self._analysis.offline else ""
            ),
            files,
        )

    def maps(self, models: Mapping[str, Path]) -> Picture | str:
        """Similarity over the plane, for tasks with two state channels."""
        plane = [run for run in self._analysis.results if run.result.cell.spec.state_dim == 2]
        if not plane:
            return "No maps of the plane: no finished run has a task with two state channels."
        grids: dict[tuple[str, str], tuple[Run, Any]] = {}
        low, high = -_MAP_EPSILON / 2.0, 1.0 + _MAP_EPSILON / 2.0
        side = low + (np.arange(_MAP_SIDE) + 0.5) * (high - low) / _MAP_SIDE
        problem = ""
        for place in dict.fromkeys(run.place for run in plane):
            own = sorted(
                (run for run in plane if run.place == place and run.result.key in models),
                key=lambda run: (run.result.report.regions[0].similarity, run.planned.run),
            )
            if not own:
                continue
            chosen = own[(len(own) - 1) // 2]
            spec = chosen.result.cell.spec
            try:
                policy = as_policy(models[chosen.result.key], spec)
                grids[place] = chosen, similarity_on_grid(policy, spec, side, 0.5)
            except SMEError as error:
                problem = f" {error}"
        if not grids:
            return (
                "No maps of the plane: they need trained models, which a run with --keep-models "
                f"in a new folder keeps.{problem}"
            )
        classes = list(dict.fromkeys(place[0] for place in grids))
        names = list(dict.fromkeys(place[1] for place in grids))
        size = (min(WIDTH, 1.4 + 2.0 * len(classes)), 0.5 + 1.95 * len(names))
        with drawing(size, self._formats) as (figure, files):
            panels = figure.subplots(
                len(names), len(classes), squeeze=False, sharex=True, sharey=True
            )
            image: Any = None
            for (y, x), axes in np.ndenumerate(panels):
                axes.grid(visible=False)
                axes.set_xticks([0, 1])
                axes.set_yticks([0, 1])
                if y == 0:
                    axes.set_title(classes[x])
                if x == 0:
                    axes.set_ylabel(literal(names[y]))
                if (classes[x], names[y]) not in grids:
                    axes.set_axis_off()
                    continue
                chosen, grid = grids[classes[x], names[y]]
                image = axes.imshow(
                    grid, origin="lower", extent=(low, high, low, high), vmin=0.0, vmax=1.0,
                    cmap="viridis", interpolation="nearest",
                )  # fmt: skip
                for colour, width in (("white", 2.4), ("black", 1.0)):
                    axes.plot([0, 1, 1, 0, 0], [0, 0, 1, 1, 0], color=colour, linewidth=width)
                inside = chosen.result.report.regions[0].similarity
                axes.text(
                    0.03, 0.03, f"WD {inside:.2f}", transform=axes.transAxes, fontsize=7.5,
                    bbox=_BOX, color="black",
                )  # fmt: skip
            bar = figure.colorbar(image, ax=panels, label="similarity r̃", shrink=0.8)
            bar.outline.set_visible(False)
        return Picture(
            "maps",
            "Similarity over the plane, beyond the unit square",
            "r̃ of a trained policy at each state of the plane, at half of the episode; the square "
            "is the unit square, where it was trained. Of each algorithm the run with the median "
            f"r̃ within distribution, among those whose model was kept.{problem}",
            files,
            is_map=True,
        )

    def _lines(
        self, axes: Axes, curves: Mapping[str, Curve | None], colours: Mapping[str, Any]
    ) -> None:
        """An algorithm's learning curves, one a class; None where it has none."""
        for index, (class_name, curve) in enumerate(curves.items()):
            if curve is None:
                continue
            colour = colours[class_name]
            axes.fill_between(
                curve.steps, curve.low, curve.high, color=colour, alpha=0.13, linewidth=0
            )
            every = max(1, len(curve.steps) // 6)
            axes.plot(
                curve.steps, curve.median, color=colour, linewidth=1.6,
                linestyle=_DASHES[index % len(_DASHES)], marker=MARKERS[index % len(MARKERS)],
                markersize=4, markevery=(index * every // len(curves), every),
            )  # fmt: skip

    def _marks(
        self,
        axes: Axes,
        values: Sequence[tuple[float, float | None, float | None]],
        at: Sequence[float],
        algorithm: str | None,
        full: Sequence[bool],
        *,
        upright: bool = False,
        joined: bool = False,
    ) -> None:
        """Values with their intervals: along x, or upright along y."""
        look = _Look("black", "o", "-") if algorithm is None else self._looks[algorithm]
        if joined:
            axes.plot(
                at, [value for value, _, _ in values], color=look.colour, linewidth=1.1,
                linestyle=look.dash, alpha=0.7,
            )  # fmt: skip
        for place, (value, low, high), is_full in zip(at, values, full, strict=True):
            if low is not None and high is not None:
                ends = ([place, place], [low, high])
                axes.plot(*(ends if upright else ends[::-1]), color=look.colour, linewidth=1.4)
            axes.plot(
                *((place, value) if upright else (value, place)), color=look.colour,
                marker=look.marker, markersize=4.5, markeredgewidth=1.1,
                markerfacecolor=look.colour if is_full else "white", linestyle="none", zorder=3,
            )  # fmt: skip

    def _legend(self, figure: Figure, names: Sequence[str], extra: Sequence[Any] = ()) -> None:
        axes = figure.axes[0]
        handles = [
            axes.plot(
                [], [], color=look.colour, marker=look.marker, markersize=4.5, linewidth=1.4,
                linestyle=look.dash, label=literal(name),
            )[0]
            for name, look in ((name, self._looks[name]) for name in names)
        ]  # fmt: skip
        handles += extra
        figure.legend(handles=handles, loc="outside lower center", ncols=min(6, len(handles)))

    def _label(self, class_name: str, group: Group) -> str:
        """A class in a legend: `k = 25`."""
        if group.axis not in AXES:
            return class_name
        value = self._analysis.classes[class_name].setting[group.axis]
        return f"{AXES[group.axis][0]} = {value if isinstance(value, str) else format(value, 'g')}"

    def _tick(self, class_name: str, group: Group) -> str:
        """A class on an axis: `25`."""
        return self._label(class_name, group).rpartition(" = ")[2]


_LIGHT = (0.299, 0.587, 0.114)  # how bright red, green and blue are


def _steps(value: float, _: Any) -> str:
    return f"{value / 1000:g}k" if value >= 10_000 else f"{value:g}"


def _file_name(group: Group) -> str:
    return (group.axis or group.name).replace(" ", "-").lower()


def _places(classes: Sequence[str], axes: Sequence[str]) -> dict[str, float]:
    """Where classes stand below one another: a gap between axes."""
    found, y = {}, -1.0
    for index, name in enumerate(classes):
        y += 1.0 if index == 0 or axes[index] == axes[index - 1] else 1.4
        found[name] = y
    return found
