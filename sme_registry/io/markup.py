"""Tables for terminals and notebooks, text for LaTeX, and Jinja2 templates; all text is escaped.

No cell of a table is cut and no column dropped. In a narrow terminal Rich wraps columns of text,
then a table loses its lines, and at last each row becomes a block. Output that is no terminal has
one line per row, for `grep` and `awk`. Cards for notebooks have no scripts.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich import box, markup
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

if TYPE_CHECKING:
    from jinja2 import Environment


class TableColumn(NamedTuple):
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
        rows: Iterable[Iterable[str]] = (),
        *,
        caption: str = "",
    ) -> None:
        self.title, self.caption = title, caption
        self.columns = [TableColumn(heading, kind) for heading, kind in columns.items()]
        self.rows: list[Row | None] = []
        """None separates sections."""
        for row in rows:
            self.add_row(*row)

    @classmethod
    def of(cls, title: str, records: Sequence[Mapping[str, object]], *, caption: str = "") -> Table:
        """A table with a row for each record; their keys are the headings, the first is a name."""
        rows = [tuple(map(_cell, record.values())) for record in records]
        columns: dict[str, str] = {}
        for heading, cells in zip(next(iter(records), {}), zip(*rows, strict=True), strict=True):
            text = "text" if columns else "name"
            columns[heading] = "number" if all(map(_starts_as_number, cells)) else text
        return cls(title, columns, [map(markup.escape, row) for row in rows], caption=caption)

    def add_row(self, *cells: str, style: str | None = None) -> None:
        """Add a row; missing cells are empty."""
        missing = ("",) * (len(self.columns) - len(cells))
        texts = tuple(Text.from_markup(cell, emoji=False) for cell in (*cells, *missing))
        self.rows.append(Row(texts, style or ""))

    def add_section(self) -> None:
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
        """The table with lines or without, where no word is broken; else blocks."""
        least, n = sum(map(self._least_width, range(len(self.columns)))), len(self.columns)
        if least + 3 * n + 1 <= width:
            yield self._drawn(box.HEAVY_HEAD)
        elif least + n <= width:
            yield self._drawn(None)
        else:
            yield from self._blocks()

    def _cells(self, i: int) -> list[str]:
        return [row.cells[i].plain for row in self.rows if row is not None]

    def _least_width(self, i: int) -> int:
        """The width of a column in which no word of its texts is broken, and no name or number."""
        heading, kind = self.columns[i]
        texts = [heading, *self._cells(i)]
        if kind == "text":
            texts = [word for text in texts for word in text.split()]
        return max(map(_width, texts), default=0)

    def _drawn(self, lines: box.Box | None) -> RichTable:
        padding = (0, 1) if lines else (0, 1, 0, 0)
        table = RichTable(box=lines, padding=padding, pad_edge=bool(lines))
        for i, (heading, kind) in enumerate(self.columns):
            table.add_column(
                heading,
                justify="right" if kind == "number" else "left",
                no_wrap=kind != "text",
                min_width=self._least_width(i),
            )
        for row in self.rows:
            if row is not None:
                table.add_row(*row.cells, style=row.style)
            elif lines:
                table.add_section()
            else:
                table.add_row()
        return table

    def _blocks(self) -> RenderResult:
        """Each row as a block: its name, and a line for each other cell."""
        for row in filter(None, self.rows):
            yield Text.assemble(row.cells[0], style=f"bold {row.style}")
            for (heading, _), text in zip(self.columns[1:], row.cells[1:], strict=True):
                if text:
                    name = Text(f"{' '.join(heading.split())} ", style="dim")
                    line = Text.assemble(name, Text(", ").join(text.split("\n")))
                    yield Padding(line, (0, 0, 0, 2))

    def _lines(self) -> Iterator[str]:
        """The lines of the table as plain text of full width."""
        widths = [
            max(map(_width, [heading, *self._cells(i)]))
            for i, (heading, _) in enumerate(self.columns)
        ]
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


def _cell(value: object) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _starts_as_number(cell: str) -> bool:
    return not cell or cell.lstrip("+-−")[:1].isdecimal()


def _width(text: str) -> int:
    return max(map(cell_len, text.split("\n")))


def _padded(text: str, width: int, kind: str) -> str:
    space = " " * (width - cell_len(text))
    return space + text if kind == "number" else text + space


# Notebooks have rules of their own for tables.
_STYLE = (
    "<style>.sme-card :is(caption,td,th){text-align:left!important;white-space:pre-wrap!important}"
    ".sme-card .number{text-align:right!important}.sme-card small{overflow-wrap:anywhere}</style>"
)
_MOST_ROWS = 60  # of a table: a card stays below 20 kB
_CONSOLE = Console(file=io.StringIO())


def card(*parts: str) -> str:
    """What a notebook shows of an object: tables, one below the other."""
    return f'{_STYLE}<div class="sme-card">{"".join(parts)}</div>'


def folded(summary: str, *parts: str) -> str:
    """Parts of a card that open on a click."""
    return f"<details><summary>{escape(summary)}</summary>{''.join(parts)}</details>"


def table_html(table: Table) -> str:
    """A table of the terminal; of Rich's styles it keeps bold text."""
    kinds = [column.kind for column in table.columns]
    heading = "".join(f"<th>{escape(column.heading)}</th>" for column in table.columns)
    rows = [row for row in table.rows if row is not None]
    lines = [heading]
    for row in rows[:_MOST_ROWS]:
        bold = "bold" in row.style
        cells = zip(kinds, row.cells, strict=True)
        lines.append("".join(f"<td class={kind}>{_html(cell, bold)}</td>" for kind, cell in cells))
    if len(rows) > _MOST_ROWS:
        lines.append(f"<td>… {len(rows) - _MOST_ROWS:,} more</td>")
    title, caption = (
        _html(Text.from_markup(text, emoji=False)) for text in (table.title, table.caption)
    )
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><caption>{title}</caption>{body}</table><small>{caption}</small>"


def pairs_html(title: str, pairs: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>"
        for name, value in pairs.items()
    )
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"


def _html(text: Text, bold: bool = False) -> str:
    return "".join(
        f"<b>{escape(part.text)}</b>"
        if bold or (part.style is not None and part.style.bold)
        else escape(part.text)
        for part in text.render(_CONSOLE)
    )


_COMMANDS = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#",
    "_": r"\_", "%": r"\%", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}",
    "−": "$-$", "–": "--", "½": r"$\frac12$", "ε": r"$\varepsilon$", "†": r"$^\dagger$",
    "τ": r"$\tau$", "ν": r"$\nu$", "≥": r"$\geq$", "±": r"$\pm$", "’": "'", "*": "$^*$",
}  # fmt: skip


def escape_latex(text: str) -> str:
    """Text as LaTeX that prints it literally; the symbols of our labels become mathematics."""
    escaped = "".join(_COMMANDS.get(letter, letter) for letter in text.replace("r̃", "\0"))
    return escaped.replace("\0", r"$\tilde r$")


def environment(*folders: Path, autoescape: bool) -> Environment:
    """The templates of folders, with the filters of this module."""
    import jinja2  # on first use: cards need none

    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        autoescape=autoescape,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (fixed, signed, percent, thousands, conjunction, plural)
    templates.filters |= {function.__name__: function for function in filters}
    return templates


def fixed(value: float, digits: int = 2) -> str:
    """`0.44`, `−0.02`, and no negative zero."""
    return f"{value:z.{digits}f}".replace("-", "−")


def signed(value: float, digits: int = 2) -> str:
    """`+0.44`, `−0.02`, `0.00`."""
    text = fixed(value, digits)
    return text if text.startswith("−") or float(text) == 0.0 else f"+{text}"


def percent(value: float, digits: int = 0) -> str:
    """`44%`."""
    return f"{value:.{digits}%}"


def thousands(value: float) -> str:
    """`20,000`; a number with decimals keeps those that it needs."""
    return f"{value:,}" if isinstance(value, int) else f"{value:,g}"


def conjunction(names: Sequence[str]) -> str:
    """`PPO, TD3 and SAC`."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def plural(count: int, one: str, many: str = "") -> str:
    """`1 pair`, `3 pairs`, `2 classes`."""
    return f"{count:,} {one if count == 1 else many or f'{one}s'}"
