"""A diagnosis in words, for the terminal and as Markdown; the sentences are in `templates/`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sme_registry.diagnosis.document import POLICY, Comparison, Diagnosis, Score, Verdict
from sme_registry.diagnosis.verdicts import COMPARISON_REASONS
from sme_registry.evaluation.report import LABELS
from sme_registry.spec import catalogue
from sme_registry.terminal.templates import environment

if TYPE_CHECKING:
    from jinja2 import Environment
    from rich.console import RenderableType

__all__ = ["headline", "label", "markdown", "sentence", "terminal", "title"]

_HEADINGS = {"where": "Where the error is", "why": "Why"}
_COLOURS = {"yes": "bold red", "no": "green", "cannot tell": "yellow"}


@cache
def _templates() -> Environment:
    return environment(Path(__file__).parent / "templates", autoescape=False)


def label(question: str) -> str:
    """`credit_assignment` as people read it: `credit assignment`."""
    return question.replace("_", " ")


def sentence(verdict: Verdict) -> str:
    """The verdict's reason, with its evidence and thresholds, in a few sentences."""
    name = "compared" if verdict.reason in COMPARISON_REASONS else verdict.question
    name = "solved" if verdict.reason == "solved" else name
    macros: Any = _templates().get_template("sentences.jinja").module
    return _one_line(getattr(macros, name)(verdict.reason, verdict.evidence, verdict.thresholds))


def headline(diagnosis: Diagnosis) -> str:
    """How good the policy is, where its error stands out, and which causes are established."""

    def questions(kind: str, answer: str) -> list[str]:
        return [
            label(verdict.question)
            for verdict in diagnosis.verdicts
            if (verdict.kind, verdict.answer) == (kind, answer)
        ]

    template = _templates().get_template("headline.jinja")
    return _one_line(
        template.render(
            level=diagnosis.level,
            scores=diagnosis.measurements.uniform,
            where=questions("where", "yes"),
            why=questions("why", "yes"),
            unknown=questions("why", "cannot tell"),
        )
    )


def _one_line(text: str) -> str:
    return " ".join(text.split())


def title(diagnosis: Diagnosis) -> str:
    """The run or policy, and its task."""
    spec = diagnosis.spec
    return (
        f"{diagnosis.name} on {catalogue.title(spec)} (S={spec.state_dim}, A={spec.action_dim}, "
        f"L={spec.complexity}, k={spec.k}, r_min={spec.r_min:g}, D={spec.D:g})"
    )


def terminal(diagnosis: Diagnosis) -> Iterator[RenderableType]:
    """What `sme diagnose` prints, part by part."""
    from rich.markup import escape
    from rich.table import Table

    yield f"[bold]{escape(title(diagnosis))}[/]"
    for text in (_checkpoint(diagnosis), headline(diagnosis)):
        if text:
            yield escape(text)
    yield ""
    for kind, heading in _HEADINGS.items():
        table = Table(title=heading, title_justify="left", show_header=False, box=None)
        table.add_column(style="cyan", no_wrap=True, min_width=19)
        table.add_column(no_wrap=True, min_width=11)
        table.add_column(overflow="fold")
        for question, answer, text in _rows(diagnosis, kind):
            table.add_row(question, f"[{_COLOURS[answer]}]{answer}[/]", escape(text))
        yield table
    if diagnosis.comparison is not None:
        yield ""
        heading = escape(_comparison_title(diagnosis.comparison))
        table = Table(title=heading, title_justify="left", box=None)
        table.add_column("")
        for column in ("this run", "other run", "difference"):
            table.add_column(column, justify="right")
        for row in _comparison_rows(diagnosis.comparison):
            table.add_row(*map(escape, row))
        yield table


def markdown(diagnosis: Diagnosis, figures: Sequence[str] = ()) -> str:
    """The diagnosis as a page that shows figures of the same folder."""
    comparison = diagnosis.comparison
    template = _templates().get_template("diagnosis.md.jinja")
    return template.render(
        diagnosis=diagnosis,
        title=title(diagnosis),
        headline=headline(diagnosis),
        checkpoint=_checkpoint(diagnosis),
        verdicts={
            heading: [
                (question, f"**{answer}**", text)
                for question, answer, text in _rows(diagnosis, kind)
            ]
            for kind, heading in _HEADINGS.items()
        },
        comparison=comparison
        and {
            "title": _comparison_title(comparison),
            "rows": list(_comparison_rows(comparison)),
            "answers": [(label(name), *pair) for name, pair in comparison.answers.items()],
        },
        scores=list(_score_rows(diagnosis)),
        channels=list(_channel_rows(diagnosis)),
        figures=figures,
    )


def _checkpoint(diagnosis: Diagnosis) -> str:
    if diagnosis.checkpoint_step is None:
        return ""
    return f"The run is unfinished: this is its checkpoint at step {diagnosis.checkpoint_step:,}."


def _rows(diagnosis: Diagnosis, kind: str) -> Iterable[tuple[str, str, str]]:
    for verdict in diagnosis.verdicts:
        if verdict.kind == kind:
            yield label(verdict.question), verdict.answer, sentence(verdict)


def _comparison_title(comparison: Comparison) -> str:
    fields = {**comparison.spec_fields, **comparison.plan_fields}
    values = [f"{name} ({value}, there {other})" for name, (value, other) in fields.items()]
    return f"Compared with {comparison.name}. Fields that differ: {', '.join(values) or 'none'}."


def _comparison_rows(comparison: Comparison) -> Iterable[tuple[str, ...]]:
    for row in comparison.differences:
        values = (f"{row.value:.3f}", f"{row.other:.3f}", f"{row.value - row.other:+.3f}")
        yield label(row.quantity), *values


def _score_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, ...]]:
    optimum = Score(regret=0.0, mae=0.0, normalised_regret=0.0)
    on_policy = {"optimal": optimum, **diagnosis.measurements.on_policy.scores}
    for name, score in diagnosis.measurements.uniform.items():
        policy = "**this policy**" if name == POLICY else LABELS[name]
        scores = (score, on_policy[name])
        yield policy, *(f"{x:.3f}" for s in scores for x in (s.regret, s.normalised_regret))


def _channel_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, ...]]:
    for c in diagnosis.measurements.channels:
        errors = (c.mae, c.normalised_regret, c.linear_normalised_regret, c.regret)
        yield (
            str(c.channel),
            *(f"{value:.3f}" for value in errors),
            f"{c.offset:+.3f}",
            f"{c.slope:.2f}",
            f"{c.at_zero:.1%}",
            f"{c.at_one:.1%}",
        )
