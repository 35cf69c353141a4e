"""The application: its commands, and what becomes of errors.

Exit codes: 0 done; 1 rejected, by a stable code; 2 bad usage; 3 tampered; 130 interrupted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from leaderboard.cli import demo, keeping, reading, submitting
from leaderboard.errors import Rejection, TamperedError
from sme_registry.terminal import CommandGroup, application, version_option


class _Commands(CommandGroup):
    """The commands of `sme-leaderboard`."""

    program = "sme-leaderboard"
    exit_codes = ((Rejection, 1), (TamperedError, 3))


app = application(_Commands)


@app.callback()
def _top(
    version: Annotated[bool, version_option(_Commands.program)] = False,
) -> None:
    """A leaderboard of policies: every number is recomputed from the policy that was submitted.

    A board is a folder. Yours, here:

      sme-leaderboard init board --suite smoke

      sme-leaderboard score board

      sme-leaderboard rank board

    A submission:  **keygen**  ·  **new**  ·  **check**  ·  **submit**

    Exit codes: 0 done, 1 rejected, 2 bad usage, 3 tampered with.
    """


_COMMANDS: dict[str, dict[str, Callable[..., None]]] = {
    "Submitting": {
        "keygen": submitting.keygen,
        "export-sb3": submitting.export_sb3,
        "new": submitting.new,
        "check": submitting.check,
        "submit": submitting.submit,
        "withdraw": submitting.withdraw,
    },
    "Reading a board": {
        "rank": reading.rank,
        "show": reading.show,
        "verify": reading.verify,
    },
    "Keeping a board": {
        "init": keeping.init,
        "score": keeping.score,
        "site": keeping.site,
        "serve": keeping.serve,
        "reindex": keeping.reindex,
        "gc": keeping.gc,
        "demo": demo.demo,
    },
}
for _panel, _commands in _COMMANDS.items():
    for _name, _command in _commands.items():
        app.command(_name, rich_help_panel=_panel)(_command)
app.command("export", hidden=True)(submitting.export_sb3)  # its name before `new` made bundles


def main() -> None:
    """The entry point of the command `sme-leaderboard`."""
    app()
