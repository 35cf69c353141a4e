"""`CommandGroup`: the commands of a program, and what becomes of errors; and what makes one."""

from __future__ import annotations

import contextlib
import os
import sys
from importlib import metadata
from typing import Any

import typer
from typer.core import TyperGroup

from sme_registry.errors import SMEError
from sme_registry.terminal.output import failure


class CommandGroup(TyperGroup):
    """Turns every error on bad input into one line on standard error and an exit code.

    Attributes:
      program: what the command is called.
      exit_codes: of kinds of errors, the first that fits; any other `SMEError` is 2.
    """

    program = ""
    exit_codes: tuple[tuple[type[SMEError], int], ...] = ()

    def main(self, *args: Any, **options: Any) -> Any:
        """Run the command line, and leave with its exit code."""
        options |= {"standalone_mode": False, "prog_name": self.program}
        try:
            code = super().main(*args, **options)
            sys.stdout.flush()
        except BrokenPipeError:
            sys.exit(_leave_the_pipe())
        except Exception as error:
            # A usage error is Click's, which Typer brings along in some versions and not in
            # others: what tells it apart is that it can format itself.
            if not hasattr(error, "format_message"):
                raise
            context = getattr(error, "ctx", None)
            command = context.command_path if context is not None else self.program
            message = error.format_message().replace("Value error, ", "").rstrip(".")
            if message:  # none where it stood alone: the help is out already
                failure(f"{message}. `{command} --help` shows how.")
            sys.exit(getattr(error, "exit_code", 2))
        sys.exit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; bad input and an interruption end it without a traceback."""
        try:
            return super().invoke(ctx)
        except SMEError as error:
            failure(str(error))
            codes = (code for kind, code in self.exit_codes if isinstance(error, kind))
            raise typer.Exit(next(codes, 2)) from None
        except BrokenPipeError:
            raise typer.Exit(_leave_the_pipe()) from None
        except KeyboardInterrupt as stopped:
            failure(str(stopped) or "interrupted: what was being written is whole or absent.")
            raise typer.Exit(130) from None


def application(commands: type[CommandGroup]) -> typer.Typer:
    """The application that a program's commands are added to."""
    return typer.Typer(
        cls=commands,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def version_option(program: str) -> Any:
    """`--version`, for the callback of an application."""

    def show(wanted: bool) -> None:
        if wanted:
            typer.echo(f"{program} {metadata.version('sme-registry')}")
            raise typer.Exit

    return typer.Option("--version", callback=show, is_eager=True, help="Show the version.")


def _leave_the_pipe() -> int:
    """Whoever read our output has left (`sme list | head`), which is no error: exit code 0.

    Python would complain at its end that it cannot write what it still holds.
    """
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
