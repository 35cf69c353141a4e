"""`sensitivity_bars` and `layer_probes`: what distracts a policy, and what its layers keep."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sme_registry.errors import OptionError
from sme_registry.evaluation import EvaluationReport, ObservationReport
from sme_registry.plots.methods import Reports, methods_of, only_title
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    canvas,
    draw_band,
    entitle,
    figure_of,
    literal,
    look,
    name_bands,
)
from sme_registry.statistics import iqm

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BARS = (
    "regret:\nall in the cube",
    "regret:\nstates outside",
    "regret:\ndistractors outside",
    "invariance:\nother distractors",
)
_ALL_BARS = 0.8  # width of a group, of which groups are 1 apart


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
    methods = methods_of(reports)
    everything = [report for method in methods for report in method.reports]
    width = _ALL_BARS / len(methods)
    with canvas(ax, (max(6.4, 1.2 + 1.5 * len(methods)), 3.9), path) as (axes,):
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
                label=literal(method.label) + (f" (n = {len(runs)})" if several else ""),
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
        title = only_title(everything) if title is None else title
        if ax is None and title:
            entitle(figure_of(axes), title)
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
    methods = methods_of(reports)
    everything = [report for method in methods for report in method.reports]
    curves = [(each.label, _r2(each.label, each.reports)) for each in methods]
    with canvas(ax, (9.0, 3.9), path, panels=2) as panels:
        for panel, axes in enumerate(panels):
            for index, (label, runs) in enumerate(curves):
                r2 = runs[:, :, panel]
                if np.isnan(r2).any():
                    continue
                x, several = np.arange(r2.shape[1]), len(r2) > 1
                if several:
                    low, high = np.quantile(r2, [0.25, 0.75], axis=0)
                    draw_band(axes, x, low, high, look(index)["color"])
                suffix = f" (n = {len(r2)})" if several else ""
                axes.plot(x, iqm(r2), **look(index), linewidth=2, label=literal(label) + suffix)
            if len(everything) > len(methods):
                name_bands(axes, "quartiles of runs (line: IQM)")
            layers = max(runs.shape[1] for _, runs in curves)
            axes.set_xticks(range(layers), ["observation", *map(str, range(1, layers))])
            axes.set_xlabel("hidden layer")
            axes.set_ylabel("held-out R²  (1 = recovered by a linear map)")
            axes.set_title(("of the state", "of the distractors")[panel])
            axes.set_ylim(min(-0.03, axes.get_ylim()[0]), 1.03)
        title = only_title(everything) if title is None else title
        if ax is None and title:
            entitle(figure_of(panels[0]), title)
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
        [(each.state_r2, each.distractor_r2) for each in _observation(r, "probes", need).probes]
        for r in reports
    ]
    if len({len(run) for run in runs}) > 1:
        raise OptionError(
            f"reports[{label!r}]: their networks have different numbers of layers. Give each kind "
            "of network as a method of its own."
        )
    return np.array(runs, dtype=np.float64)
