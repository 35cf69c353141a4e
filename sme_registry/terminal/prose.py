"""Sentences that stay readable at any width: paragraphs, and answers with their evidence.

In a terminal they fill its width. Output that is no terminal has lines of at most 80 columns: each
answer on a line of its own, for `grep`, and its evidence indented below.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

_COLUMNS = 80  # of lines in a file or a pipe
_INDENT = 4


class Paragraph:
    """Plain text, wrapped between words, in one of Rich's styles."""

    def __init__(self, text: str, style: str = "") -> None:
        self.text, self.style = text, style

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if console.is_terminal:
            yield Text(self.text, style=self.style)
        else:
            yield _wrapped(self.text)


class Answers:
    """Questions, their answers, and sentences of evidence.

    Args:
      title: above them.
      rows: question, answer, evidence; plain text.
      styles: of the answers.
    """

    def __init__(
        self, title: str, rows: Iterable[tuple[str, str, str]], styles: dict[str, str]
    ) -> None:
        self.title, self.rows, self.styles = title, list(rows), styles

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(self.title, style="italic")
        if console.is_terminal:
            yield self._table()
            return
        for question, answer, evidence in self.rows:
            yield Text(f"{question}: {answer}")
            yield _wrapped(evidence, " " * _INDENT)

    def _table(self) -> Table:
        table = Table(show_header=False, box=None)
        table.add_column(style="cyan", no_wrap=True, min_width=19)
        table.add_column(no_wrap=True, min_width=max(map(len, self.styles)))
        table.add_column(overflow="fold")
        for question, answer, evidence in self.rows:
            table.add_row(Text(question), Text(answer, style=self.styles[answer]), Text(evidence))
        return table


def _wrapped(text: str, indent: str = "") -> Text:
    """Lines that break between words only; a word that is too long has a longer line."""
    lines = textwrap.wrap(
        text,
        _COLUMNS,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return Text("\n".join(lines))
