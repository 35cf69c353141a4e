"""HTML for notebooks: the same tables as in the terminal, without scripts.

Colours and fonts are those of the page, light or dark; the style sheet of a card, which notebooks
may drop, sets only alignment and spacing. All text is escaped.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from rich.text import Text

from sme_registry.terminal.tables import Row, Table

# Notebooks have rules for tables, such as `.jp-RenderedHTMLCommon td`: these are more specific.
_STYLE = (
    "<style>"
    ".sme-card.sme-card{overflow-x:auto;font-variant-numeric:tabular-nums}"
    ".sme-card table.sme-table{border-collapse:collapse;margin:.5em 0;color:inherit;width:auto}"
    ".sme-card table.sme-table caption{caption-side:top;text-align:left;padding:.2em .6em;"
    "color:inherit;font-size:1em;font-weight:normal;font-style:normal}"
    ".sme-card table.sme-table tr>*{padding:.15em .6em;text-align:left;vertical-align:top;"
    "white-space:normal;max-width:30em}"
    ".sme-card table.sme-table tr>.text:last-child{min-width:12em}"
    ".sme-card table.sme-table tr>.num{text-align:right;white-space:nowrap}"
    ".sme-card table.sme-table tr>.name{white-space:nowrap}"
    ".sme-card table.sme-table tr.bold>*{font-weight:bold}"
    ".sme-card table.sme-table tbody+tbody{border-top:1px solid rgba(128,128,128,.5)}"
    ".sme-card small,.sme-card summary{overflow-wrap:anywhere}"
    "</style>"
)
_MOST_ROWS = 60  # of a table: a card stays below 20 kB
_CLASSES = {"number": "num", "name": "name", "text": "text"}


def card(*parts: str) -> str:
    """What a notebook shows of an object: tables and charts, one below the other.

    Args:
      *parts: HTML of this module or of `svg`.
    """
    return f'{_STYLE}<div class="sme-card">{"".join(parts)}</div>'


def folded(summary: str, *parts: str) -> str:
    """Parts of a card that open on a click."""
    return f"<details><summary>{escape(summary)}</summary>{''.join(parts)}</details>"


def table_html(table: Table) -> str:
    """A table of the terminal as HTML: title, headings, rows, sections and caption.

    Of Rich's styles it keeps bold rows. A long table ends with the number of rows left out.
    """
    kinds = [column.kind for column in table.columns]
    sections = [[_row("th", [column.heading for column in table.columns], kinds)]]
    for row in table.rows[:_MOST_ROWS]:
        if row is None:
            sections.append([])
        else:
            sections[-1].append(_row("td", row.cells, kinds, row))
    if more := sum(row is not None for row in table.rows[_MOST_ROWS:]):
        rest = f"<tr><td colspan={len(kinds)}>… {more:,} more</td></tr>"
        sections.append([rest])
    bodies = "".join(f"<tbody>{''.join(rows)}</tbody>" for rows in sections if rows)
    title = _caption(_text(table.title)) if table.title else ""
    caption = f"<small>{_text(table.caption)}</small>" if table.caption else ""
    return f'<table class="sme-table">{title}{bodies}</table>{caption}'


def pairs_html(title: str, pairs: Mapping[str, Any]) -> str:
    """Names and values, one per row, under a title."""
    rows = "".join(
        f'<tr><th class="name">{escape(name)}</th><td>{escape(str(value))}</td></tr>'
        for name, value in pairs.items()
    )
    return f'<table class="sme-table">{_caption(escape(title))}{rows}</table>'


def _caption(html: str) -> str:
    """The title of a table, its first line in bold."""
    if not html:
        return ""
    first, *rest = html.split("<br>", 1)
    return f"<caption>{'<br>'.join([f'<b>{first}</b>', *rest])}</caption>"


def _row(tag: str, cells: Any, kinds: list[str], row: Row | None = None) -> str:
    styled = (
        f'<{tag} class="{_CLASSES[kind]}">{_text(cell)}</{tag}>'
        for cell, kind in zip(cells, kinds, strict=True)
    )
    bold = row is not None and "bold" in row.style.split()
    return f"<tr{' class=bold' * bold}>{''.join(styled)}</tr>"


def _text(cell: Text | str) -> str:
    """A cell, heading or title: spaces at its start, line breaks and text in bold are kept."""
    text = cell if isinstance(cell, Text) else Text.from_markup(cell, emoji=False)
    lead = len(text.plain) - len(text.plain.lstrip(" "))
    bold = [span for span in text.spans if "bold" in str(span.style).split()]
    parts, at = [], lead
    for span in bold:
        start, end = max(span.start, at), max(span.end, at)
        parts += [escape(text.plain[at:start]), f"<b>{escape(text.plain[start:end])}</b>"]
        at = end
    html = "".join([*parts, escape(text.plain[at:])])
    return "&nbsp;" * lead + html.replace("\n", "<br>")
