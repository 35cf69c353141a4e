"""HTML for notebooks, text for LaTeX, and Jinja2 templates; all text is escaped.

Cards have no scripts; their colours and fonts are those of the page, light or dark.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from sme_registry.io.tables import Table

if TYPE_CHECKING:
    from jinja2 import Environment

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
    """Names and values, one per row, under a title."""
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


def environment(folder: Path, *, autoescape: bool) -> Environment:
    """The templates of a folder, with the filters of this module."""
    import jinja2  # on first use: cards need none

    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
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
