"""How a diagnosis is shown: its parts in a terminal and as Markdown, with words of `templates/`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.markup import escape

from sme_registry.io.markup import environment
from sme_registry.io.tables import Answers, Paragraph, Table

if TYPE_CHECKING:
    from jinja2 import Environment
    from rich.console import RenderableType

__all__ = ["ANSWERS", "Part", "View", "label", "markdown", "terminal", "words"]

ANSWERS = ("question", "answer", "evidence")  # columns of a part in words


class Part(NamedTuple):
    """A table under a heading: answers in words, with the columns `ANSWERS`, or numbers."""

    heading: str
    columns: tuple[str, ...] = ANSWERS
    rows: Sequence[tuple[str, ...]] = ()
    notes: tuple[str, ...] = ()  # below it
    detail: bool = False  # shown on request only


class View(NamedTuple):
    """What is shown of a diagnosis."""

    title: str
    headline: str
    parts: tuple[Part, ...]
    origin: str  # what it is about, and the versions


def label(question: str) -> str:
    """`credit_assignment` as people read it: `credit assignment`."""
    return question.replace("_", " ")


@cache
def _templates() -> Environment:
    templates = environment(Path(__file__).parent / "templates", autoescape=False)
    templates.filters["label"] = label
    return templates


def words(template: str, macro: str, *arguments: Any) -> str:
    """A macro of a template, on one line."""
    macros: Any = _templates().get_template(template).module
    return " ".join(getattr(macros, macro)(*arguments).split())


def terminal(view: View, *, details: bool = False) -> Iterator[RenderableType]:
    """What `sme diagnose` prints, part by part."""
    yield f"[bold]{escape(view.title)}[/]"
    yield Paragraph(view.headline)
    for part in _chosen(view.parts, details):
        yield ""
        if part.columns == ANSWERS:
            styles = {row[1]: _STYLES[row[1].partition(",")[0]] for row in part.rows}
            yield Answers(
                part.heading, [(q, a, text) for q, a, text in part.rows], styles or _STYLES
            )
        else:
            kinds = ["name", *["number"] * (len(part.columns) - 1)]
            rows = [[escape(cell) for cell in row] for row in part.rows]
            yield Table(part.heading, dict(zip(part.columns, kinds, strict=True)), rows)
        for note in part.notes:
            yield Paragraph(note, style="dim italic")


_STYLES = {"yes": "bold red", "no": "green", "cannot tell": "yellow"}


def markdown(view: View, figures: Sequence[str] = (), *, details: bool = False) -> str:
    """The diagnosis as a page that shows figures of the same folder."""
    parts = _chosen(view.parts, details)
    page = _templates().get_template("page.md.jinja")
    return page.render(view=view, parts=parts, figures=figures)


def _chosen(parts: Iterable[Part], details: bool) -> list[Part]:
    return [part for part in parts if details or not part.detail]
