"""What people see of a program: tables, plain JSON, progress, and errors as one line."""

from sme_registry.terminal.commands import CommandGroup, application, version_option
from sme_registry.terminal.output import err, failure, fixed, mark, out, print_json, print_pairs
from sme_registry.terminal.progress import Meter, duration

__all__ = [
    "CommandGroup",
    "Meter",
    "application",
    "duration",
    "err",
    "failure",
    "fixed",
    "mark",
    "out",
    "print_json",
    "print_pairs",
    "version_option",
]
