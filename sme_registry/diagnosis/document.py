"""`Diagnosis`: what was measured of a run, the verdicts that follow, and the parts that show them.

Of actions a, clipped to [0, 1], and the optimal actions a*:

    regret = 1 − r                       of one step, in [0, 1]
    mae = mean |a − a*|                  over action channels it is 1 − r̃
    normalised_regret = mean |a − a*| / mean |½ − a*|     0 for the optimum, 1 for the constant ½
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

from pydantic import BeforeValidator, Field, JsonValue
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.markup import escape
from rich.text import Text

from sme_registry.diagnosis.questions import OPEN_REASONS, Verdict, label, templates, words
from sme_registry.diagnosis.subject import AnySubject
from sme_registry.errors import UnknownNameError, did_you_mean
from sme_registry.io import read_json, versions
from sme_registry.io.markup import Table, fixed, percent, plural
from sme_registry.spec import SMESpec, StreamSpec, catalogue
from sme_registry.spec.document import Integer, Real, StrictModel, TupleOf, check_digest

Level = Literal["solved", "better_than_linear", "worse_than_linear", "no_better_than_constant"]

_ANSWERS = ("question", "answer", "evidence")  # columns of a part in words
_HEADINGS = {
    "who": "Who is not to blame",
    "where": "Where the error is",
    "why": "Why",
    "limits": "Limits",
}
_STYLES = {"yes": "bold red", "no": "green", "cannot tell": "yellow"}
_COLUMNS, _INDENT = 80, " " * 4  # of lines in a file or a pipe


class Part(NamedTuple):
    """A table under a heading: answers in words, or numbers."""

    heading: str
    columns: tuple[str, ...] = _ANSWERS
    rows: Sequence[tuple[str, ...]] = ()
    notes: tuple[str, ...] = ()  # below it
    detail: bool = False  # shown on request only

    def terminal(self) -> Iterator[RenderableType]:
        """Its lines, table and notes on a terminal or in a pipe."""
        if self.columns == _ANSWERS:
            yield _Lines((self.heading, "italic", ""))
            for question, answer, evidence in self.rows:
                style = _STYLES[answer.partition(",")[0]]
                yield _Lines((f"{question}: {answer}", style, ""), (evidence, "", _INDENT))
        else:
            kinds = ["name", *["number"] * (len(self.columns) - 1)]
            rows = [[escape(cell) for cell in row] for row in self.rows]
            yield Table(self.heading, dict(zip(self.columns, kinds, strict=True)), rows)
        for note in self.notes:
            yield _Lines((note, "dim italic", ""))


def table(
    heading: str, name: str, rows: Mapping[str, Any], fields: str, *notes: str, detail: bool = False
) -> Part:
    """A part with one row for each of `rows`, by its name, and a column for each of its fields."""
    names = fields.split()
    columns = [label(field).replace("normalised regret", "N") for field in names]
    cells = [
        (row_name, *(cell(getattr(row, field)) for field in names))
        for row_name, row in rows.items()
    ]
    return Part(heading, (name, *columns), cells, notes, detail)


def cell(value: float | str | None, digits: int = 3) -> str:
    """A number or a name in a table."""
    if value is None:
        return "–"
    return fixed(value, digits) if isinstance(value, float) else label(str(value))


class Diagnosis(StrictModel):
    """What is known about the regret of a run; of a task, a team or a stream, with more fields.

    Attributes:
      name: of the run or policy.
      task: what the file of the task or stream calls it.
      plan: algorithm, seed, steps and so on; empty without a run.
      checkpoint_step: of an unfinished run, the steps at its checkpoint.
      seeds: of training, on which the verdicts rest.
      updates: of the algorithm, likewise; null if unknown.
      verdicts: one for each question, in order.
      thresholds: all that verdicts use.
      versions: of Python and of the packages that the numbers depend on.
    """

    headline_macro: ClassVar[str] = ""
    document_field: ClassVar[str] = "spec"
    only_field: ClassVar[str] = ""  # that no other kind of diagnosis has

    schema_version: Annotated[
        Literal[2],
        BeforeValidator(lambda version: 2 if version == 1 else version),
        Field(description="Version of the document's format; 1 is read as well."),
    ] = 2
    name: str
    task: str = ""
    plan: dict[str, JsonValue]
    checkpoint_step: Integer | None = None
    seeds: Integer = 1
    updates: Integer | None = None
    verdicts: TupleOf[Verdict]
    thresholds: dict[str, Real]
    versions: dict[str, str]

    @classmethod
    def about(cls, subject: AnySubject, verdicts: Sequence[Verdict], **fields: Any) -> Self:
        """The diagnosis of a subject, with the fields of its kind."""
        thresholds = {k: v for verdict in verdicts for k, v in verdict.thresholds.items()}
        document: dict[str, Any] = {
            cls.document_field: subject.document,
            f"{cls.document_field}_digest": subject.document.digest,
        }
        return cls(
            name=subject.name,
            task=subject.task,
            plan=subject.plan,
            checkpoint_step=subject.checkpoint_step,
            updates=subject.updates,
            verdicts=tuple(verdicts),
            thresholds=thresholds,
            versions=versions(("numpy", "scipy"), if_imported=("torch", "stable_baselines3")),
            **document,
            **fields,
        )

    @property
    def subject(self) -> tuple[SMESpec | StreamSpec, str]:
        """The task or stream, and the digest that the file states."""
        field = self.document_field
        return getattr(self, field), getattr(self, f"{field}_digest")

    @property
    def title(self) -> str:
        """The run or policy, and its task or stream with the main fields."""
        document, _ = self.subject
        if isinstance(document, StreamSpec):
            phases = plural(len(document.phases), "phase")
            visits = plural(document.visits, "visit")
            fields = f"S={document.state_dim}, A={document.action_dim}, {phases}, {visits}"
        else:
            fields = _main_fields(document)
        return f"{self.name} on {catalogue.title(document.named(self.task))} ({fields})"

    @property
    def origin(self) -> str:
        """What it is about, and the versions that its numbers depend on."""
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        kind = "Stream" if self.document_field == "stream" else "Task"
        return f"{kind} `{self.subject[1]}`. Versions: {versions}."

    def verdict(self, question: str) -> Verdict:
        """The verdict on a question, such as "credit assignment" or "credit_assignment"."""
        by_name = {verdict.question: verdict for verdict in self.verdicts}
        name = "_".join(question.replace("_", " ").casefold().split())
        if name in by_name:
            return by_name[name]
        known = [label(other) for other in by_name]
        wanted = label(name)
        partial = [other for other in known if wanted and wanted in other]
        hint = did_you_mean(partial[0] if partial else wanted, known)
        raise UnknownNameError(f"question={question!r}: must be one of {', '.join(known)}.{hint}")

    def headline(self) -> str:
        """How good the policy is."""
        checkpoint = ""
        if self.checkpoint_step is not None:
            step = f"{self.checkpoint_step:,}"
            checkpoint = f"The run is unfinished: this is its checkpoint at step {step}. "
        return checkpoint + words(self.headline_macro, self)

    def parts(self) -> Iterator[Part]:
        """Findings first, then the tables of its kind; on request the other answers."""
        yield self.findings("Findings", self.verdicts)
        yield from self.tables()
        yield from self.answers(self.verdicts)

    def tables(self) -> Iterator[Part]:
        """What only its kind of diagnosis shows, directly after the findings."""
        return iter(())

    def findings(self, heading: str, verdicts: Sequence[Verdict]) -> Part:
        """The "yes" verdicts, largest share of the error first; names of the others below."""
        findings = [verdict for verdict in verdicts if verdict.answer == "yes"]
        findings.sort(key=lambda v: -1.0 if v.error_share is None else v.error_share, reverse=True)
        notes = [] if findings else ["Nothing."]
        doubts = (verdict for verdict in verdicts if verdict.reason in OPEN_REASONS)
        notes += {verdict.reason: verdict.doubt for verdict in doubts}.values()
        for answer, text in (("cannot tell", "Cannot tell"), ("no", "Ruled out")):
            names = [label(verdict.question) for verdict in verdicts if verdict.answer == answer]
            if names:
                notes.append(f"{text}: {', '.join(names)}.")
        updates = "" if self.updates is None else f", {plural(self.updates, 'update')}"
        basis = f"{plural(self.seeds, 'seed')}{updates}; %: share of the error"
        return Part(f"{heading} ({basis})", rows=_rows(findings), notes=tuple(notes))

    def answers(self, verdicts: Sequence[Verdict], of: str = "") -> Iterator[Part]:
        """The verdicts that are no findings, with their evidence, by kind."""
        for kind, heading in _HEADINGS.items():
            others = [v for v in verdicts if v.kind == kind and v.answer != "yes"]
            if others:
                yield Part(f"{heading}{of}", rows=_rows(others), detail=True)

    def terminal(self, *, details: bool = False) -> Iterator[RenderableType]:
        """What `sme diagnose` prints, part by part."""
        yield f"[bold]{escape(self.title)}[/]"
        yield _Lines((self.headline(), "", ""))
        for part in self.parts():
            if details or not part.detail:
                yield ""
                yield from part.terminal()

    def markdown(self, figures: Sequence[str] = (), *, details: bool = False) -> str:
        """The diagnosis as a page that shows figures of the same folder."""
        parts = [part for part in self.parts() if details or not part.detail]
        page = templates().get_template("page.md.jinja")
        return page.render(diagnosis=self, parts=parts, figures=figures)

    def _repr_markdown_(self) -> str:
        """The page, for notebooks, which would run HTML, links and images in a name."""
        return self.markdown().replace("<", "&lt;").replace("](", "]\\(")

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """The diagnosis in plain data, of the kind that its fields say."""
        for kind in cls.__subclasses__() if isinstance(data, dict) else ():
            if kind.only_field in data:
                return kind.from_dict(data, source)
        return super().from_dict(data, source)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a diagnosis.json."""
        diagnosis = cls.from_dict(read_json(path), str(path))
        document, digest = diagnosis.subject
        where = f"{path}: {diagnosis.document_field}_digest"
        check_digest(digest, document, where, "Diagnose the run again.")
        return diagnosis


def _rows(verdicts: Iterable[Verdict]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for verdict in verdicts:
        share = "" if verdict.error_share is None else f", {percent(verdict.error_share)}"
        answer = f"{verdict.answer}{share}"
        rows.append((label(verdict.question), answer, verdict.sentence()))
    return rows


def _main_fields(spec: SMESpec) -> str:
    fields = [f"S={spec.state_dim}", f"A={spec.action_dim}", f"L={spec.complexity}", f"k={spec.k}"]
    fields += [f"r_min={spec.r_min:g}", f"D={spec.D:g}"]
    if spec.safety is not None:
        fields.append(f"τ={spec.safety.tightness:g}")
    if spec.observation is not None:
        if spec.distractors:
            fields.append(f"m={spec.distractors} {spec.observation.dynamics}")
        if spec.observation.mixing != "none":
            fields.append(f"mixing={spec.observation.mixing}")
    return ", ".join(fields)


class _Lines:
    """Plain text, styled and indented, wrapped between words; only a terminal breaks long ones."""

    def __init__(self, *paragraphs: tuple[str, str, str]) -> None:
        self.paragraphs = paragraphs

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for text, style, indent in self.paragraphs:
            lines = textwrap.wrap(
                text,
                options.max_width if console.is_terminal else _COLUMNS,
                initial_indent=indent,
                subsequent_indent=indent,
                break_long_words=console.is_terminal,
                break_on_hyphens=False,
            )
            yield Text("\n".join(lines), style=style)
