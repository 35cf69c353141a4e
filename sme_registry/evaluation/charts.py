"""The curve of an `EvaluationReport` for notebooks: normalised regret N_m over the regions."""

from __future__ import annotations

from sme_registry.evaluation.report import LABELS, EvaluationReport
from sme_registry.terminal.svg import Line, line_chart

REFERENCES = ("constant_half", "linear_least_squares", "optimal")
"""The references that are drawn; the table has them all."""


def regret(report: EvaluationReport) -> str:
    """The policy, the agents of a team, of which the worst in WD has its name, and references."""
    lines = [
        Line(
            LABELS[name], [each.normalised_regret for each in report.references[name]], "reference"
        )
        for name in REFERENCES
        if name in report.references
    ]
    agents = {
        name: [each.normalised_regret for each in agent.regions]
        for name, agent in report.agents.items()
    }
    worst = max(agents, key=lambda name: agents[name][0], default="")
    lines += [Line(f"{name}, worst" * (name == worst), y, "other") for name, y in agents.items()]
    own = [each.normalised_regret for each in report.regions]
    lines.append(Line("team" if agents else "policy", own))
    return line_chart(
        f"Normalised regret of {report.policy}",
        [region.name for region in report.regions],
        lines,
        "normalised regret in each region",
    )
