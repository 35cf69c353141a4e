"""HTML for notebooks: the same tables as in the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from rich.text import Text

from sme_registry.terminal.tables import Table


def table_html(table: Table) -> str:
    """A table of the terminal as HTML: title, headings, rows and caption, without their styles."""
    heads = [_text(column.heading) for column in table.columns]
    body = [[_text(cell) for cell in row.cells] for row in table.rows if row is not None]
    numbers = [column.kind == "number" for column in table.columns]
    lines = [f"<caption>{_text(table.title)}</caption>"] if table.title else []
    lines.append(_row("th", heads, numbers))
    lines.extend(_row("td", cells, numbers) for cells in body)
    caption = f"<small>{_text(table.caption)}</small>" if table.caption else ""
    return f"<table>{''.join(lines)}</table>{caption}"


def pairs_html(title: str, pairs: Mapping[str, Any]) -> str:
    """Names and values, one per row, under a title."""
    rows = "".join(
        f"<tr><th style='text-align: left'>{escape(name)}</th>"
        f"<td style='text-align: left'>{escape(str(value))}</td></tr>"
        for name, value in pairs.items()
    )
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"


def _row(tag: str, cells: list[str], numbers: list[bool]) -> str:
    aligned = (
        f"<{tag} style='text-align: {'right' if number else 'left'}'>{cell}</{tag}>"
        for cell, number in zip(cells, numbers, strict=True)
    )
    return f"<tr>{''.join(aligned)}</tr>"


def _text(cell: Text | str) -> str:
    """A cell, heading or title without markup; spaces at its start and line breaks are kept."""
    text = cell if isinstance(cell, Text) else Text.from_markup(cell)
    html = escape(text.plain)
    indent = len(html) - len(html.lstrip(" "))
    return "&nbsp;" * indent + html.lstrip(" ").replace("\n", "<br>")
