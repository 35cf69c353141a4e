"""Command lines: output, numbers for people, progress, exit codes, and errors as one line."""

from __future__ import annotations

import contextlib
import errno
import importlib
import inspect
import io
import json
import logging
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping
from importlib import metadata
from types import TracebackType
from typing import Annotated, Any, ClassVar, Self, TextIO

import typer
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bars
from rich.segment import Segment
from rich.table import Table
from rich.text import Text
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from sme_registry.errors import OptionError, SMEError, did_you_mean
from sme_registry.io.files import to_json
from sme_registry.io.system import hidden_in, missing_dependency, visible

_SECONDS_PER_DAY = 86_400


def fixed(value: float, digits: int = 3) -> str:
    """A number with a fixed count of digits, and no negative zero."""
    return f"{value:z.{digits}f}"


def duration(seconds: float) -> str:
    """`42 s`, `3 min 10 s`, `2 h 5 min`, `3.5 days`."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    if whole < 2 * _SECONDS_PER_DAY:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{seconds / _SECONDS_PER_DAY:.1f} days"


def duration_range(low: float, high: float) -> str:
    """`3 min 10 s`, or `2 h 0 min to 4 h 5 min` where the bounds differ."""
    first, last = duration(low), duration(high)
    return first if first == last else f"{first} to {last}"


_UNLIMITED = 100_000  # columns: lines of a file or a pipe are never wrapped


class _Console(Console):
    """Shows hidden characters as escapes, and wraps no lines of output that is no terminal."""

    def __init__(self, file: TextIO) -> None:
        super().__init__(file=file, highlight=False, emoji=False)
        # FORCE_COLOR, which Jupyter sets: colours in a pipe, but nothing that moves the cursor.
        if self.is_terminal and os.environ.get("FORCE_COLOR") and not file.isatty():
            super().__init__(
                file=file,
                highlight=False,
                emoji=False,
                force_terminal=False,
                color_system="standard",
            )
        if not self.is_terminal:
            self.width = _UNLIMITED

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=visible(segment.text))

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def out() -> Console:
    """Standard output as it is now: tests and pipes replace it."""
    return _Console(sys.stdout)


def err() -> Console:
    return _Console(sys.stderr)


def print_line(text: str) -> None:
    """Print markup that is never wrapped, as it has a path or a command that people copy."""
    out().print(text, soft_wrap=True)


def print_note(text: str) -> None:
    """The same on standard error."""
    err().print(text, soft_wrap=True)


def failure(message: str) -> None:
    print_note(f"[bold red]error:[/] {escape(message)}")


def print_json(value: Any) -> None:
    """Plain JSON, and nothing else, on standard output; hidden characters are escaped."""
    text = to_json(value)
    escapes = {ord(each): json.dumps(each)[1:-1] for each in hidden_in(text)}
    sys.stdout.write(text.translate(escapes))


class _LogHandler(logging.Handler):
    """Prints what libraries and servers log as all other text."""

    def emit(self, record: logging.LogRecord) -> None:
        print_note(escape(self.format(record)))


def log_to_terminal() -> None:
    """Let logs and warnings of this process pass through the console, which cleans them."""
    logging.basicConfig(handlers=[_LogHandler()])
    logging.captureWarnings(True)


def print_pairs(title: str, pairs: dict[str, object]) -> None:
    """Names and values, one per line, under a title."""
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


_SECONDS_TO_FIRST_LINE = 5.0
_SECONDS_BETWEEN_TENTHS = 60.0
_SECONDS_BETWEEN_BARS = 0.5
_PARTS_NAMED = 3  # in a line


class Progress:
    """How far a job is: bars in a terminal, elsewhere a few lines, at most one a minute."""

    def __init__(
        self,
        title: str,
        total: int,
        *,
        done: int = 0,
        console: Console | None = None,
        unit: str = "steps",
        enabled: bool = True,
    ) -> None:
        self._title, self._unit = title, unit
        self._total, self._done_before, self._done = total, done, done
        self._rate_from: tuple[int, float] | None = None  # steps and time; None while it prepares
        nowhere = Console(quiet=True, force_terminal=False)
        self._console = (console or err()) if enabled else nowhere
        self._note = ""
        self._parts: dict[str, str] = {}  # how far they are
        self._start = self._last = time.monotonic()
        self._share_printed = 0.0
        self._bars: Bars | None = None
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._start = self._last = time.monotonic()
        self._rate_from = self._done, self._start
        if self._console.is_terminal:
            self._bars = Bars(
                TextColumn("{task.description}", markup=False),  # else :x: becomes an emoji
                BarColumn(bar_width=24),
                TextColumn("{task.fields[text]}", markup=False),
                console=self._console,
            )
            self._tasks[""] = self._bars.add_task(
                self._title, total=self._total, completed=self._done, text=""
            )
            self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for name in tuple(self._parts):
            self._remove(name)
        if self._bars is not None:
            self._draw()
            self._bars.stop()
        elif error is None and self._done_before < self._done >= self._total:
            self._print()

    def prepare(self, note: str) -> None:
        """Show at once what precedes the first steps; the rate is measured from these on."""
        self._note, self._rate_from = note, None
        if self._bars is not None:
            self._draw()
        else:
            self.message(f"{self._title}: {note}")

    def update(self, done: int, total: int | None = None, note: str | None = None) -> None:
        """Set how far the job is, as callbacks report it; cheap enough to call at every step."""
        self._done = done
        self._rate_from = self._rate_from or (done, time.monotonic())
        self._note = self._note if note is None else note
        self._total = self._total if total is None else total
        self._refresh()

    def start_part(self, name: str, note: str = "") -> None:
        """Show a part of the job that runs from now on, and what it does first."""
        self._parts[name] = f"({note})" if note else "0%"
        if self._bars is not None:
            label = f"  {name}"
            self._tasks[name] = self._bars.add_task(label, total=1.0, text=note or "starting")
        self._refresh()

    def update_part(self, name: str, share: float, note: str = "") -> None:
        """Set how far a part is, from 0 to 1."""
        self._parts[name] = f"{share:.0%}"
        if self._bars is not None:
            self._bars.update(self._tasks[name], completed=share, text=note)
        self._refresh()

    def end_part(self, name: str) -> None:
        """Stop showing a part; of one that was never started this does nothing."""
        self._remove(name)
        self._refresh()

    def message(self, text: str) -> None:
        """Print a line of its own, above the bars."""
        self._console.print(escape(text), highlight=False, soft_wrap=True)

    def _remove(self, name: str) -> None:
        self._parts.pop(name, None)
        if self._bars is not None and name in self._tasks:
            self._bars.remove_task(self._tasks.pop(name))

    def _refresh(self) -> None:
        now = time.monotonic()
        if self._bars is not None:
            if now - self._last >= _SECONDS_BETWEEN_BARS:
                self._last = now
                self._draw()
        elif self._done < self._total and self._line_is_due(now):  # the last one is at the end
            self._last, self._share_printed = now, self._done / self._total
            self._print()

    def _line_is_due(self, now: float) -> bool:
        if now - self._start >= max(_SECONDS_TO_FIRST_LINE, 2 * (self._last - self._start)):
            return True
        another_tenth = self._done / self._total - self._share_printed >= 0.1
        return another_tenth and now - self._last >= _SECONDS_BETWEEN_TENTHS

    def _draw(self) -> None:
        assert self._bars is not None
        done, text = min(self._done, self._total), " · ".join(self._summary())
        self._bars.update(self._tasks[""], completed=done, total=self._total, text=text)

    def _print(self) -> None:
        self.message(f"{self._title}: {' · '.join([*self._summary(), *self._running()])}")

    def _summary(self) -> list[str]:
        """`4 of 10 steps`, the rate, the time left, the note."""
        now = time.monotonic()
        done_before, start = self._rate_from or (self._done, now)
        rate = (self._done - done_before) / max(now - start, 1e-9)
        parts = [f"{self._done:,} of {self._total:,} {self._unit}"]
        if rate >= 1:
            parts.append(f"{rate:,.0f} {self._unit}/s")
        if self._done >= self._total:
            parts.append("done")
        elif rate > 0:
            parts.append(f"about {duration((self._total - self._done) / rate)} left")
        return [*parts, self._note] if self._note else parts

    def _running(self) -> list[str]:
        if not self._parts:
            return []
        parts = [f"{name} {state}" for name, state in self._parts.items()]
        more = f", and {len(parts) - _PARTS_NAMED} more" if len(parts) > _PARTS_NAMED else ""
        return [f"running: {', '.join(parts[:_PARTS_NAMED])}{more}"]


class CommandGroup(TyperGroup):
    """Commands that report invalid input as one line on standard error and an exit code.

    A command of `modules` is in the `app` of its module, which is imported when it is called; the
    help shows its summary, in a panel if it has one. A former command of `replaced` says in one
    sentence what replaces it.
    """

    exit_codes: tuple[tuple[type[SMEError], int], ...] = ()  # the first match; else 2
    extra: str = ""  # of our package, which these commands need
    modules: ClassVar[Mapping[str, tuple[str, ...]]] = {}  # command → module, summary[, panel]
    replaced: ClassVar[Mapping[str, str]] = {}

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for name, (_, summary, *panel) in self.modules.items():
            panel_name = panel[0] if panel else None
            self.commands[name] = TyperCommand(name, help=summary, rich_help_panel=panel_name)
        _arrange_help(self)

    def load(self, name: str) -> Any:
        """The command of a name; its module is imported."""
        if name in self.modules:
            module = importlib.import_module(self.modules[name][0])
            self.commands[name] = get_group(module.app).commands[name]
            _arrange_help(self.commands[name])
        return self.commands[name]

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] in self.replaced and not ctx.resilient_parsing:  # not while the shell completes
            raise OptionError(f"{args[0]}: {self.replaced[args[0]]}")
        name, command, rest = super().resolve_command(ctx, args)
        return name, None if command is None else self.load(args[0]), rest

    def main(self, *args: Any, **options: Any) -> Any:
        options |= {"standalone_mode": False, "prog_name": self.name}
        _use_utf8()
        log_to_terminal()
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
            message = _usage_message(error, context).replace("Value error, ", "").rstrip(".")
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
        except OSError as error:
            if error.errno != errno.ENAMETOOLONG:
                raise
            failure(f"{error.filename!s:.80}…: {error.strerror}. Give a shorter name.")
            raise typer.Exit(2) from None
        except KeyboardInterrupt as stopped:
            failure(str(stopped) or "interrupted: no file is incomplete.")
            raise typer.Exit(130) from None


_MOST_OPTIONS = 10  # of a command, with --help, before those in the panel "Advanced"


def _arrange_help(command: Any) -> None:
    """Show the help of a command and of all in it in paragraphs, and later options in a panel."""
    for each in (command, *command.params):
        if getattr(each, "help", None):
            each.help = escape(_in_paragraphs(inspect.cleandoc(each.help)))
    options = [each for each in command.params if each.opts[0].startswith("-") and not each.hidden]
    for option in options[_MOST_OPTIONS - 1 :]:
        option.rich_help_panel = "Advanced"
    for child in getattr(command, "commands", {}).values():
        _arrange_help(child)


def _in_paragraphs(text: str) -> str:
    """Text with one line per paragraph; indented lines, the examples, stay lines of their own."""
    joined = re.sub(r"(?<!\n)\n(?![\n ])", " ", text)
    return re.sub(r"(?m)^( .*)\n\n(?= )", r"\1\n", joined)


def _usage_message(error: Any, context: Any) -> str:
    """Click's message; of an unknown option, the near ones, or how fields are set instead."""
    unknown = getattr(error, "option_name", "")
    if type(error).__name__ != "NoSuchOption" or context is None:
        return str(error.format_message())
    known = {name: parameter for parameter in context.command.params for name in parameter.opts}
    near = did_you_mean(unknown, [name for name in known if name.startswith("--")])
    field = unknown.lstrip("-").replace("-", "_")
    if unknown == "--set" and "--shaping" in known:
        near = (
            " Each field has an option of its own, such as --complexity 10. That of a block takes "
            "JSON, such as --shaping '{\"scale\": 3}'."
        )
    elif not near and "--set" in known and known["--set"].metavar != "ALGORITHM.NAME=VALUE":
        near = f" Fields and hyperparameters are set by name: --set {field}=VALUE."
    return f"No such option: {unknown}.{near}"


def count(text: str) -> int:
    """The parser of options that count: `20000`, `20_000`, `2e4`."""
    with contextlib.suppress(ValueError):
        number = float(text)
        if number.is_integer():
            return int(number)
    raise typer.BadParameter(f"{text!r}: must be an integer, such as 20000 or 2e4")


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
    """Handle a reader that has closed the pipe (`sme list | head`), which is no error: code 0."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
