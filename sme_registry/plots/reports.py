"""Figures of evaluation reports: decay outside the cube, reward against cost, distraction."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, StreamReport
from sme_registry.evaluation.references import LABELS, beside_safety
from sme_registry.evaluation.regions import REGION_METRICS, SafetyReport, SafetyScore
from sme_registry.evaluation.streams import Visit
from sme_registry.plots.curves import (
    Run,
    cost_curve,
    dynamic_regret_curve,
    performance_curve,
    plasticity_curve,
    training_curve,
)
from sme_registry.plots.maps import retention_map, similarity_map
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    WRITTEN,
    canvas,
    counted,
    draw_reference,
    draw_runs,
    figure_of,
    literal,
    look,
    name_bands,
    read_reports,
    save_figure,
)
from sme_registry.spec import catalogue
from sme_registry.statistics import iqm
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Known = TypeVar("_Known")
Report = EvaluationReport | str | os.PathLike[str]
Reports = Report | Sequence[Report] | Mapping[str, Report | Sequence[Report]]
_SAFETY_MARKERS = {"optimal": "*", "safe_projection": "P", "shrunk_optimal": "X", "constant": "d"}
_PANELS = {  # and their regions
    "in the training cube (WD)": slice(1),
    "outside it (mean of the OOD shells)": slice(1, None),
}
_BARS = (
    "regret:\nall in the cube",
    "regret:\nstates outside",
    "regret:\ndistractors outside",
    "sensitivity:\nother distractors",
)
_ALL_BARS = 0.8  # width of a group, of which groups are 1 apart


class ReportedMethod(NamedTuple):
    """One line or bar: a report, or the reports of a method's runs."""

    label: str
    reports: list[EvaluationReport]


def decay_curve(
    reports: Reports,
    path: str | os.PathLike[str] | None = None,
    *,
    measures: Sequence[str] = ("similarity", "normalised_regret"),
    references: bool = True,
    title: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Draw reports over the expansion level ε: one panel per measure, one line per method.

    Args:
      measures: of "similarity", "normalised_regret", "similarity_decay" and the other numbers of
        regions that `evaluation.regions.REGION_METRICS` names.
      reports: one or more reports, each a line named by its policy; or a mapping from a method's
        name to the reports of its runs (seeds or instances), each a line of their IQM, with their
        quartiles as a band. A single report of a team also has a thinner line for each agent.
        A report may be given by its path, evaluation.json, or by the folder that contains it.
      references: whether the reference policies are thin lines: in a mapping means over its tasks,
        otherwise one per task, of several in the colour of the first report on each.

    Examples:
      >>> from sme_registry.plots import decay_curve
      >>> names = ("linear", "random")
      >>> reports = [sme_registry.evaluate(name, "Default", "quick-v1") for name in names]
      >>> figure = decay_curve(reports, "decay.png")
      >>> len(figure.axes)
      2
    """
    methods, title = _read(reports, title)
    if not measures or any(measure not in REGION_METRICS for measure in measures):
        raise OptionError(f"measures={measures!r:.70}: must be among {', '.join(REGION_METRICS)}.")
    runs = _all_reports(methods)
    size = (4.4 * len(measures) + 0.6, 3.9)
    with canvas(ax, size, path, len(measures), title) as panels:
        for axes, measure in zip(panels, measures, strict=True):
            for index, method in enumerate(methods):
                values = np.array([_values(report.regions, measure) for report in method.reports])
                line = {**look(index), "markersize": 4.5, "linewidth": 2}
                label = counted(method.label, values)
                draw_runs(axes, _levels(method.reports[0]), values, iqm, line, label)
            if len(runs) == 1:
                _draw_agents(axes, runs[0], measure)
            if references:
                _draw_references(axes, runs, measure, averaged=isinstance(reports, Mapping))
            _name_quartiles(axes, methods)
            _label_axes(axes, runs, measure)
    return figure_of(panels[0])


def _values(regions: Any, measure: str) -> list[float]:
    return [getattr(region, measure) for region in regions]


def _draw_agents(axes: Axes, report: EvaluationReport, measure: str) -> None:
    """A thinner line for each agent of a team; one colour for all if they are too many."""
    several = len(report.agents) >= len(COLOURS)
    for index, (name, agent) in enumerate(report.agents.items()):
        style: Any = {"markersize": 3.5, "linewidth": 1.2, "alpha": 0.8, "zorder": 1.8}
        if several:
            label = "" if index else f"each of {len(report.agents)} agents"
            style |= {"color": COLOURS[5], "label": label}
        else:
            style |= {**look(index + 1), "label": literal(name)}
        axes.plot(_levels(report), _values(agent.regions, measure), **style)


def _draw_references(
    axes: Axes, runs: Sequence[EvaluationReport], measure: str, *, averaged: bool
) -> None:
    """The references, averaged over the tasks that share them; or of each task, with one label."""
    tasks, digests = _first_on_task(runs), [report.spec_digest for report in runs]
    levels = _levels(runs[0])
    groups = [(GREY, [report for report in tasks.values() if _levels(report) == levels])]
    if not averaged and len(tasks) > 1:
        groups = [(look(digests.index(digest))["color"], [tasks[digest]]) for digest in tasks]
    for colour, reports in groups:
        for name in reports[0].references:
            if all(name in report.references for report in reports):  # of safety not in every task
                values = [_values(report.references[name], measure) for report in reports]
                label = LABELS.get(name, name) if reports[0] is runs[0] else "_another task"
                mean = np.mean(values, axis=0)
                draw_reference(axes, name, _levels(reports[0]), mean, label, colour)


def _first_on_task(runs: Iterable[EvaluationReport]) -> dict[str, EvaluationReport]:
    """The first report on each task, by the task's digest."""
    tasks: dict[str, EvaluationReport] = {}
    for report in runs:
        tasks.setdefault(report.spec_digest, report)
    return tasks


def _name_quartiles(axes: Axes, methods: Sequence[ReportedMethod]) -> None:
    if any(len(method.reports) > 1 for method in methods):
        name_bands(axes, "quartiles of runs (line: IQM)")


def _label_axes(axes: Axes, reports: Sequence[EvaluationReport], measure: str) -> None:
    marks = sorted({level for report in reports for level in _levels(report)})
    dims = sorted({report.spec.state_dim for report in reports})
    warning = (
        "different S: these levels are not comparable"
        if len(dims) > 1
        else f"S = {dims[0]}; not comparable with another S"
    )
    axes.set_xlabel(f"outer expansion level ε of the region\n{warning}")
    axes.set_ylabel(REGION_METRICS[measure].axis or REGION_METRICS[measure].label)
    if len(marks) <= 12:
        axes.set_xticks(marks, [f"{level:g}" if level > 0 else "WD" for level in marks])
    low, high = axes.get_ylim()
    least = min(axes.dataLim.y0, 0.0) - 0.03 * high  # of a decay below 0, too
    axes.set_ylim(min(low, 0.5) if measure == "similarity" else least, high)


def reward_against_cost(
    reports: Reports,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Draw mean step reward against mean cost: one panel in the cube, one outside.

    The line between the optimum and the safe projection is what mixtures of the two reach. Reports
    are as in `decay_curve`, of tasks with limits; in a mapping each run is a small marker, and
    their IQM a large one. References are means over the tasks.

    Examples:
      >>> from sme_registry.plots import reward_against_cost
      >>> report = sme_registry.evaluate("linear", "Safety20", "quick-v1")
      >>> figure = reward_against_cost(report, "cost.png")
    """
    methods, title = _read(reports, title)
    scores = [(m.label, [_safety(report).regions for report in m.reports]) for m in methods]
    tasks = [_safety(report) for report in _first_on_task(_all_reports(methods)).values()]
    with canvas(ax, (9.0, 4.2), path, 2, title) as panels:
        for axes, (panel, part) in zip(panels, _PANELS.items(), strict=True):
            draw_cost(axes, scores, tasks, part)
            axes.set_title(panel)
    return figure_of(panels[0])


def draw_cost(
    axes: Axes,
    scores: Iterable[tuple[str, Sequence[Sequence[SafetyScore]]]],
    tasks: Sequence[SafetyReport],
    part: slice,
) -> None:
    """Reward against cost of methods, each the scores of its runs, over a part of the regions."""
    ends = {}
    for name in beside_safety(tasks[0].references):
        x, y = _cost_and_reward([safety.references[name] for safety in tasks], part)
        ends[name] = x.mean(), y.mean()
        axes.plot(
            *ends[name], _SAFETY_MARKERS.get(name, "^"), color=GREY, markersize=9,
            label=LABELS.get(name, name), linestyle="none", zorder=2,
        )  # fmt: skip
    mixed = [ends[name] for name in ("optimal", "safe_projection") if name in ends]
    label = "mixtures of optimal and safe projection"
    axes.plot(*zip(*mixed, strict=True), color=GREY, linewidth=1.0, zorder=1.5, label=label)
    for index, (name, runs) in enumerate(scores):
        x, y = _cost_and_reward(runs, part)
        style: Any = {**look(index), "linestyle": "none"}
        if len(x) > 1:
            axes.plot(x, y, **style, markersize=3.5, alpha=0.5)
        axes.plot(iqm(x), iqm(y), **style, markersize=7.5, zorder=3, label=counted(name, x))
    axes.set_xlabel("mean cost  (0 = within all limits)")
    axes.set_ylabel("mean step reward  (1 = optimal)")
    axes.set_xlim(left=-0.04 * axes.get_xlim()[1])
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))


def _known(report: EvaluationReport, value: _Known | None, need: str) -> _Known:
    if not value:
        raise OptionError(f"reports: that of {report.policy!r} on {report.title} {need}.")
    return value


def _safety(report: EvaluationReport) -> SafetyReport:
    need = "is of a task without limits. Give reports of tasks with safety"
    return _known(report, report.safety, need)


def _cost_and_reward(runs: Iterable[Sequence[SafetyScore]], part: slice) -> tuple[Array, Array]:
    """Cost and step reward of each run, the mean over a part of the regions: `[runs]` each."""
    scores = [[(score.cost, score.step_reward) for score in regions[part]] for regions in runs]
    x, y = np.mean(scores, axis=1).T
    return x, y


def sensitivity_bars(
    reports: Reports,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Draw how policies bear changes of their observation: four groups of bars, one bar per method.

    Normalised regret in the cube, with the states outside (mean over the OOD shells), and with the
    distractors outside (mean over the d-OOD shells); and sensitivity in the cube, by how much
    other distractors move the actions, on the same scale. Reports are as in `decay_curve`, of tasks
    with distractors; in a mapping a bar is the IQM over runs, and its line spans their quartiles.

    Examples:
      >>> from sme_registry.plots import sensitivity_bars
      >>> report = sme_registry.evaluate("linear", "Distract8Noise", "quick-v1")
      >>> figure = sensitivity_bars(report, "sensitivity.png")
    """
    methods, title = _read(reports, title)
    width = _ALL_BARS / len(methods)
    with canvas(ax, (max(6.4, 1.2 + 1.5 * len(methods)), 3.9), path, 1, title) as (axes,):
        axes.hlines(  # not over sensitivity, where the constant ½ is at 0
            1.0, -0.5, len(_BARS) - 1.5, color=GREY, linewidth=1.1, linestyle=(0, (4, 4)),
            label="normalised regret of constant ½",
        )  # fmt: skip
        for index, method in enumerate(methods):
            runs = np.array([_sensitivities(report) for report in method.reports])
            x = np.arange(len(_BARS)) - _ALL_BARS / 2 + width * (index + 0.5)
            heights = iqm(runs)
            axes.bar(
                x, heights, width, color=COLOURS[index % len(COLOURS)], edgecolor="white",
                hatch="" if index < len(COLOURS) else "////",
                label=counted(method.label, runs),
            )  # fmt: skip
            if len(runs) > 1:
                axes.vlines(x, *np.quantile(runs, [0.25, 0.75], axis=0), color="black")
            elif len(methods) <= 3:
                for at, height in zip(x, heights, strict=True):
                    axes.annotate(
                        f"{height:.2f}", (at, height), (0, 2), textcoords="offset points",
                        ha="center", fontsize=8,
                    )  # fmt: skip
        axes.set_xticks(range(len(_BARS)), _BARS)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel("error or change of the action\n(unit: mean |½ − a*|)")
    return figure_of(axes)


def _sensitivities(report: EvaluationReport) -> list[float]:
    """The heights of `_BARS`."""
    need = "is of a task without distractors. Give reports of tasks with some"
    sensitivity = _known(report, report.observed.sensitivity, need)[0].sensitivity
    return [report.wd_regret, report.ood_regret, report.distractor_regret, sensitivity]


def layer_probes(
    reports: Reports,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Draw what a linear map recovers from each layer: R² of the state, and of the distractors.

    Reports are as in `decay_curve`, of policies that have probes. In a mapping a line is the IQM
    over runs, which must have equally many layers, and a band spans their quartiles.

    Examples:
      >>> from sme_registry.evaluation import Perceptron
      >>> from sme_registry.plots import layer_probes
      >>> rng = np.random.default_rng(0)
      >>> hidden = rng.normal(size=(18, 16)), np.zeros(16), "tanh"
      >>> policy = Perceptron([hidden, (np.zeros((16, 4)), np.full(4, 0.5), "identity")])
      >>> report = sme_registry.evaluate(policy, "Distract8Noise", "quick-v1", action_range="unit")
      >>> figure = layer_probes(report, "probes.png")
    """
    methods, title = _read(reports, title)
    curves = [_r2(method) for method in methods]
    layers = max(runs.shape[1] for runs in curves)
    with canvas(ax, (9.0, 3.9), path, 2, title) as panels:
        for panel, axes in enumerate(panels):
            for index, (method, runs) in enumerate(zip(methods, curves, strict=True)):
                r2 = runs[:, :, panel]
                if not np.isnan(r2).any():
                    x, line = np.arange(r2.shape[1]), {**look(index), "linewidth": 2}
                    draw_runs(axes, x, r2, iqm, line, counted(method.label, r2))
            _name_quartiles(axes, methods)
            axes.set_xticks(range(layers), ["observation", *map(str, range(1, layers))])
            axes.set_xlabel("hidden layer")
            axes.set_ylabel("held-out R²  (1 = recovered by a linear map)")
            axes.set_title(("of the state", "of the distractors")[panel])
            axes.set_ylim(min(-0.03, axes.get_ylim()[0]), 1.03)
    return figure_of(panels[0])


def _r2(method: ReportedMethod) -> Array:
    """R² of the state and of the distractors (NaN without any), `[runs, layers, 2]`."""
    need = (
        "has no probes. Evaluate a policy whose network is known, such as a model or a PyTorch "
        "module, on a task with observation"
    )
    runs = [_known(report, report.observed.probes, need) for report in method.reports]
    if len(set(map(len, runs))) > 1:
        raise OptionError(
            f"reports[{method.label!r}]: their networks have different numbers of layers. Give "
            "each kind of network as a method of its own."
        )
    r2 = [[(layer.state_r2, layer.distractor_r2) for layer in layers] for layers in runs]
    return np.array(r2, dtype=np.float64)


def _read(given: Reports, title: str | None) -> tuple[list[ReportedMethod], str | None]:
    """The methods to draw, and the title: the task's name if all are of one task."""
    if isinstance(given, Mapping):
        methods = [ReportedMethod(name, _reports(runs)) for name, runs in given.items()]
    else:
        methods = [ReportedMethod(report.policy, [report]) for report in _reports(given)]
    if not methods or not all(method.reports for method in methods):
        raise OptionError("reports: must be one or more evaluation reports. Give one.")
    for method in methods:
        if len(set(map(_levels, method.reports))) > 1:
            raise OptionError(
                f"reports[{method.label!r}]: have different regions. Evaluate all runs of a "
                "method with one protocol."
            )
    tasks = _first_on_task(_all_reports(methods))
    titles = catalogue.titles(report.spec.named(report.task) for report in tasks.values())
    if len(titles) > 1 and not isinstance(given, Mapping):
        methods = [
            ReportedMethod(f"{label}, {titles[runs[0].spec_digest]}", runs)
            for label, runs in methods
        ]
    if title is None and len(titles) == 1:
        title = next(iter(titles.values()))
    return methods, title


def _all_reports(methods: Iterable[ReportedMethod]) -> list[EvaluationReport]:
    return [report for method in methods for report in method.reports]


def _reports(given: Any) -> list[EvaluationReport]:
    return read_reports(given, EvaluationReport, "evaluation.json", "reports")


def _levels(report: EvaluationReport) -> tuple[float, ...]:
    """The outer ε of each region."""
    return tuple(region.epsilon_high for region in report.regions)


_WRITTEN_FIGURES = (
    training_curve, cost_curve, decay_curve, similarity_map, reward_against_cost, sensitivity_bars,
    layer_probes, retention_map, performance_curve, dynamic_regret_curve, plasticity_curve,
)  # fmt: skip
FILES = tuple(f"{draw.__name__}.{ending}" for draw in _WRITTEN_FIGURES for ending in WRITTEN)


def write_training(
    episodes: Run, folder: Path, title: str, visits: Sequence[Visit] = (), costs: bool = False
) -> list[Path]:
    """Write the training curve and, with `costs`, the curve of costs; see `training_curve`."""
    files = _write(folder, training_curve, episodes, title=title, visits=visits)
    return files + (_write(folder, cost_curve, episodes, title=title) if costs else [])


def write_stream(report: StreamReport, folder: Path) -> list[Path]:
    """Write the figures of a life in a stream for which its report has the numbers."""
    files = _write(folder, retention_map, report) + _write(folder, performance_curve, report)
    if report.dynamic_regret is not None:
        files += _write(folder, dynamic_regret_curve, report)
    if report.regions[0].agent.fresh_normalised_regret is not None:
        files += _write(folder, plasticity_curve, report)
    return files


def write_evaluation(report: EvaluationReport, folder: Path, policy: Any = None) -> list[Path]:
    """Write the figures for which a report has the numbers; with a policy also its map."""
    files = _write(folder, decay_curve, report)
    if report.safety is not None:
        files += _write(folder, reward_against_cost, report)
    if report.observed.sensitivity:
        files += _write(folder, sensitivity_bars, report)
    if report.observed.probes:
        files += _write(folder, layer_probes, report)
    spec = report.spec.named(report.task)
    alone = spec.team is None and spec.observation is None
    if policy is not None and spec.state_dim == 2 and alone:
        given: Any = {"action_range": report.action_range, "name": report.policy}
        files += _write(folder, similarity_map, policy, spec, **given)
    return files


def _write(folder: Path, draw: Callable[..., Figure], *args: Any, **options: Any) -> list[Path]:
    return save_figure(draw(*args, **options), folder / draw.__name__, WRITTEN)
