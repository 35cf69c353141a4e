"""What commands print: results on standard output, everything else on standard error."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sme_registry.io import to_json


class _Out(Console):
    """Leaves a broken pipe to `CommandGroup`; Rich would exit with code 1."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def out() -> Console:
    """Standard output as it is now: tests and pipes replace it."""
    return _Out(file=sys.stdout, highlight=False)


def err() -> Console:
    """Standard error, for progress and errors."""
    return Console(file=sys.stderr, highlight=False)


def failure(message: str) -> None:
    """One red line on standard error."""
    err().print(f"[bold red]error:[/] {escape(message)}", soft_wrap=True)


def print_json(value: Any) -> None:
    """Plain JSON, and nothing else, on standard output."""
    sys.stdout.write(to_json(value))


def print_pairs(title: str, pairs: dict[str, object]) -> None:
    """Names and values, one per line, under a title."""
    out().print(title)
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in pairs.items():
        table.add_row(name, escape(str(value)))
    out().print(table)


def table(
    title: str,
    columns: Mapping[str, str],
    rows: Iterable[Sequence[str]] = (),
    *,
    caption: str = "",
) -> Table:
    """A table.

    Args:
      title: above it.
      columns: heading → "name" (never wrapped), "number" (to the right) or "text" (wrapped).
      rows: their cells, with Rich's markup.
      caption: below it.
    """
    result = Table(
        title=title or None,
        caption=caption or None,
        title_justify="left",
        caption_justify="left",
    )
    for heading, kind in columns.items():
        result.add_column(
            heading,
            justify="right" if kind == "number" else "left",
            no_wrap=kind == "name",
            overflow="fold" if kind == "text" else "ellipsis",
        )
    for row in rows:
        result.add_row(*row)
    return result
