"""The directive `command-line`: every command of a typer application, from the application itself.

    ```{command-line} sme sme_registry.cli
    ```

gives each command a heading, its help, its arguments and its options, and a label such as
`sme-train`. Nothing of typer's internals is used: they change from version to version.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from typer.main import get_command

_SPECIAL = re.compile(r"([\\*_\[\]<>|#$])")
_OPTION = re.compile(r"(?<![\w`-])(--[a-z][a-z-]*)")


def page(program: str, module: str) -> str:
    """The commands of `module.app` as Markdown, with headings from the second level on."""
    command: Any = get_command(importlib.import_module(module).app)
    for name in command.modules:  # of which a group knows only a summary
        command.load(name)
    return "\n".join(_command(command, program, None, 1))


def _command(command: Any, path: str, parent: Any, level: int) -> Iterator[str]:
    context = command.context_class(command, info_name=path.split()[-1], parent=parent)
    if level > 1:
        yield f"({path.replace(' ', '-')})=\n{'#' * level} {path}\n"
    yield from _text(command.help or "")
    yield f"```text\n{command.get_usage(context).removeprefix('Usage: ')}\n```\n"
    records = [p.get_help_record(context) for p in command.get_params(context)]
    rows = [record for record in records if record and not record[0].startswith("--help")]
    if rows:
        yield "| | |\n|---|---|"
        yield from (f"| {_code(names)} | {_prose(meaning)} |" for names, meaning in rows)
        yield ""
    for name, below in getattr(command, "commands", {}).items():
        if not below.hidden:
            yield from _command(below, f"{path} {name}", context, level + 1)


def _text(text: str) -> Iterator[str]:
    """Help as Markdown: lines that are indented are commands to type."""
    commands: list[str] = []
    for line in [*text.replace("\b", "").splitlines(), "end"]:
        if line.startswith("  "):
            commands.append(line.strip())
        elif line.strip():
            if commands:
                yield "\n```sh\n" + "\n".join(commands) + "\n```\n"
                commands = []
            if line != "end":
                yield _prose(line) + "\n"
    yield ""


def _prose(text: str) -> str:
    """Markdown in which options are code."""
    parts = text.split("`")
    parts[::2] = [_OPTION.sub(r"`\1`", _SPECIAL.sub(r"\\\1", part)) for part in parts[::2]]
    return "`".join(parts)


def _code(text: str) -> str:
    return "`" + text.replace("|", r"\|") + "`"


class CommandLine(SphinxDirective):
    """`{command-line} PROGRAM MODULE`."""

    required_arguments = 2

    def run(self) -> list[nodes.Node]:
        """The sections of the program's commands."""
        return self.parse_text_to_nodes(page(*self.arguments), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_directive("command-line", CommandLine)
    return {"parallel_read_safe": True}
