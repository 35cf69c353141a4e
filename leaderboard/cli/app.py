"""The application: its commands, and the exit codes of its errors.

Exit codes: 0 success, 1 rejected with a stable code, 2 invalid usage, 3 tampering detected, 130
interrupted.
"""

from __future__ import annotations

from collections.abc import Callable

from leaderboard.cli import administration, demo, entries, results, seasons, submissions, tickets
from leaderboard.errors import Rejection, TamperedError
from sme_registry.errors import SealedError
from sme_registry.io.terminal import CommandGroup, application


class _Commands(CommandGroup):
    exit_codes = ((Rejection, 1), (SealedError, 1), (TamperedError, 3))
    extra = "leaderboard"


app = application(
    "sme-leaderboard",
    """A leaderboard that recomputes every score from the submitted policy.

    A board is a folder. Create one, score it and rank its entries:

      sme-leaderboard init board --suite smoke

      sme-leaderboard score board

      sme-leaderboard rank board

    To submit a method, use keygen, new, check and submit, in this order.

    Exit codes: 0 success, 1 rejected, 2 invalid usage, 3 tampering detected.
    """,
    _Commands,
)

_COMMANDS: dict[str, dict[str, Callable[..., None]]] = {
    "Submissions": {
        "keygen": submissions.keygen,
        "export-sb3": submissions.export_sb3,
        "new": submissions.new,
        "check": submissions.check,
        "submit": submissions.submit,
        "withdraw": submissions.withdraw,
    },
    "Seasons": {
        "ticket": tickets.ticket,
        "answer": tickets.answer,
        "enter": entries.enter,
    },
    "Results": {
        "rank": results.rank,
        "show": results.show,
        "verify": results.verify,
    },
    "Administration": {
        "init": administration.init,
        "score": administration.score,
        "site": administration.site,
        "serve": administration.serve,
        "reindex": administration.reindex,
        "gc": administration.gc,
        "demo": demo.demo,
    },
}
for _panel, _commands in _COMMANDS.items():
    for _name, _command in _commands.items():
        app.command(_name, rich_help_panel=_panel)(_command)
app.add_typer(seasons.app, name="season", rich_help_panel="Seasons")
app.command("export", hidden=True)(submissions.export_sb3)  # the name that scripts rely on


def main() -> None:
    """The entry point of the command `sme-leaderboard`."""
    app()
