"""Tables for terminals and notebooks, text for LaTeX, and Jinja2 templates; all text is escaped."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box, markup
from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import measure_renderables
from rich.table import Table as RichTable
from rich.text import Text

from sme_registry.io.system import visible

if TYPE_CHECKING:
    from jinja2 import Environment

_UNLIMITED = 100_000  # columns


class Table:
    """A table of which no cell is cut and no column dropped.

    Each column has a heading and a kind, "name", "number" or "text"; only texts are wrapped. A
    narrow terminal shows it without lines, and then as wrapped text. Output that is no terminal has
    one line per row, for `grep` and `awk`.
    """

    def __init__(
        self,
        title: str,
        columns: Mapping[str, str],
        rows: Iterable[Iterable[str]] = (),
        *,
        caption: str = "",
    ) -> None:
        self.title, self.caption, self.grid = title, caption, RichTable()
        for heading, kind in columns.items():
            justify: Any = "right" if kind == "number" else "left"
            self.grid.add_column(Text(heading), justify=justify, no_wrap=kind != "text")
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
        self.grid.add_row(*map(_text, cells), style=style)

    def add_section(self) -> None:
        self.grid.add_section()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if self.title:
            yield _text(self.title, "italic")
        width = options.max_width if console.is_terminal else 0
        options, grid = options.update(width=_UNLIMITED), self.grid
        sizes = [
            (measure_renderables(console, options, [column.header, *column.cells]), column.no_wrap)
            for column in grid.columns
        ]
        least = sum(size.maximum if whole else size.minimum for size, whole in sizes)
        has_lines = least + 3 * len(sizes) + 1 <= width
        grid.box, grid.pad_edge = box.HEAVY_HEAD if has_lines else None, has_lines
        grid.padding = (0, 1) if has_lines else (0, 1, 0, 0) if width else (0, 2, 0, 0)
        if least + len(sizes) <= width:
            yield grid
        else:
            lines = console.render_lines(grid, options, pad=False)
            plain = ("".join(part.text for part in line).rstrip() for line in lines)
            yield Text("\n".join(plain))
        if self.caption:
            yield _text(self.caption, "dim italic")


def _text(markup: str, style: str = "") -> Text:
    # Before it is measured: escapes are longer.
    return Text.from_markup(visible(markup), style=style, emoji=False)


def _cell(value: object) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _starts_as_number(cell: str) -> bool:
    return not cell or cell.lstrip("+-−")[:1].isdecimal()


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
    columns, styles = table.grid.columns, [str(row.style) for row in table.grid.rows]
    classes = ["number" if column.justify == "right" else "text" for column in columns]
    lines = ["".join(f"<th>{_html(column.header)}</th>" for column in columns)]
    rows = zip(styles, *(column.cells for column in columns), strict=True)
    for style, *cells in itertools.islice(rows, _MOST_ROWS):
        bold, row = "bold" in style, zip(classes, cells, strict=True)
        lines.append("".join(f"<td class={kind}>{_html(cell, bold)}</td>" for kind, cell in row))
    if len(styles) > _MOST_ROWS:
        lines.append(f"<td>… {len(styles) - _MOST_ROWS:,} more</td>")
    title, caption = (_html(_text(text)) for text in (table.title, table.caption))
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><caption>{title}</caption>{body}</table><small>{caption}</small>"


def pairs_html(title: str, pairs: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>"
        for name, value in pairs.items()
    )
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"


def _html(text: Any, bold: bool = False) -> str:
    return "".join(
        f"<b>{escape(part.text)}</b>"
        if bold or (part.style is not None and part.style.bold)
        else escape(part.text)
        for part in (text or Text()).render(_CONSOLE)  # a missing cell is ""
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
