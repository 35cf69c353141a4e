"""The application: its commands, and what becomes of errors.

Exit codes: 0 done; 1 a task that `certify` refuses, or a study whose cells failed; 2 bad input;
130 interrupted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from sme_registry.cli import datasets, demo, diagnose, documents, offline, runs, studies
from sme_registry.terminal import CommandGroup, application, version_option


class _Commands(CommandGroup):
    """The commands of `sme`."""

    program = "sme"


app = application(_Commands)


@app.callback()
def _top(
    version: Annotated[bool, version_option(_Commands.program)] = False,
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
    "diagnose": diagnose.diagnose,
    "demo": demo.demo,
}
for _name, _command in _COMMANDS.items():
    app.command(_name)(_command)
app.add_typer(studies.app, name="study")
app.add_typer(datasets.app, name="dataset")
app.add_typer(offline.app, name="offline")


def main() -> None:
    """The entry point of the command `sme`."""
    app()
