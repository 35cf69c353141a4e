r"""`latex_table`: a table of finished text as LaTeX that fits the column of a two-column article.

The names of rows are a column that wraps (`X` of tabularx). The others are across if they fit next
to it; otherwise each row becomes a heading, with one line for each of its columns below it. That
fits for any number of columns. A table that is too long for a page is continued in further floats.

Widths are estimates from those of Computer Modern at 8 pt (`\footnotesize`), in points.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import pandas as pd

from sme_registry.io.markup import escape_latex

__all__ = ["COLUMN_WIDTH", "latex_table", "text_width"]

COLUMN_WIDTH = 225.0  # of LaTeX's own article; those of journals and conferences are wider
_NAMES_WIDTH = 62.0  # at least, of the column of names, unless they are shorter
_SEPARATION, _INDENT = 6.0, 8.0  # between two columns, and of the lines below a heading
_LINES = 44  # of a float, on a page with its caption
_PACKAGES = "% needs \\usepackage{booktabs,tabularx,array}\n"
_NARROW, _WIDE = ".,:;|ijlt'[]() -", "mwMWQ@%+=−–±½"
_RUN = 8  # characters of a word that TeX may not break by itself


def latex_table(
    frame: pd.DataFrame, *, names: int, caption: str, label: str, width: float = COLUMN_WIDTH
) -> str:
    """A table as LaTeX, in one or more floats; ASCII only."""
    room = width - _across_width(frame, names)
    longest = max(text_width(", ".join(row[:names])) for row in _rows(frame))
    fits = room >= min(longest, _NAMES_WIDTH)
    head, blocks = _across(frame, names, room) if fits else _stacked(frame, names, width)
    spec = "@{}>{\\raggedright\\arraybackslash}X" + "r" * (len(head) - 1) + "@{}"
    parts = []
    for index, rows in enumerate(_pages(blocks)):
        text = escape_latex(f"{caption.split('. ')[0]} (continued)" if index else caption)
        parts.append(
            "\\begin{table}\n\\centering\\footnotesize\\setlength{\\tabcolsep}{3pt}\n"
            f"\\caption{{{text}}}\n\\label{{tab:{label}{f'-{index + 1}' if index else ''}}}\n"
            f"\\begin{{tabularx}}{{\\linewidth}}{{{spec}}}\n\\toprule\n{_line(head)}\\midrule\n"
            + rows
            + "\\bottomrule\n\\end{tabularx}\n\\end{table}\n"
        )
    return _PACKAGES + "\n".join(parts)


def text_width(text: str) -> float:
    """About the width of a text in points, rather too wide than too narrow."""
    return sum(map(_letter_width, text))


def _letter_width(letter: str) -> float:
    if letter in _NARROW:
        return 3.4
    if letter in _WIDE:
        return 7.1
    return 6.0 if letter.isupper() else 4.5


def _across_width(frame: pd.DataFrame, names: int) -> float:
    columns = list(frame.columns[names:])
    widest = (max(map(text_width, (name, *frame[name]))) for name in columns)
    return sum(width + _SEPARATION for width in widest)


class _Block(NamedTuple):
    """Rows that stay together: their source, and how many lines they take in print."""

    source: str
    lines: int


def _across(frame: pd.DataFrame, names: int, room: float) -> tuple[list[str], list[_Block]]:
    """Cells of the head, and the rows; `room` is the width of the column of names."""
    head = [_joined(frame.columns[:names]), *map(escape_latex, frame.columns[names:])]
    blocks = []
    for row in _rows(frame):
        cells = [_joined(row[:names]), *map(escape_latex, row[names:])]
        blocks.append(_Block(_line(cells), _lines(", ".join(row[:names]), room)))
    return head, blocks


def _stacked(frame: pd.DataFrame, names: int, width: float) -> tuple[list[str], list[_Block]]:
    """The same with a heading for each row, and a line for each of its columns."""
    widest = max((text_width(text) for row in _rows(frame) for text in row[names:]), default=0.0)
    room = width - widest - _SEPARATION - _INDENT
    blocks: list[_Block] = []
    for row in _rows(frame):
        heading = f"\\raggedright\\arraybackslash {_joined(row[:names])}"
        source = "\\addlinespace[2pt]\n" if blocks else ""
        source += f"\\multicolumn{{2}}{{@{{}}p{{\\linewidth}}@{{}}}}{{{heading}}} \\\\\n"
        lines = 1 + _lines(", ".join(row[:names]), width)
        for name, cell in zip(frame.columns[names:], row[names:], strict=True):
            source += _line([f"\\hangindent2em\\quad {_breakable(name)}", escape_latex(cell)])
            lines += _lines(name, room)
        blocks.append(_Block(source, lines))
    return [_joined(frame.columns[:names]), "value"], blocks


def _pages(blocks: Iterable[_Block]) -> Iterable[str]:
    """The source of as many whole blocks as fit on each page."""
    page, lines = "", 0
    for block in blocks:
        if page and lines + block.lines > _LINES:
            yield page
            page, lines = "", 0
        page, lines = page + block.source, lines + block.lines
    yield page


def _lines(text: str, room: float) -> int:
    """About how many lines a text takes in a column, which is left ragged."""
    return max(1, math.ceil(1.15 * text_width(text) / room))


def _line(cells: Sequence[str]) -> str:
    return f"{' & '.join(cells)} \\\\\n"


def _rows(frame: pd.DataFrame) -> Iterable[list[str]]:
    return ([*row] for row in frame.itertuples(index=False))


def _joined(names: Iterable[str]) -> str:
    """Names of a row as one text, without those that are empty."""
    return ", ".join(_breakable(name) for name in names if name)


def _breakable(text: str) -> str:
    r"""Text that TeX may break within: `\allowbreak` after signs, `\-` in long words."""
    parts = re.findall(r"[A-Za-z0-9]+|[^A-Za-z0-9]", text)
    broken = []
    for part in parts:
        if part.isalnum() and part.isascii():
            chunks = [part[i : i + _RUN] for i in range(0, len(part), _RUN)]
            broken.append("\\-".join(chunks))
        else:
            broken.append(escape_latex(part) + ("" if part == " " else "\\allowbreak{}"))
    return "".join(broken)
