"""A team's diagnosis in words, for the terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from sme_registry.diagnosis.document import Verdict
from sme_registry.diagnosis.measurements import POLICY
from sme_registry.diagnosis.render import (
    COLOURS,
    answers,
    reason_in_words,
    sentence,
    templates,
    title,
    words,
)
from sme_registry.diagnosis.team_document import TeamDiagnosis
from sme_registry.io.tables import Answers, Paragraph, Table
from sme_registry.io.terminal import fixed

if TYPE_CHECKING:
    from rich.console import RenderableType

__all__ = ["headline", "markdown", "team_sentence", "terminal"]

_SENTENCES = "team_sentences.jinja"
_COLUMNS = (
    "agent",
    "share of regret",
    "of channels",
    "N, uniform",
    "N, own episodes",
    "N, linear",
    "gain if optimal",
)


def headline(diagnosis: TeamDiagnosis) -> str:
    """How good the team is, and who is to blame."""
    return words("headline", diagnosis, template=_SENTENCES)


def team_sentence(verdict: Verdict) -> str:
    """The reason of a verdict on the team, with its evidence and thresholds."""
    return reason_in_words(verdict, _SENTENCES)


def terminal(diagnosis: TeamDiagnosis) -> Iterator[RenderableType]:
    """What `sme diagnose` prints of a team, part by part."""
    from rich.markup import escape

    yield f"[bold]{escape(title(diagnosis))}[/]"
    yield Paragraph(headline(diagnosis))
    yield Table(
        "",
        {name: "number" if index else "name" for index, name in enumerate(_COLUMNS)},
        [[escape(cell) for cell in row] for row in _numbers(diagnosis)],
    )
    yield Paragraph(
        "N: normalised regret over the agent's channels · gain if optimal: of the team's step "
        "reward, if this agent alone acted optimally",
        style="dim italic",
    )
    yield Answers("Who is to blame", answers(diagnosis.verdicts, team_sentence), COLOURS)
    for agent in diagnosis.agents:
        rows = [row for row in answers(agent.verdicts, sentence) if row[1] == "yes"]
        if rows:
            yield Answers(f"Where the error of {agent.name} is", rows, COLOURS)
    yield Paragraph(words("left_out", diagnosis.left_out, template=_SENTENCES))


def markdown(diagnosis: TeamDiagnosis, figures: Sequence[str] = ()) -> str:
    """The diagnosis as a page that shows figures of the same folder."""
    return (
        templates()
        .get_template("team.md.jinja")
        .render(
            diagnosis=diagnosis,
            title=title(diagnosis),
            headline=headline(diagnosis),
            columns=_COLUMNS,
            rows=_numbers(diagnosis),
            verdicts=answers(diagnosis.verdicts, team_sentence),
            agents={agent.name: answers(agent.verdicts, sentence) for agent in diagnosis.agents},
            left_out=words("left_out", diagnosis.left_out, template=_SENTENCES),
            figures=figures,
        )
    )


def _numbers(diagnosis: TeamDiagnosis) -> list[tuple[str, ...]]:
    """The row of each agent under `_COLUMNS`."""
    regret = max(diagnosis.visited.regret, 1e-12)
    rows = []
    for agent in diagnosis.agents:
        measured = agent.measurements
        regrets = (
            measured.policy.normalised_regret,
            measured.on_policy.scores[POLICY].normalised_regret,
            measured.uniform["linear_least_squares"].normalised_regret,
        )
        rows.append(
            (
                agent.name,
                f"{agent.visited.regret_share / regret:.0%}",
                f"{len(agent.action_channels) / diagnosis.spec.action_dim:.0%}",
                *map(fixed, regrets),
                fixed(agent.visited.difference_reward),
            )
        )
    return rows
