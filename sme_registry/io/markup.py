"""HTML for notebooks, charts as SVG, text for LaTeX, and Jinja2 templates; all text is escaped.

Cards have no scripts; their colours and fonts are those of the page, light or dark.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from rich.console import Console
from rich.text import Text

from sme_registry.io.tables import Table

# Notebooks have rules of their own for tables.
_STYLE = (
    "<style>.sme-card :is(caption,td,th){text-align:left!important;white-space:pre-wrap!important}"
    ".sme-card .number{text-align:right!important}.sme-card small{overflow-wrap:anywhere}</style>"
)
_MOST_ROWS = 60  # of a table: a card stays below 20 kB
_CONSOLE = Console(file=io.StringIO())


def card(*parts: str) -> str:
    """What a notebook shows of an object: tables and charts, one below the other."""
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


_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 540.0, 240.0, 44.0, 410.0, 12.0, 194.0
_LINE = 15.0  # between two lines of text
_MAX_LABELS = 8  # below the x axis
_STROKES = {
    "main": 'stroke="#2b87d8" stroke-width="2.5"',
    "other": 'stroke="#d9822b" stroke-width="1.2" stroke-opacity=".8"',
    "reference": 'stroke="currentColor" stroke-width="1.3" stroke-opacity=".55" '
    'stroke-dasharray="5 3"',
}


@dataclass(frozen=True)
class Scale:
    """An axis.

    Attributes:
      low, high: its ends; `low < high`.
      ticks: round numbers from end to end.
    """

    low: float
    high: float
    ticks: tuple[float, ...]

    @classmethod
    def covering(cls, *values: float) -> Scale:
        """The scale of about four round steps that covers the values."""
        low, high = min(values, default=0.0), max(values, default=1.0)
        high = high if high - low > 1e-9 else low + 1.0
        raw = (high - low) / 4
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(factor * power for factor in _STEPS if factor * power >= raw * (1 - 1e-9))
        first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
        ticks = tuple(round(index * step, 12) + 0.0 for index in range(first, last + 1))
        return cls(ticks[0], ticks[-1], ticks)

    def part(self, value: float) -> float:
        """The position of a value along the axis, 0 at its low end and 1 at its high end."""
        return (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)


class Line(NamedTuple):
    """A line of a chart.

    Attributes:
      label: at its end, of at most 17 characters; empty for none.
      values: one for each position on the x axis, finite.
      kind: "main" for what the chart is about, "other" for what stands beside it, "reference".
    """

    label: str
    values: Sequence[float]
    kind: Literal["main", "other", "reference"] = "main"


def line_chart(title: str, positions: Sequence[str], lines: Sequence[Line], below: str = "") -> str:
    """A chart of lines over named positions, labelled at their ends."""
    scale = Scale.covering(0.0, 1.0, *(value for line in lines for value in line.values))
    step = (_RIGHT - _LEFT) / len(positions)
    xs = [_LEFT + step * (index + 0.5) for index in range(len(positions))]

    def y(value: float) -> float:
        return _BOTTOM - (_BOTTOM - _TOP) * scale.part(value)

    parts = [
        f'<path d="M{_LEFT:.0f} {y(tick):.1f}H{_RIGHT:.0f}" stroke="currentColor" '
        'stroke-opacity=".18"/>'
        + _svg_text(_LEFT - 6, y(tick) + 4, f"{tick:g}".replace("-", "−"), "end")
        for tick in scale.ticks
    ]
    every = 1 + (len(positions) - 1) // _MAX_LABELS
    parts += [
        _svg_text(x, _BOTTOM + _LINE + 3, name, "middle")
        for x, name in list(zip(xs, positions, strict=True))[::every]
    ]
    parts.append(_svg_text((_LEFT + _RIGHT) / 2, _HEIGHT - 8, below, "middle") if below else "")
    for line in lines:
        points = [(x, y(value)) for x, value in zip(xs, line.values, strict=True)]
        path = " ".join(f"{x:.1f},{height:.1f}" for x, height in points)
        parts.append(f'<polyline points="{path}" fill="none" {_STROKES[line.kind]}/>')
        if line.kind == "main":
            dots = (f'<circle cx="{x:.1f}" cy="{height:.1f}" r="3.5"/>' for x, height in points)
            parts.append(f'<g fill="#2b87d8">{"".join(dots)}</g>')
    labelled = [line for line in lines if line.label]
    heights = _apart([y(line.values[-1]) for line in labelled])
    for line, height in zip(labelled, heights, strict=True):
        end = y(line.values[-1])
        parts.append(
            f'<path d="M{xs[-1] + 5:.1f} {end:.1f}L{_RIGHT + 4:.1f} {height:.1f}" fill="none" '
            f"{_STROKES['reference']}/>"
            + _svg_text(_RIGHT + 8, height + 4, line.label, "start", bold=line.kind == "main")
        )
    values = "; ".join(
        f"{line.label}: {', '.join(f'{value:.2f}' for value in line.values)}" for line in labelled
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" width="{_WIDTH:.0f}" role="img" '
        f'style="max-width:100%;height:auto" font-family="system-ui,sans-serif" font-size="13" '
        f'aria-label="{escape(f"{title}. {values}")}">{"".join(parts)}</svg>'
    )


def _apart(heights: Sequence[float]) -> list[float]:
    """Heights of labels near the given ones, at least a line of text apart."""
    order = sorted(range(len(heights)), key=lambda i: heights[i])
    placed = list(heights)
    for above, i in pairwise(order):
        placed[i] = max(placed[i], placed[above] + _LINE)
    overflow = max((placed[i] for i in order), default=0.0) - _BOTTOM
    limit = _BOTTOM
    for i in reversed(order if overflow > 0 else []):
        placed[i] = min(placed[i], limit)
        limit = placed[i] - _LINE
    return placed


def _svg_text(x: float, y: float, text: str, anchor: str, *, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="currentColor"{weight}>'
        f"{escape(text)}</text>"
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
    templates = Environment(
        loader=FileSystemLoader(folder),
        autoescape=autoescape,
        undefined=StrictUndefined,
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
