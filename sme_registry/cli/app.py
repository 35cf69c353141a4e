"""The command `sme` and its subcommands.

Exit codes: 0 success; 1 a task refused by `certify`, or failed cells of a study; 2 invalid input;
130 interrupted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from sme_registry.cli import (
    certify,
    dataset,
    demo,
    diagnose,
    evaluate,
    list,
    new,
    offline,
    show,
    study,
    train,
    validate,
)
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

    To start:  **sme list**  ·  **sme show Default**  ·  **sme demo**

    Your own task:  **sme new mine.json --complexity 10 --seed 3**
    """


_COMMANDS: dict[str, Callable[..., None]] = {
    "list": list.list_,
    "show": show.show,
    "new": new.new,
    "validate": validate.validate,
    "certify": certify.certify,
    "evaluate": evaluate.evaluate,
    "train": train.train,
    "diagnose": diagnose.diagnose,
    "demo": demo.demo,
}
for _name, _command in _COMMANDS.items():
    app.command(_name)(_command)
app.add_typer(study.app, name="study")
app.add_typer(dataset.app, name="dataset")
app.add_typer(offline.app, name="offline")


def main() -> None:
    """The entry point of the command `sme`."""
    app()
