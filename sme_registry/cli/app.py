"""The application: its commands, and what becomes of errors.

Exit codes: 0 done; 1 a task that `certify` refuses; 2 bad input; 130 interrupted.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from sme_registry.cli import demo, documents, runs
from sme_registry.cli.output import failure
from sme_registry.errors import SMEError


class _Commands(TyperGroup):
    """Turns every error on bad input into one line on standard error and exit code 2."""

    def main(self, *args: Any, **options: Any) -> Any:
        options |= {"standalone_mode": False, "prog_name": "sme"}
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
            command = context.command_path if context is not None else "sme"
            message = error.format_message().replace("Value error, ", "").rstrip(".")
            if message:  # none where `sme` stood alone: the help is out already
                failure(f"{message}. `{command} --help` shows how.")
            sys.exit(getattr(error, "exit_code", 2))
        sys.exit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except SMEError as error:
            failure(str(error))
            raise typer.Exit(2) from None
        except BrokenPipeError:
            raise typer.Exit(_leave_the_pipe()) from None
        except KeyboardInterrupt as stopped:
            failure(str(stopped) or "interrupted: what was being written is whole or absent.")
            raise typer.Exit(130) from None


def _leave_the_pipe() -> int:
    """Whoever read our output has left (`sme list | head`), which is no error: exit code 0.

    Python would complain at its end that it cannot write what it still holds.
    """
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        from sme_registry import __version__

        typer.echo(f"sme {__version__}")
        raise typer.Exit


@app.callback()
def _top(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Synthetic Monitoring Environments: control tasks whose optimal policy is known exactly.

    A first look:  **sme list**  ·  **sme show Default**  ·  **sme demo**

    Your own task:  **sme new mine.json --complexity 10 --seed 3**
    """


_COMMANDS: dict[str, Callable[..., None]] = {
    "list": documents.list_,
    "show": documents.show,
    "new": documents.new,
    "validate": documents.validate,
    "certify": documents.certify,
    "evaluate": runs.evaluate,
    "train": runs.train,
    "demo": demo.demo,
}
for _name, _command in _COMMANDS.items():
    app.command(_name)(_command)


def main() -> None:
    """The entry point of the command `sme`."""
    app()
