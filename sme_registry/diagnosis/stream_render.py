"""The diagnosis of a life in words and tables, for the terminal and as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from sme_registry.diagnosis.document import Verdict
from sme_registry.diagnosis.render import COLOURS, answers, label, reason_in_words, templates, words
from sme_registry.diagnosis.stream_document import NetworkState, StreamDiagnosis
from sme_registry.io.tables import Answers, Paragraph, Table
from sme_registry.io.terminal import fixed
from sme_registry.spec import catalogue

if TYPE_CHECKING:
    from rich.console import RenderableType

__all__ = ["headline", "markdown", "stream_sentence", "stream_title", "terminal"]

_SENTENCES = "stream_sentences.jinja"
_HEADINGS = {"where": "Which phases", "why": "Plasticity and the network"}


class _Numbers(NamedTuple):
    """A table of text, the first column of names."""

    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def stream_title(diagnosis: StreamDiagnosis) -> str:
    """The run, and its stream."""
    stream = diagnosis.stream
    name = catalogue.title(stream.named(diagnosis.task))
    phases, visits = len(stream.phases), len(diagnosis.visits)
    return (
        f"{diagnosis.name} on {name} (S={stream.state_dim}, A={stream.action_dim}, "
        f"{phases} phase{'s' * (phases != 1)}, {visits} visit{'s' * (visits != 1)})"
    )


def headline(diagnosis: StreamDiagnosis) -> str:
    """How good the agent is at the end, and what became of the phases."""
    return words("headline", diagnosis, template=_SENTENCES)


def stream_sentence(verdict: Verdict) -> str:
    """The reason of a verdict on a life, with its evidence and thresholds."""
    return reason_in_words(verdict, _SENTENCES)


def terminal(diagnosis: StreamDiagnosis) -> Iterator[RenderableType]:
    """What `sme diagnose` prints of a life, part by part."""
    from rich.markup import escape

    yield f"[bold]{escape(stream_title(diagnosis))}[/]"
    yield Paragraph(headline(diagnosis))
    for numbers in (_visits(diagnosis), _phases(diagnosis)):
        columns = {
            name: "number" if index else "name" for index, name in enumerate(numbers.columns)
        }
        yield Table("", columns, numbers.rows)
    yield Paragraph(
        "N: normalised regret at the end of the visit on its own phase, or of the life on each "
        "phase · online regret: mean of 1 − r over the visit · inactive: hidden units that are "
        "dormant or saturated · rank: effective rank of the last hidden layer",
        style="dim italic",
    )
    for heading, rows in _answers(diagnosis).items():
        yield ""
        yield Answers(heading, rows, COLOURS)


def markdown(diagnosis: StreamDiagnosis, figures: Sequence[str] = ()) -> str:
    """The diagnosis as a page that shows figures of the same folder."""
    return (
        templates()
        .get_template("stream.md.jinja")
        .render(
            diagnosis=diagnosis,
            title=stream_title(diagnosis),
            headline=headline(diagnosis),
            verdicts=_answers(diagnosis),
            visits=_visits(diagnosis),
            phases=_phases(diagnosis),
            figures=figures,
        )
    )


def _answers(diagnosis: StreamDiagnosis) -> dict[str, list[tuple[str, str, str]]]:
    return {
        heading: answers(
            (each for each in diagnosis.verdicts if each.kind == kind), stream_sentence
        )
        for kind, heading in _HEADINGS.items()
    }


def _visits(diagnosis: StreamDiagnosis) -> _Numbers:
    columns = ("visit", "phase", "online regret", "N", "inactive", "rank", "weights")
    rows = [
        (
            str(visit.visit),
            str(visit.phase),
            _number(visit.online_regret),
            _number(visit.normalised_regret),
            *_network(visit.network),
        )
        for visit in diagnosis.visits
    ]
    if diagnosis.initial_network is not None:
        rows.insert(0, ("initial", "", "", "", *_network(diagnosis.initial_network)))
    return _Numbers(columns, rows)


def _phases(diagnosis: StreamDiagnosis) -> _Numbers:
    columns = ("phase", "outcome", "best N", "final N", "fresh N", "fresh online regret")
    rows = [
        (
            str(phase.phase),
            label(phase.outcome),
            _number(phase.best_normalised_regret),
            _number(phase.final_normalised_regret),
            _number(phase.fresh_normalised_regret),
            _number(phase.fresh_online_regret),
        )
        for phase in diagnosis.phases
    ]
    return _Numbers(columns, rows)


def _network(network: NetworkState | None) -> tuple[str, ...]:
    if network is None:
        return ("–", "–", "–")
    return (
        f"{network.inactive_units:.0%}",
        f"{network.effective_rank} of {network.hidden[-1]}",
        fixed(network.weight_norm, 1),
    )


def _number(value: float | None) -> str:
    return "–" if value is None else fixed(value)
