"""Terminal output: tables, plain JSON, progress, and errors as one line."""

from sme_registry.terminal.commands import CommandGroup, application
from sme_registry.terminal.latex import escape_latex
from sme_registry.terminal.numbers import duration, duration_range, fixed
from sme_registry.terminal.output import err, failure, out, print_json, print_pairs
from sme_registry.terminal.progress import Progress
from sme_registry.terminal.prose import Answers, Paragraph
from sme_registry.terminal.svg import Scale
from sme_registry.terminal.tables import Table

__all__ = [
    "Answers",
    "CommandGroup",
    "Paragraph",
    "Progress",
    "Scale",
    "Table",
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
]
