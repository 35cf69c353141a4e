"""A diagnosis in words, for the terminal and as Markdown; the sentences are in `templates/`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sme_registry.diagnosis.document import Diagnosis, Verdict
from sme_registry.diagnosis.measurements import POLICY
from sme_registry.diagnosis.team_document import TeamDiagnosis
from sme_registry.diagnosis.verdicts import COMPARISON_REASONS
from sme_registry.evaluation.references import LABELS
from sme_registry.evaluation.tables import SAFETY_REFERENCES
from sme_registry.io.markup import environment as sentence_environment
from sme_registry.spec import SMESpec, catalogue

if TYPE_CHECKING:
    from jinja2 import Environment
    from rich.console import RenderableType

__all__ = [
    "COLOURS",
    "answers",
    "headline",
    "label",
    "markdown",
    "reason_in_words",
    "sentence",
    "templates",
    "terminal",
    "title",
    "words",
]

_HEADINGS = {"where": "Where the error is", "why": "Why", "limits": "Limits"}
COLOURS = {"yes": "bold red", "no": "green", "cannot tell": "yellow"}


def label(question: str) -> str:
    """`credit_assignment` as people read it: `credit assignment`."""
    return question.replace("_", " ")


@cache
def templates() -> Environment:
    """The templates of diagnoses."""
    environment = sentence_environment(Path(__file__).parent / "templates", autoescape=False)
    environment.filters["label"] = label
    return environment


def words(macro: str, *arguments: Any, template: str = "sentences.jinja") -> str:
    """A macro of a template, on one line."""
    macros: Any = templates().get_template(template).module
    return " ".join(getattr(macros, macro)(*arguments).split())


def reason_in_words(verdict: Verdict, template: str) -> str:
    """The verdict's reason, with its evidence and thresholds, by its question's macro."""
    arguments = verdict.reason, verdict.evidence, verdict.thresholds
    return words(verdict.question, *arguments, template=template)


def answers(
    verdicts: Iterable[Verdict], sentence: Callable[[Verdict], str]
) -> list[tuple[str, str, str]]:
    """The question, the answer and the sentence of each verdict."""
    return [(label(each.question), each.answer, sentence(each)) for each in verdicts]


def sentence(verdict: Verdict) -> str:
    """The verdict's reason, with its evidence and thresholds, in a few sentences."""
    reason, evidence, thresholds = verdict.reason, verdict.evidence, verdict.thresholds
    if reason not in COMPARISON_REASONS:
        macro = "solved" if reason == "solved" else verdict.question
        return words(macro, reason, evidence, thresholds)
    text = words("compared", reason, evidence, thresholds)
    own_answer, own_reason = evidence["own_answer"], evidence["own_reason"]
    if own_answer == "cannot tell":
        return text
    alone = words(verdict.question, own_reason, evidence, thresholds)
    return f"{text} {words('alone', own_answer)} {alone}"


def headline(diagnosis: Diagnosis) -> str:
    """How good the policy is, where its error stands out, and which causes are established."""
    return words("headline", diagnosis)


def title(diagnosis: Diagnosis | TeamDiagnosis) -> str:
    """The run or policy, and its task."""
    spec = diagnosis.spec
    task = catalogue.title(spec.named(diagnosis.task))
    return (
        f"{diagnosis.name} on {task} (S={spec.state_dim}, A={spec.action_dim}, "
        f"L={spec.complexity}, k={spec.k}, r_min={spec.r_min:g}, D={spec.D:g}{_extensions(spec)})"
    )


def _extensions(spec: SMESpec) -> str:
    """The tightness, the distractors and the mixing of a task that has them."""
    parts = []
    if spec.safety is not None:
        parts.append(f"τ={spec.safety.tightness:g}")
    if spec.observation is not None:
        if spec.distractors:
            parts.append(f"m={spec.distractors} {spec.observation.dynamics}")
        if spec.observation.mixing != "none":
            parts.append(f"mixing={spec.observation.mixing}")
    return "".join(f", {part}" for part in parts)


def terminal(diagnosis: Diagnosis) -> Iterator[RenderableType]:
    """What `sme diagnose` prints, part by part."""
    from rich.markup import escape

    from sme_registry.io.tables import Answers, Paragraph, Table

    yield f"[bold]{escape(title(diagnosis))}[/]"
    yield Paragraph(headline(diagnosis))
    for heading, rows in _rows(diagnosis).items():
        yield ""
        yield Answers(heading, rows, COLOURS)
    if diagnosis.comparison is not None:
        yield ""
        yield Paragraph(words("comparison", diagnosis.comparison))
        numbers = ("this run", "other run", "difference")
        differences = Table("", {"": "text", **dict.fromkeys(numbers, "number")})
        for row in diagnosis.comparison.differences:
            values = (f"{row.value:.3f}", f"{row.other:.3f}", f"{row.value - row.other:+.3f}")
            differences.add_row(label(row.quantity), *values)
        yield differences


def markdown(diagnosis: Diagnosis, figures: Sequence[str] = ()) -> str:
    """The diagnosis as a page that shows figures of the same folder."""
    comparison = diagnosis.comparison
    return (
        templates()
        .get_template("diagnosis.md.jinja")
        .render(
            diagnosis=diagnosis,
            measured=diagnosis.measurements,
            title=title(diagnosis),
            headline=headline(diagnosis),
            verdicts=_rows(diagnosis),
            comparison_title=comparison and words("comparison", comparison),
            policies={POLICY: "**this policy**", **LABELS},
            safety_references=SAFETY_REFERENCES,
            figures=figures,
        )
    )


def _rows(diagnosis: Diagnosis) -> dict[str, list[tuple[str, str, str]]]:
    """The question, answer and sentence of each verdict, by heading."""
    rows = {
        heading: answers((each for each in diagnosis.verdicts if each.kind == kind), sentence)
        for kind, heading in _HEADINGS.items()
    }
    return {heading: each for heading, each in rows.items() if each}
