"""Terminal output: tables, plain JSON, progress, and errors as one line."""

from sme_registry.terminal.commands import CommandGroup, application
from sme_registry.terminal.latex import escape_latex
from sme_registry.terminal.numbers import duration, duration_range, fixed
from sme_registry.terminal.output import err, failure, out, print_json, print_pairs, table
from sme_registry.terminal.progress import Progress

__all__ = [
    "CommandGroup",
    "Progress",
    "application",
    "duration",
    "duration_range",
    "err",
    "escape_latex",
    "failure",
    "fixed",
    "out",
    "print_json",
    "print_pairs",
    "table",
]
