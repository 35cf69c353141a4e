"""The figure of a team's diagnosis: who causes the regret, and how good each agent is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sme_registry.diagnosis.measurements import POLICY
from sme_registry.diagnosis.render import title
from sme_registry.diagnosis.team_document import TeamDiagnosis
from sme_registry.plots.style import (
    COLOURS,
    GREY,
    WRITTEN,
    entitle,
    legend_above,
    new_figure,
    save_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_team"]

_MAX_AGENTS = 32


def draw_team(diagnosis: TeamDiagnosis, folder: Path) -> tuple[Path, ...]:
    """Write the figure into a folder, as PNG and PDF."""
    with styled():
        figure = new_figure((8.2, 4.0))
        entitle(figure, title(diagnosis))
        _agents(figure, diagnosis)
    return tuple(save_figure(figure, folder / "who_agents", WRITTEN))


def _agents(figure: Figure, diagnosis: TeamDiagnosis) -> None:
    agents = diagnosis.agents[:_MAX_AGENTS]
    left, right = figure.subplots(1, 2)
    x = np.arange(len(agents))
    regret = max(diagnosis.visited.regret, 1e-12)
    shares = [agent.visited.regret_share / regret for agent in agents]
    channels = [len(agent.action_channels) / diagnosis.spec.action_dim for agent in agents]
    _bars(left, x - 0.2, shares, COLOURS[0], "share of the team's regret", 0.4)
    _bars(left, x + 0.2, channels, "white", "share of the action channels", 0.4)
    left.set_ylabel("share")
    for index, (label, values) in enumerate(_regrets(diagnosis).items()):
        colour = "white" if label == "linear policy" else COLOURS[index]
        _bars(right, x + 0.27 * (index - 1), values[:_MAX_AGENTS], colour, label, 0.27)
    right.set_ylabel("normalised regret  (0 = optimal)")
    right.axhline(1.0, color=GREY, linewidth=0.9)
    for axes in (left, right):
        axes.set_xticks(x, [agent.name for agent in agents], rotation=30, ha="right", fontsize=8)
        legend_above(axes)
    right.set_ylim(0.0, max(1.05, right.get_ylim()[1]))  # 1 is the constant ½; shares fill theirs


def _regrets(diagnosis: TeamDiagnosis) -> dict[str, list[float]]:
    measured = [agent.measurements for agent in diagnosis.agents]
    return {
        "uniform states": [each.policy.normalised_regret for each in measured],
        "its own episodes": [each.on_policy.scores[POLICY].normalised_regret for each in measured],
        "linear policy": [
            each.uniform["linear_least_squares"].normalised_regret for each in measured
        ],
    }


def _bars(
    axes: Axes, x: object, heights: list[float], colour: str, label: str, width: float
) -> None:
    hatch = "////" if colour == "white" else ""
    axes.bar(x, heights, width, color=colour, edgecolor=GREY, hatch=hatch, label=label)  # type: ignore[arg-type]
