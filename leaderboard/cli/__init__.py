"""The command `sme-leaderboard`; the module of a command is imported when it is called.

Exit codes: 0 success, 1 rejected with a stable code, 2 invalid usage, 3 tampering detected, 130
interrupted.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import ClassVar

from leaderboard.errors import Rejection, TamperedError
from sme_registry.errors import SealedError
from sme_registry.io.terminal import CommandGroup, application

if find_spec("leaderboard.seasons") is not None:
    from leaderboard.seasons import COMMANDS
else:
    COMMANDS = {}

_SUBMIT, _RESULTS = f"{__name__}.submissions", f"{__name__}.results"
_ADMIN = f"{__name__}.admin"

_PANELS = {
    "Submissions": {
        "keygen": (_SUBMIT, "Create your signing key, which proves who you are."),
        "export-sb3": (_SUBMIT, "Export an SB3 model's deterministic policy to ONNX."),
        "new": (_SUBMIT, "Create a signed submission from trained runs."),
        "check": (_SUBMIT, "Score a submission locally, exactly as the board does."),
        "submit": (_SUBMIT, "Send a submission to a board's folder or to a served board."),
        "withdraw": (_SUBMIT, "Withdraw your submission; its page stays and says so."),
    },
    "Seasons": COMMANDS,
    "Results": {
        "rank": (_RESULTS, "Rank the entries by a metric."),
        "show": (_RESULTS, "Show one submission: its method, runs and scores."),
        "fetch": (_RESULTS, "Copy the public part of a served board."),
        "verify": (_RESULTS, "Check every signature, digest, log entry and score."),
    },
    "Administration": {
        "init": (_ADMIN, "Create a board."),
        "score": (_ADMIN, "Score all waiting submissions."),
        "site": (_ADMIN, "Write the board as static pages."),
        "serve": (_ADMIN, "Serve the board: its pages, and an API for submissions."),
        "reindex": (_ADMIN, "Rebuild the index from the log and the documents."),
        "clock": (_ADMIN, "Go on after the machine's clock was wrong."),
        "gc": (_ADMIN, "Remove what no submission needs."),
        "demo": (_ADMIN, "Put a trained run through the whole pipeline."),
    },
}


class _Commands(CommandGroup):
    exit_codes = ((Rejection, 1), (SealedError, 1), (TamperedError, 3))
    extra = "leaderboard"
    modules: ClassVar = {
        **{
            name: (module, summary, panel)
            for panel, commands in _PANELS.items()
            for name, (module, summary) in commands.items()
        },
        "export": (_SUBMIT, ""),  # the name that scripts rely on
    }


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


def main() -> None:
    """The entry point of the command `sme-leaderboard`."""
    app()


__all__ = ["app", "main"]
