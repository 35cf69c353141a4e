"""Figures of evaluation reports: decay outside the cube, reward against cost, distraction.

A line, bar or marker is a report, or a method: the reports of its runs.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import (
    EvaluationReport,
    ObservationReport,
    SafetyReport,
    SafetyScore,
    StreamReport,
)
from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.report import SAFETY_REFERENCES
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    canvas,
    counted,
    draw_reference,
    draw_runs,
    figure_of,
    literal,
    look,
    name_bands,
)
from sme_registry.spec import catalogue
from sme_registry.statistics import iqm
from sme_registry.task.draw import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Report = TypeVar("_Report", EvaluationReport, StreamReport)
Report = EvaluationReport | str | os.PathLike[str]
Reports = Report | Sequence[Report] | Mapping[str, Report | Sequence[Report]]

_EVALUATION = "evaluation.json"
Measure = Literal["similarity", "normalised_regret"]
_MEASURES = {
    "similarity": "similarity r̃  (1 = optimal)",
    "normalised_regret": "normalised regret  (1 = constant ½)",
}
SAFETY_MARKERS = {"optimal": "*", "safe_optimal": "P", "shrunk_optimal": "X", "constant_half": "d"}
_PANELS = {  # and their regions
    "in the training cube (WD)": slice(1),
    "outside it (mean of the OOD shells)": slice(1, None),
}
_BARS = (
    "regret:\nall in the cube",
    "regret:\nstates outside",
    "regret:\ndistractors outside",
    "invariance:\nother distractors",
)
_ALL_BARS = 0.8  # width of a group, of which groups are 1 apart


def decay_curve(
    reports: Reports,
    path: str | os.PathLike[str] | None = None,
    *,
    measures: Sequence[Measure] = ("similarity", "normalised_regret"),
    references: bool = True,
    title: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Draw reports over the expansion level ε: one panel per measure, one line per method.

    Args:
      reports: one or more reports, each a line named by its policy; or a mapping from a method's
        name to the reports of its runs (seeds or instances), each a line of their IQM, with their
        quartiles as a band. A single report of a team also has a thinner line for each agent.
        A report may be given by its path, evaluation.json, or by the folder that contains it.
      references: whether to draw the reference policies as thin lines. In a mapping they are means
        over its tasks; otherwise they are drawn once per task: in grey, or with several tasks in
        the colour of the first report on each task.

    Examples:
      >>> from sme_registry.plots import decay_curve
      >>> names = ("linear", "random")
      >>> reports = [sme_registry.evaluate(name, "Default", "quick-v1") for name in names]
      >>> figure = decay_curve(reports, "decay.png")
      >>> len(figure.axes)
      2
    """
    methods, everything, title = _read(reports, title)
    if not measures or any(measure not in _MEASURES for measure in measures):
        raise OptionError(f"measures={measures!r:.70}: must be among {', '.join(_MEASURES)}.")
    size = (4.4 * len(measures) + 0.6, 3.9)
    with canvas(ax, size, path, len(measures), title) as panels:
        for axes, measure in zip(panels, measures, strict=True):
            for index, method in enumerate(methods):
                _draw_method(axes, method, measure, look(index))
            if len(everything) == 1:
                _draw_agents(axes, everything[0], measure)
            if references:
                _draw_references(axes, methods, measure, averaged=isinstance(reports, Mapping))
            if len(everything) > len(methods):
                name_bands(axes, "quartiles of runs (line: IQM)")
            _label_axes(axes, everything, measure)
    return figure_of(panels[0])


def _values(regions: Any, measure: str) -> list[float]:
    return [getattr(region, measure) for region in regions]


def _draw_method(
    axes: Axes, method: ReportedMethod, measure: str, style: Mapping[str, Any]
) -> None:
    x = _levels(method.reports[0])
    runs = np.array([_values(report.regions, measure) for report in method.reports])
    line = {**style, "markersize": 4.5, "linewidth": 2}
    draw_runs(axes, x, runs, iqm, line, counted(method.label, runs))


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
    axes: Axes, methods: Sequence[ReportedMethod], measure: str, *, averaged: bool
) -> None:
    """The references of each task, or their means over all tasks, with one entry in the legend."""
    tasks: dict[str, tuple[int, EvaluationReport]] = {}
    for index, method in enumerate(methods):
        for report in method.reports:
            tasks.setdefault(report.spec_digest, (index, report))
    first = methods[0].reports[0]
    alike = [report for _, report in tasks.values() if _levels(report) == _levels(first)]
    if averaged:
        for name in first.references:
            if not all(name in report.references for report in alike):
                continue  # of safety, where only some tasks have limits
            runs = [_values(report.references[name], measure) for report in alike]
            mean = np.mean(runs, axis=0)
            draw_reference(axes, name, _levels(first), mean, LABELS.get(name, name))
        return
    for index, report in tasks.values():
        colour = GREY if len(tasks) == 1 else COLOURS[index % len(COLOURS)]
        for name, regions in report.references.items():
            label = LABELS.get(name, name) if report is first else "_another task"
            values = _values(regions, measure)
            draw_reference(axes, name, _levels(report), values, label, colour)


def _label_axes(axes: Axes, reports: Sequence[EvaluationReport], measure: str) -> None:
    marks = sorted({level for report in reports for level in _levels(report)})
    dims = sorted({report.spec.state_dim for report in reports})
    warning = (
        "different S: these levels are not comparable"
        if len(dims) > 1
        else f"S = {dims[0]}; not comparable with another S"
    )
    axes.set_xlabel(f"outer expansion level ε of the region\n{warning}")
    axes.set_ylabel(_MEASURES[measure])
    if len(marks) <= 12:
        axes.set_xticks(marks, [f"{level:g}" if level > 0 else "WD" for level in marks])
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.5) if measure == "similarity" else 0.0 - 0.03 * high, high)


def reward_against_cost(
    reports: Reports,
    path: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
    ax: Axes | Sequence[Axes] | None = None,
) -> Figure:
    """Draw mean step reward against mean cost: one panel in the cube, one outside.

    The line between the optimum and the safe optimum is what mixtures of the two reach. Reports are
    as in `decay_curve`, of tasks with limits; in a mapping each run is a small marker, and their
    IQM a large one. References are means over the tasks.

    Examples:
      >>> from sme_registry.plots import reward_against_cost
      >>> report = sme_registry.evaluate("linear", "Safety20", "quick-v1")
      >>> figure = reward_against_cost(report, "cost.png")
    """
    methods, everything, title = _read(reports, title)
    by_task = {report.spec_digest: _safety(report) for report in everything}
    with canvas(ax, (9.0, 4.2), path, 2, title) as panels:
        for axes, (panel, part) in zip(panels, _PANELS.items(), strict=True):
            ends = []
            for name in SAFETY_REFERENCES:
                x, y = _cost_and_reward(
                    [safety.references[name] for safety in by_task.values()], part
                )
                ends.append((x.mean(), y.mean()))
                axes.plot(
                    *ends[-1], SAFETY_MARKERS[name], color=GREY, markersize=9, label=LABELS[name],
                    linestyle="none", zorder=2,
                )  # fmt: skip
            axes.plot(
                *zip(*ends[:2], strict=True), color=GREY, linewidth=1.0, zorder=1.5,
                label="mixtures of optimal and safe optimum",
            )  # fmt: skip
            for index, method in enumerate(methods):
                x, y = _cost_and_reward(
                    [_safety(report).regions for report in method.reports], part
                )
                style = look(index)
                if len(x) > 1:
                    axes.plot(x, y, **style, linestyle="none", markersize=3.5, alpha=0.5)
                axes.plot(
                    iqm(x), iqm(y), **style, linestyle="none", markersize=7.5, zorder=3,
                    label=counted(method.label, x),
                )  # fmt: skip
            axes.set_title(panel)
            axes.set_xlabel("mean cost  (0 = within all limits)")
            axes.set_ylabel("mean step reward  (1 = optimal)")
            axes.set_xlim(left=-0.04 * axes.get_xlim()[1])
            axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    return figure_of(panels[0])


def _safety(report: EvaluationReport) -> SafetyReport:
    if report.safety is None:
        raise OptionError(
            f"reports: that of {report.policy!r} on {report.title} is of a task without limits. "
            "Give reports of tasks with safety."
        )
    return report.safety


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
    distractors outside (mean over the d-OOD shells); and invariance in the cube, by how much
    other distractors move the actions, on the same scale. Reports are as in `decay_curve`, of tasks
    with distractors; in a mapping a bar is the IQM over runs, and its line spans their quartiles.

    Examples:
      >>> from sme_registry.plots import sensitivity_bars
      >>> report = sme_registry.evaluate("linear", "Distract8Noise", "quick-v1")
      >>> figure = sensitivity_bars(report, "sensitivity.png")
    """
    methods, _, title = _read(reports, title)
    width = _ALL_BARS / len(methods)
    with canvas(ax, (max(6.4, 1.2 + 1.5 * len(methods)), 3.9), path, 1, title) as (axes,):
        axes.hlines(  # not over invariance, where the constant ½ is at 0
            1.0, -0.5, len(_BARS) - 1.5, color=GREY, linewidth=1.1, linestyle=(0, (4, 4)),
            label="normalised regret of constant ½",
        )  # fmt: skip
        for index, method in enumerate(methods):
            runs = np.array([_sensitivities(report) for report in method.reports])
            x = np.arange(len(_BARS)) - _ALL_BARS / 2 + width * (index + 0.5)
            heights, several = iqm(runs), len(runs) > 1
            axes.bar(
                x, heights, width, color=COLOURS[index % len(COLOURS)], edgecolor="white",
                hatch="" if index < len(COLOURS) else "////",
                label=counted(method.label, runs),
            )  # fmt: skip
            if several:
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
    methods, everything, title = _read(reports, title)
    curves = [(label, _r2(label, reports)) for label, reports in methods]
    with canvas(ax, (9.0, 3.9), path, 2, title) as panels:
        for panel, axes in enumerate(panels):
            for index, (label, runs) in enumerate(curves):
                r2 = runs[:, :, panel]
                if np.isnan(r2).any():
                    continue
                x, line = np.arange(r2.shape[1]), {**look(index), "linewidth": 2}
                draw_runs(axes, x, r2, iqm, line, counted(label, r2))
            if len(everything) > len(methods):
                name_bands(axes, "quartiles of runs (line: IQM)")
            layers = max(runs.shape[1] for _, runs in curves)
            axes.set_xticks(range(layers), ["observation", *map(str, range(1, layers))])
            axes.set_xlabel("hidden layer")
            axes.set_ylabel("held-out R²  (1 = recovered by a linear map)")
            axes.set_title(("of the state", "of the distractors")[panel])
            axes.set_ylim(min(-0.03, axes.get_ylim()[0]), 1.03)
    return figure_of(panels[0])


def _observation(report: EvaluationReport, field: str, need: str) -> ObservationReport:
    observation = report.observation
    if observation is None or not getattr(observation, field):
        raise OptionError(f"reports: that of {report.policy!r} on {report.title} {need}.")
    return observation


def _sensitivities(report: EvaluationReport) -> list[float]:
    """The heights of `_BARS`."""
    observation = _observation(
        report, "invariance", "is of a task without distractors. Give reports of tasks with some"
    )
    invariance = observation.invariance[0].invariance
    return [report.wd_regret, report.ood_regret, report.distractor_regret, invariance]


def _r2(label: str, reports: Iterable[EvaluationReport]) -> Any:
    """R² of the state and of the distractors (NaN without any), `[runs, layers, 2]`."""
    need = (
        "has no probes. Evaluate a policy whose network is known, such as a model or a PyTorch "
        "module, on a task with observation"
    )
    runs = [
        [(layer.state_r2, layer.distractor_r2) for layer in _observation(r, "probes", need).probes]
        for r in reports
    ]
    if len({len(run) for run in runs}) > 1:
        raise OptionError(
            f"reports[{label!r}]: their networks have different numbers of layers. Give each kind "
            "of network as a method of its own."
        )
    return np.array(runs, dtype=np.float64)


class ReportedMethod(NamedTuple):
    """One line or bar: a report, or the reports of a method's runs."""

    label: str
    reports: list[EvaluationReport]


def _methods_of(reports: Reports) -> list[ReportedMethod]:
    """The lines to draw; those of equal labels on different tasks are told apart by their task."""
    if isinstance(reports, Mapping):
        methods = [ReportedMethod(name, _reports(runs)) for name, runs in reports.items()]
        for method in methods:
            if len({_levels(report) for report in method.reports}) > 1:
                raise OptionError(
                    f"reports[{method.label!r}]: have different regions. Evaluate all runs of a "
                    "method with one protocol."
                )
    else:
        everything = _reports(reports)
        specs = {r.spec_digest: r.spec.named(r.task) for r in everything}
        tasks = catalogue.titles(specs.values())
        methods = [
            ReportedMethod(
                r.policy if len(tasks) == 1 else f"{r.policy}, {tasks[r.spec_digest]}", [r]
            )
            for r in everything
        ]
    if not methods or not all(method.reports for method in methods):
        raise OptionError("reports: must be one or more evaluation reports. Give one.")
    return methods


def _read(
    given: Reports, title: str | None
) -> tuple[list[ReportedMethod], list[EvaluationReport], str | None]:
    """The methods, all their reports, and the title: the task's name if all are of one task."""
    methods = _methods_of(given)
    reports = [report for method in methods for report in method.reports]
    if title is None:
        titles = catalogue.titles(report.spec.named(report.task) for report in reports)
        title = next(iter(titles.values())) if len(titles) == 1 else None
    return methods, reports, title


def read_reports(given: Any, kind: type[_Report], file: str, argument: str) -> list[_Report]:
    """One report or several, those given by their paths or by folders with this file read."""
    if isinstance(given, kind | str | os.PathLike) or not isinstance(given, Iterable):
        given = [given]
    reports = []
    for report in given:
        if isinstance(report, str | os.PathLike):
            path = Path(report)
            report = kind.read(path / file if path.is_dir() else path)
        if not isinstance(report, kind):
            article = "an" if kind.__name__[0] in "AEIO" else "a"
            raise OptionError(
                f"{argument}={report!r:.60}: must be {article} {kind.__name__}, the path of "
                f"{article} {file}, or the folder of a run."
            )
        reports.append(report)
    return reports


def _reports(given: Any) -> list[EvaluationReport]:
    return read_reports(given, EvaluationReport, _EVALUATION, "reports")


def _levels(report: EvaluationReport) -> tuple[float, ...]:
    """The outer ε of each region."""
    return tuple(region.epsilon_high for region in report.regions)
