"""`TextTable`: a table of finished text, for a paper and for the report's page, and its entries."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from sme_registry.io.markup import fixed, signed
from sme_registry.studies.report.latex import latex_table
from sme_registry.studies.report.tables import ENOUGH_RUNS, Metric

ABSENT = "–"


@dataclass(frozen=True, eq=False)
class TextTable:
    """A table for people, with the name of its files, a title, and a note on how to read it."""

    name: str
    title: str
    note: str
    frame: pd.DataFrame
    names: int = 1
    label: str = ""  # of LaTeX; by default the name

    def latex(self) -> str:
        """As a LaTeX `table` that fits a column of two; ASCII only."""
        caption = f"{self.title}. {self.note}"
        return latex_table(
            self.frame, names=self.names, caption=caption, label=self.label or self.name
        )


def wide(
    rows: pd.DataFrame,
    index: dict[str, str],
    across: str,
    entry: Callable[[Any], str],
    order: Sequence[str] = (),
) -> pd.DataFrame:
    """A long table as text: a column for each value of `across`, in the order of the rows."""
    lines: dict[tuple[Any, ...], dict[str, str]] = {}
    for row in rows.itertuples():
        place = tuple(getattr(row, name) for name in index)
        lines.setdefault(place, {})[getattr(row, across)] = entry(row)
    names = [name for name in order or dict.fromkeys(rows[across]) if name in set(rows[across])]
    wide = pd.DataFrame(
        [dict(zip(index.values(), place, strict=True)) | line for place, line in lines.items()],
        columns=[*index.values(), *names],
    )
    return wide.fillna(ABSENT)


def slug(name: str) -> str:
    """A name with `-` for everything but letters and digits."""
    return "".join(letter if letter.isalnum() else "-" for letter in name.replace(" − ", "-"))


def level_text(row: Any, metric: Metric) -> str:
    """The IQM of a row with its interval, and the number of runs where these are few."""
    count = "" if row.runs >= ENOUGH_RUNS else f" (n = {row.runs})"
    return with_interval(row.iqm, row, metric.digits) + count


def change_text(row: Any, change: float, digits: int) -> str:
    """A change with the row's interval; marked if the interval excludes 0 by enough pairs."""
    count = "" if row.enough_pairs else " (1 pair)" if row.pairs == 1 else f" (n = {row.pairs})"
    mark = {"worse": " *", "better": " †"}.get(row.verdict, "") if row.enough_pairs else ""
    return with_interval(change, row, digits, signed) + count + mark


def with_interval(
    value: float, row: Any, digits: int = 2, text: Callable[[float, int], str] = fixed
) -> str:
    """A number with the row's interval; without it where it is unknown."""
    if math.isnan(row.low):
        return text(value, digits)
    return f"{text(value, digits)} [{text(row.low, digits)}, {text(row.high, digits)}]"
