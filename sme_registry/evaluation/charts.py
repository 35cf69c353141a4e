"""The curve of an `EvaluationReport` for notebooks: normalised regret N_m over the regions."""

from __future__ import annotations

from sme_registry.evaluation.report import LABELS, EvaluationReport
from sme_registry.io.markup import Line, line_chart

REFERENCES = ("constant_half", "linear_least_squares", "optimal")
"""The references that are drawn; the table has them all."""
_MOST_AGENTS = 20  # drawn: a card stays small
_NAME = 10  # letters for which there is space beside ", worst"


def regret(report: EvaluationReport) -> str:
    """The policy, the worst agents of a team, with the name of the worst in WD, and references."""
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
    worst = sorted(agents, key=lambda name: -agents[name][0])[:_MOST_AGENTS]
    lines += [
        Line(f"{_brief(name)}, worst" if name == worst[0] else "", agents[name], "other")
        for name in worst
    ]
    own = [each.normalised_regret for each in report.regions]
    lines.append(Line("team" if agents else "policy", own))
    return line_chart(
        f"Normalised regret of {report.policy}",
        [region.name for region in report.regions],
        lines,
        "normalised regret in each region",
    )


def _brief(name: str) -> str:
    return name if len(name) <= _NAME else f"{name[: _NAME - 1]}…"
