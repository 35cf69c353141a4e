"""What commands print: results on standard output, everything else on standard error."""

from __future__ import annotations

import os
import sys
from typing import Any, TextIO

from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from sme_registry.io import to_json

_UNLIMITED = 100_000  # columns: lines of a file or a pipe are never wrapped


class _Console(Console):
    """Never wraps lines of output that is no terminal, and leaves broken pipes to `CommandGroup`.

    Rich would wrap at 80 columns, and exit with code 1 if the pipe breaks. With FORCE_COLOR, which
    Jupyter sets for the shell cells of a notebook, it would also draw bars into a pipe: colours are
    possible there, but nothing that moves the cursor.
    """

    def __init__(self, file: TextIO) -> None:
        super().__init__(file=file, highlight=False)
        if self.is_terminal and os.environ.get("FORCE_COLOR") and not file.isatty():
            super().__init__(
                file=file, highlight=False, force_terminal=False, color_system="standard"
            )
        if not self.is_terminal:
            self.width = _UNLIMITED

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def out() -> Console:
    """Standard output as it is now: tests and pipes replace it."""
    return _Console(sys.stdout)


def err() -> Console:
    """Standard error, for progress and errors."""
    return _Console(sys.stderr)


def failure(message: str) -> None:
    """One red line on standard error."""
    err().print(f"[bold red]error:[/] {escape(message)}", soft_wrap=True)


def print_json(value: Any) -> None:
    """Plain JSON, and nothing else, on standard output."""
    sys.stdout.write(to_json(value))


def print_pairs(title: str, pairs: dict[str, object]) -> None:
    """Names and values, one per line, under a title.

    A value with a word that is too long for the rest of the line, such as a digest, starts on a
    line of its own.
    """
    console = out()
    console.print(title)
    column = 1 + max(map(cell_len, pairs), default=0)
    for name, value in pairs.items():
        text = str(value)
        if console.width - column < max(map(cell_len, text.split()), default=0):
            console.print(f"[cyan]{escape(name)}[/]\n  {escape(text)}", soft_wrap=True)
            continue
        line = Table.grid()
        line.add_column(width=column, style="cyan")
        line.add_row(name, Text(text))
        console.print(line)
