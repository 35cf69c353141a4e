"""The figures of limits and of distractors, which only tasks with them have."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sme_registry.diagnosis.measurements import Distraction, Limits
from sme_registry.evaluation import ObservationReport, SafetyScore
from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.tables import SAFETY_REFERENCES
from sme_registry.plots.safety import MARKERS
from sme_registry.plots.style import COLOURS, GREY, legend_above, look

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_distraction", "draw_layers", "draw_limits"]

_MAX_CHANNELS = 32
_HALF = LABELS["constant_half"]


def draw_limits(figure: Figure, limits: Limits) -> None:
    """Reward against cost, and which action channels violate their limits."""
    left, right = figure.subplots(1, 2)
    for name in SAFETY_REFERENCES:
        _point(left, limits.report.references[name][0], LABELS[name], MARKERS[name], GREY)
    own = {
        "this policy": limits.report.regions[0],
        "cut off at the limits": limits.cut_off,
        "in visited states": limits.visited,
    }
    for index, (label, score) in enumerate(own.items()):
        _point(left, score, label, str(look(index)["marker"]), COLOURS[index])
    left.set_xlabel("mean cost  (0 = within all limits)")
    left.set_ylabel("mean step reward  (1 = optimal)")
    left.set_xlim(-0.005, max(0.05, 1.1 * left.get_xlim()[1]))
    left.set_ylim(0.0, 1.05)
    channels = limits.channels[:_MAX_CHANNELS]
    x = np.array([c.channel for c in channels])
    shares = [c.violating_share for c in channels], [c.optimal_violating_share for c in channels]
    right.bar(x - 0.2, shares[0], 0.4, color=COLOURS[0], label="this policy")
    right.bar(
        x + 0.2, shares[1], 0.4, color="white", edgecolor=GREY, hatch="////",
        label=LABELS["optimal"],
    )  # fmt: skip
    cut = len(limits.channels) > _MAX_CHANNELS
    right.set_xlabel("action channel" + (f" (the first {_MAX_CHANNELS})" if cut else ""))
    right.set_xticks(x[:: max(1, len(x) // 8)])
    right.set_ylabel("share of states above the limit")
    right.set_ylim(0.0, max(0.1, right.get_ylim()[1]))
    legend_above(left, ncols=2)
    legend_above(right, ncols=2)


def _point(axes: Axes, score: SafetyScore, label: str, marker: str, colour: str) -> None:
    axes.plot(
        score.cost, score.step_reward, marker, color=colour, markersize=8, linestyle="none",
        label=label, clip_on=False,
    )  # fmt: skip


def draw_distraction(
    figure: Figure, distraction: Distraction, observation: ObservationReport
) -> None:
    """Regret with other distractors, and how much they move the actions."""
    left, right = figure.subplots(1, 2)
    bars = {
        "uniform": distraction.normalised_regret,
        "averaged out": distraction.averaged_regret,
        "all at ½": distraction.half_regret,
        **{region.name: region.normalised_regret for region in observation.distractor_regions},
    }
    colours = [COLOURS[0]] * 3 + [COLOURS[1]] * len(observation.distractor_regions)
    drawn = left.barh(list(bars), list(bars.values()), 0.7, color=colours)
    left.bar_label(drawn, [f"{value:.2f}" for value in bars.values()], padding=3, fontsize=8)
    left.invert_yaxis()
    left.axvline(1.0, color=GREY, linewidth=1.1, linestyle=(0, (4, 4)), label=_HALF)
    left.set_xlim(0.0, max(1.15, 1.1 * max(bars.values())))
    left.set_xlabel("normalised regret  (0 = optimal)")
    left.set_ylabel("distractors")
    names = [each.name for each in observation.invariance]
    changes = [each.invariance for each in observation.invariance]
    drawn = right.bar(names, changes, 0.7, color=COLOURS[2])
    right.bar_label(drawn, [f"{value:.2f}" for value in changes], padding=2, fontsize=8)
    right.set_ylim(0.0, max(0.1, 1.15 * max(changes)))
    right.set_xlabel("region of the state")
    right.set_ylabel("change of a by other distractors\n(unit: mean |½ − a*|)")
    legend_above(left)
    left.grid(visible=False, axis="y")
    right.grid(visible=False, axis="x")


def draw_layers(figure: Figure, observation: ObservationReport) -> None:
    """What a linear map recovers from each layer."""
    axes, probes = figure.add_subplot(), observation.probes
    x = np.arange(len(probes))
    axes.plot(x, [p.state_r2 for p in probes], **look(0), linewidth=2, label="of the state")
    if probes[0].distractor_r2 is not None:
        r2 = np.array([p.distractor_r2 for p in probes], np.float64)
        axes.plot(x, r2, **look(1), linewidth=2, label="of the distractors")
    layers = [f"hidden {p.layer}\n({p.units} units)" for p in probes[1:]]
    axes.set_xticks(x, [f"observation\n({probes[0].units})", *layers])
    axes.set_ylabel("held-out R²  (1 = recovered by a linear map)")
    axes.set_ylim(min(-0.03, axes.get_ylim()[0]), 1.03)
    legend_above(axes, ncols=2)
