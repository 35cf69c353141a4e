"""The application of a command line, and its exit codes and error messages."""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import re
import sys
from importlib import metadata
from typing import Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from sme_registry.errors import SMEError
from sme_registry.io import missing_dependency
from sme_registry.terminal.output import failure


class CommandGroup(TyperGroup):
    """Commands that report invalid input as one line on standard error and an exit code.

    Attributes:
      exit_codes: exit codes of error types; the first match counts. Any other `SMEError` is 2.
      extra: the extra of our package that these commands need, if there is one.
    """

    exit_codes: tuple[tuple[type[SMEError], int], ...] = ()
    extra: str = ""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        _show_literally(self)

    def main(self, *args: Any, **options: Any) -> Any:
        """Run the command line, and exit with its exit code."""
        options |= {"standalone_mode": False, "prog_name": self.name}
        _use_utf8()
        try:
            code = super().main(*args, **options)
            sys.stdout.flush()
        except BrokenPipeError:
            sys.exit(_discard_output())
        except Exception as error:
            # Usage errors are Click's, which only some versions of Typer include: they are
            # recognised by their method `format_message`.
            if not hasattr(error, "format_message"):
                raise
            context = getattr(error, "ctx", None)
            command = context.command_path if context is not None else self.name
            message = error.format_message().replace("Value error, ", "").rstrip(".")
            if message:  # empty if the help was printed instead
                stop = "" if message.endswith(("?", "!")) else "."
                failure(f"{message}{stop} See `{command} --help`.")
            sys.exit(getattr(error, "exit_code", 2))
        sys.exit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        """Run a command; invalid input and interrupts end it without a traceback."""
        try:
            return super().invoke(ctx)
        except SMEError as error:
            failure(str(error))
            codes = (code for kind, code in self.exit_codes if isinstance(error, kind))
            raise typer.Exit(next(codes, 2)) from None
        except ModuleNotFoundError as error:
            missing = missing_dependency(error, self.extra)
            if missing is None:
                raise
            failure(str(missing))
            raise typer.Exit(2) from None
        except BrokenPipeError:
            raise typer.Exit(_discard_output()) from None
        except KeyboardInterrupt as stopped:
            failure(str(stopped) or "interrupted: no file is incomplete.")
            raise typer.Exit(130) from None


def _show_literally(command: Any) -> None:
    """Make the help of a command and of all in it show as it is written, in paragraphs.

    Markdown would remove asterisks, backticks and angle brackets, and Rich's markup brackets.
    """
    for each in (command, *command.params):
        if getattr(each, "help", None):
            each.help = escape(_in_paragraphs(inspect.cleandoc(each.help)))
    for child in getattr(command, "commands", {}).values():
        _show_literally(child)


def _in_paragraphs(text: str) -> str:
    """Text with one line per paragraph; indented ones, the examples, follow without empty lines."""
    paragraphs = [re.sub(r"\n\s*", " ", part) for part in re.split(r"\n\s*\n", text)]
    return re.sub(r"(?m)^( .*)\n\n(?= )", r"\1\n", "\n\n".join(paragraphs))


def _show_version(context: typer.Context, wanted: bool) -> None:
    if wanted:
        typer.echo(f"{context.info_name} {metadata.version('sme-registry')}")
        raise typer.Exit


def application(
    program: str, description: str, commands: type[CommandGroup] = CommandGroup
) -> typer.Typer:
    """Create the application to which a program's commands are added; it has `--version`."""
    app = typer.Typer(
        name=program,
        help=description,
        cls=commands,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
    )

    @app.callback()
    def options(
        version: Annotated[
            bool,
            typer.Option(
                "--version", callback=_show_version, is_eager=True, help="Show the version."
            ),
        ] = False,
    ) -> None:
        pass

    return app


def _use_utf8() -> None:
    """Print UTF-8 also where the system's default is another encoding, as in pipes on Windows."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.encoding.lower() != "utf-8":
            stream.reconfigure(encoding="utf-8")


def _discard_output() -> int:
    """Handle a reader that has closed the pipe (`sme list | head`), which is no error: code 0.

    Otherwise Python would report at exit that it cannot flush its output.
    """
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
