"""Tables that stay readable at any width.

No cell is cut, no word broken, no column dropped. In a narrow terminal a table first loses its
lines, then wraps columns of text between words; where that is not enough, each row becomes a block.
Output that is no terminal has one line per row, however long, for `grep` and `awk`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.padding import Padding
from rich.segment import Segment
from rich.table import Table as RichTable
from rich.text import Text

from sme_registry.io.checks import printable

_LEAST_TEXT, _MOST_LINES = 16, 4  # of a cell of text in a table
_STYLES = ((box.HEAVY_HEAD, 1), (None, 2), (None, 1))
"""From wide to narrow: lines, and spaces after each column (with lines, also before it)."""


class CleanConsole(Console):
    """Prints no control characters of a text, such as escape sequences in a name from elsewhere."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            if segment.control or segment.text.replace("\n", "").isprintable():
                yield segment
            else:
                lines = (printable(line, longest=None) for line in segment.text.split("\n"))
                yield segment._replace(text="\n".join(lines))


class Column(NamedTuple):
    """A column, and how it is set: as a name, a number or a text."""

    heading: str
    kind: str


class Row(NamedTuple):
    """A row's cells, and Rich's style of all of them."""

    cells: tuple[Text, ...]
    style: str


class Table:
    """A table that fits its console."""

    def __init__(
        self,
        title: str,
        columns: Mapping[str, str],
        rows: Iterable[Sequence[str]] = (),
        *,
        caption: str = "",
    ) -> None:
        self.title, self.caption = title, caption
        self.columns = [Column(heading, kind) for heading, kind in columns.items()]
        self.rows: list[Row | None] = []
        """None separates sections."""
        for row in rows:
            self.add_row(*row)

    def add_row(self, *cells: str, style: str | None = None) -> None:
        """Add a row; missing cells are empty."""
        missing = ("",) * (len(self.columns) - len(cells))
        texts = tuple(Text.from_markup(cell, emoji=False) for cell in (*cells, *missing))
        self.rows.append(Row(texts, style or ""))

    def add_section(self) -> None:
        """Separate the rows so far from the next ones."""
        self.rows.append(None)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if self.title:
            yield Text.from_markup(self.title, style="italic", emoji=False)
        if console.is_terminal:
            yield from self._fitted(options.max_width)
        else:
            yield Text("\n".join(self._lines()), no_wrap=True, overflow="ignore")
        if self.caption:
            yield Text.from_markup(self.caption, style="dim italic", emoji=False)

    def _fitted(self, width: int) -> RenderResult:
        """The widest style in which nothing wraps, else in which texts wrap, else blocks."""
        least, most = zip(*map(self._limits, range(len(self.columns))), strict=True)
        for needed, (lines, gap) in itertools.product((most, least), _STYLES):
            borders = (2 * gap + 1) * len(most) + 1 if lines else gap * (len(most) - 1)
            if sum(needed) + borders <= width:
                yield self._drawn(lines, gap, _shared(least, most, width - borders))
                return
        yield from self._blocks()

    def _limits(self, i: int) -> tuple[int, int]:
        """The least width of a column in which its cells are readable, and its full width."""
        heading, kind = self.columns[i]
        cells = [row.cells[i].plain for row in self.rows if row is not None]
        most = max(map(_width, cells), default=0)
        least = most
        if kind == "text":
            least = min(most, max(_longest_word(cells), _LEAST_TEXT, -(-most // _MOST_LINES)))
        return max(least, _longest_word([heading])), max(most, _width(heading))

    def _drawn(self, lines: box.Box | None, gap: int, widths: Sequence[int]) -> RichTable:
        padding = (0, gap, 0, gap if lines else 0)
        table = RichTable(box=lines, padding=padding, pad_edge=lines is not None)
        for (heading, kind), width in zip(self.columns, widths, strict=True):
            table.add_column(heading, justify="right" if kind == "number" else "left", width=width)
        for row in self.rows:
            if row is not None:
                table.add_row(*row.cells, style=row.style)
            elif lines:
                table.add_section()
            else:
                table.add_row()
        return table

    def _blocks(self) -> RenderResult:
        """Each row as a block: its name, its numbers, its texts."""
        kinds = [kind for _, kind in self.columns]
        named = 1 + next((i for i, kind in enumerate(kinds) if kind != "number"), 0)
        for row in filter(None, self.rows):
            yield Text(" ", style=f"bold {row.style}").join(filter(None, row.cells[:named]))
            rest = list(zip(self.columns, row.cells, strict=True))[named:]
            given = [(heading, kind, text) for (heading, kind), text in rest if text]
            numbers = [_pair(heading, text) for heading, kind, text in given if kind == "number"]
            texts = [_pair(heading, text) for heading, kind, text in given if kind != "number"]
            for line in ([Text(" · ").join(numbers)] if numbers else []) + texts:
                yield Padding(line, (0, 0, 0, 2))

    def _lines(self) -> Iterator[str]:
        """The lines of the table as plain text of full width."""
        widths = [self._limits(i)[1] for i in range(len(self.columns))]
        header = tuple(Text(heading) for heading, _ in self.columns)
        for row in (Row(header, ""), *self.rows):
            if row is None:
                yield ""
                continue
            parts = [cell.plain.split("\n") for cell in row.cells]
            for line in itertools.zip_longest(*parts, fillvalue=""):
                cells = zip(line, widths, self.columns, strict=True)
                padded = (_padded(text, width, column.kind) for text, width, column in cells)
                yield "  ".join(padded).rstrip()


def _shared(least: Sequence[int], most: Sequence[int], width: int) -> list[int]:
    """Widths of columns between two bounds: the rest goes where most is missing."""
    widths = list(least)
    for _ in range(min(width, sum(most)) - sum(least)):
        neediest = max(range(len(most)), key=lambda i: most[i] - widths[i])
        widths[neediest] += 1
    return widths


def _width(text: str) -> int:
    return max(map(cell_len, text.split("\n")))


def _longest_word(texts: Iterable[str]) -> int:
    return max((cell_len(word) for text in texts for word in text.split()), default=0)


def _padded(text: str, width: int, kind: str) -> str:
    space = " " * (width - cell_len(text))
    return space + text if kind == "number" else text + space


def _pair(heading: str, text: Text) -> Text:
    name = Text(f"{' '.join(heading.split())} ", style="dim")
    return Text.assemble(name, Text(", ").join(text.split("\n")))
